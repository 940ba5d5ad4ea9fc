"""Which points are looked at."""

from pathlib import Path

import pytest

from deploy.bench.tables import Swath
from deploy.dpu.board import load_dpu
from deploy.export import float_model, to_onnx
from deploy.networks import shipped_pair
from deploy.tradeoff.methods import Network, find_networks, is_papers, operations_per_px, shape_of
from deploy.tradeoff.points import EXACT, LEGAL, PRECISIONS, Board, Variant, network_points, other_points, tiles_px
from deploy.tradeoff.selection import board_of, configurations_for, precisions_of
from model.convbeers import ConvBEERS, save_network
from model.shipped import shipped_names, shipped_weights
from model.variants import Variant as Shape
from profiles import load_target
from profiles.errors import ModelError, OptionError

BOARD = Board(19, 176, 176, ("C32B3", "C32B1", "C32B6"))


def test_names_tell_points_apart_and_only_legal_networks_have_configurations() -> None:
    points = network_points("net", PRECISIONS, BOARD)
    assert len({point.name for point in points}) == len(points)
    for point in points:
        assert bool(point.configuration) == (point.variant.precision == LEGAL)
    assert {point.variant.precision for point in points} == set(PRECISIONS)


def test_halos_stay_below_the_exact_one_and_tiles_hold_them() -> None:
    for radius_px in (0, 1, 8, 11, 35):
        for point in network_points("net", [LEGAL], Board(radius_px, 128, 128, ("C32B3",))):
            assert point.halo == EXACT or int(point.halo) < radius_px
            assert point.tile_px > 2 * point.halo_px(radius_px)


@pytest.mark.parametrize(
    ("kept_px", "radius_px", "sides"),
    [
        (176, 19, [640, 336, 176]),
        (128, 35, [640, 288, 128]),
        (640, 3, [640]),
        (None, 3, [640]),
        (64, 35, [640]),
    ],
)
def test_tiles_lie_between_the_papers_and_what_stays_on_chip(
    kept_px: int | None, radius_px: int, sides: list[int]
) -> None:
    assert tiles_px(kept_px, radius_px) == sides


def test_chains_and_peers_are_float_and_off_the_dpu() -> None:
    points = other_points(["traditional-fast"], ["nl-means"])
    assert [str(point.variant) for point in points] == ["traditional-fast", "nl-means"]
    assert not any(point.configuration for point in points)


@pytest.mark.slow
def test_the_shipped_family_makes_some_forty_to_seventy_points() -> None:
    """More would not be measured in 45 minutes, fewer would leave an axis out."""
    networks = find_networks(shipped_names())
    swath = Swath(13600, 9016)
    points = [
        p
        for n in networks
        for p in network_points(n.name, precisions_of(n), board_of(n, swath, load_target("vck190")))
    ]
    assert 40 <= len(points) + 7 <= 72
    assert {point.halo for point in points} == {"0", "8", "16", EXACT}
    assert len({point.configuration for point in points if point.configuration}) >= 4
    assert len({point.tile_px for point in points}) >= 4


def test_wide_engines_are_looked_at_for_wide_layers_alone() -> None:
    dpu = load_dpu("vck190")
    for name, widths in (("convbeers-s", {"C32"}), ("convbeers", {"C32", "C64"})):
        found = configurations_for(float_model(shipped_pair(name)[0]), dpu)
        assert found[0] == dpu.name
        assert {configuration[:3] for configuration in found} == widths
        assert len(set(found)) == len(found)


def test_the_papers_network_is_known_by_its_shape() -> None:
    for name in shipped_names():
        for model in (float_model(shipped_pair(name)[0]), Network(name, None, shipped_pair(name)[1]).model()):
            assert is_papers(model) == (name == "convbeers")
    assert shape_of(float_model(shipped_pair("convbeers-xs")[0])) == (4, 16)
    assert operations_per_px(float_model(shipped_pair("convbeers")[0])) == pytest.approx(2.4e6, rel=0.02)


def test_networks_come_by_name_and_by_file(tmp_path: Path) -> None:
    mine = tmp_path / "mine.safetensors"
    mine.write_bytes(shipped_weights("convbeers-xs").read_bytes())
    int8 = tmp_path / "other-int8.onnx"
    int8.write_bytes(shipped_pair("convbeers-xs")[1].read_bytes())
    shipped, own, given = find_networks(["convbeers-xs", str(mine), str(int8)])
    assert shipped.float_file
    assert shipped.int8_file
    assert (own.name, own.int8_file) == ("mine", None)
    assert given.float_file is None
    assert (given.name, given.given) == ("other-int8", LEGAL)
    assert precisions_of(given) == (LEGAL,)
    assert precisions_of(own) == PRECISIONS


def test_one_network_twice_is_once_and_two_of_one_name_are_refused(tmp_path: Path) -> None:
    assert len(find_networks(["convbeers-xs", " convbeers-xs"])) == 1
    other = tmp_path / "convbeers-xs.safetensors"
    other.write_bytes(shipped_weights("convbeers-xs").read_bytes())
    with pytest.raises(OptionError, match="names that differ"):
        find_networks(["convbeers-xs", str(other)])


def test_a_network_at_half_resolution_is_taken_and_one_of_a_coarse_lattice_is_not(tmp_path: Path) -> None:
    """Halos and tiles are compared in steps that its lattice must divide."""
    for name, scale in (("half", 2), ("sixteenth", 16)):
        save_network(tmp_path / f"{name}.safetensors", ConvBEERS(Shape(1, 4, scale)).eval(), {})
    (half,) = find_networks([str(tmp_path / "half.safetensors")])
    assert operations_per_px(half.model()) == 2 * 9 * (4 * 4 + 3 * 4 * 4 + 4 * 4) / 4
    assert not is_papers(to_onnx(ConvBEERS(Shape(16, 64, 2)).eval(), {}))
    board = board_of(half, Swath(13600, 9016), load_target("vck190"))
    assert board.radius_px == 10
    for point in network_points("half", [LEGAL], board):
        assert point.tile_px % 2 == point.halo_px(board.radius_px) % 2 == 0
    with pytest.raises(OptionError, match="all multiples of 8 px are compared"):
        find_networks([str(tmp_path / "sixteenth.safetensors")])


@pytest.mark.parametrize("name", ["", "convbeers-huge", "traditional"])
def test_an_unknown_name_gets_the_list(name: str) -> None:
    with pytest.raises(OptionError, match="convbeers-xs"):
        find_networks([name])


def test_a_file_that_is_no_network_or_not_there_gets_one_sentence(tmp_path: Path) -> None:
    empty = tmp_path / "empty.onnx"
    empty.touch()
    for path in (empty, tmp_path / "none.onnx", tmp_path / "none.safetensors"):
        with pytest.raises(ModelError):
            find_networks([str(path)])


def test_a_unit_is_named_by_method_and_precision() -> None:
    assert str(Variant("net", "network", "bf16")) == "net bf16"
    assert str(Variant("wiener", "peer", "float32")) == "wiener"
