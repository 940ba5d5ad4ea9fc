"""The study's networks on other boards."""

from dataclasses import replace
from pathlib import Path

import onnx
import pytest

from deploy.bench.tables import Swath
from deploy.dpu.board import load_dpu
from deploy.tradeoff.board import FIGURES, DpuRun, predict_model
from deploy.tradeoff.boards import ALL, configurations, every_configuration, on_boards, parse_targets
from deploy.tradeoff.outcome import QUALITIES, Outcome
from profiles import load_target
from profiles.errors import BeersError, OptionError
from profiles.figures import Row
from profiles.target import DEFAULT_TARGET, board_names
from tests.deploy.dpu.graphs import Sketch, integer_convbeers
from tests.deploy.tradeoff.made_results import Made, outcome

NETWORK = {"narrow": Made(40.0, 2, 8), "wide": Made(41.0, 2, 16)}


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, onnx.ModelProto]:
    folder = tmp_path_factory.mktemp("nets")
    return {
        name: onnx.load(integer_convbeers(folder / f"{name}.onnx", made.blocks, made.features))
        for name, made in NETWORK.items()
    }


@pytest.fixture(scope="module")
def outcomes(models: dict[str, onnx.ModelProto]) -> list[Outcome]:
    """Points of the files themselves, one of them with seams."""
    found = []
    for name, made in [*NETWORK.items(), ("wide", replace(NETWORK["wide"], halo="0"))]:
        dpu = load_dpu(DEFAULT_TARGET)
        run = DpuRun(name, dpu, predict_model(models[name], dpu, 640), Swath(13600, 9016, 640, 0))
        each = outcome(name, made)
        found.append(replace(each, board=run, figures={**each.figures, **run.figures()}))
    return found


@pytest.fixture(scope="module")
def rows(outcomes: list[Outcome], models: dict[str, onnx.ModelProto]) -> tuple[Row, ...]:
    dpus = every_configuration(["vck190", "zcu104"])
    return tuple(each.row for each in on_boards(outcomes, dpus, lambda variant: models[variant.method]))


def test_every_network_stands_on_every_configuration_once(rows: tuple[Row, ...]) -> None:
    places = [(row.text["method"], row.text["board"], row.text["configuration"]) for row in rows]
    expected = [
        (name, board, dpu.name)
        for name in NETWORK
        for board in ("vck190", "zcu104")
        for dpu in configurations(load_target(board))
    ]
    assert places == expected
    assert len({row.name for row in rows}) == len(rows)


def test_pictures_are_the_studys_and_so_is_its_own_board(rows: tuple[Row, ...], outcomes: list[Outcome]) -> None:
    by_name = {each.point.variant.method: each for each in outcomes[:2]}
    for row in rows:
        own = by_name[row.text["method"]]
        assert all(row.figures[key] == own.figures[key] for key in QUALITIES)
        here = (row.text["board"], row.text["configuration"]) == (DEFAULT_TARGET, load_dpu(DEFAULT_TARGET).name)
        assert not here or all(row.figures[f"board {name}"] == own.figures[f"board {name}"] for name in FIGURES)
        if row.text["board"] != DEFAULT_TARGET:
            assert row.figures["board latency"] != own.figures["board latency"]


def test_a_board_without_a_published_power_has_times_and_a_reason(rows: tuple[Row, ...]) -> None:
    for row in (row for row in rows if row.text["board"] == "zcu104"):
        low, high = row.figures["board latency"].interval or (0.0, 0.0)
        assert 0 < low < (row.figures["board latency"].value or 0) < high
        for key in ("board power", "board energy", "board efficiency"):
            assert row.figures[key].value is None
            assert "no power of zcu104" in row.figures[key].reason


def test_what_a_board_cannot_run_says_why(outcomes: list[Outcome], tmp_path: Path) -> None:
    """A Sigmoid between two convolutions."""
    sketch = Sketch(8)
    path = sketch.save(tmp_path / "n.onnx", sketch.conv(sketch.node("Sigmoid", sketch.conv("image"))))
    found = on_boards(outcomes[:1], every_configuration(["zcu104"]), lambda _: onnx.load(path))
    for row in (each.row for each in found):
        assert {row.figures[f"board {name}"].value for name in FIGURES} == {None}
        assert "cost model" in row.figures["board latency"].reason


@pytest.mark.parametrize("board", ["nope", "host-cpu"])
def test_what_is_no_board_is_refused_before_anything_is_measured(board: str) -> None:
    with pytest.raises(BeersError, match=board):
        every_configuration(["vck190", board])


def test_the_default_configuration_stands_first() -> None:
    for name in board_names():
        dpus = configurations(load_target(name))
        assert dpus[0].name == load_dpu(name).name
        assert sorted(dpu.name for dpu in dpus) == sorted(load_target(name).configurations)


def test_all_begins_with_the_default_board() -> None:
    assert parse_targets(ALL)[0] == DEFAULT_TARGET
    assert sorted(parse_targets(ALL)) == sorted(board_names())
    assert parse_targets("zcu102, my.toml") == ("zcu102", "my.toml")


@pytest.mark.parametrize("text", ["", "vck190,", "vck190,vck190", ","])
def test_other_lists_are_refused(text: str) -> None:
    with pytest.raises(OptionError, match="--target: expected boards, each once"):
        parse_targets(text)
