"""The counted work of the chain: that of the calls that it makes, and how it grows."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.flop_counter import FlopCounterMode

from model.simulator.acquire import simulate_pair
from model.simulator.detector import Draw
from model.simulator.procedural import procedural_scene
from model.traditional import compensate, nl_bayes
from model.traditional.pipeline import WORKING_SIGMA, Chain, restore_traditional
from model.traditional.settings import QUALITIES, first_pass, second_pass
from model.traditional.work import UNITS, Tile, chain_work, tile_work
from profiles import load_sensor

DEGRADED, REFERENCE = (load_sensor(f"pleiades-{name}").nominal() for name in ("degraded", "reference"))
SIDE_PX = 160
SIZES = st.integers(1, 3000)
NAMES = st.sampled_from(sorted(QUALITIES))


def acquisition(side_px: int) -> torch.Tensor:
    """Digital numbers of a drawn scene, some pixels smaller: its margins are cut off."""
    ratio = int(load_sensor("pleiades-degraded").oversampling.low)
    scene = procedural_scene(side_px * ratio, side_px * ratio, np.random.default_rng(3))
    return simulate_pair(scene.radiance, DEGRADED, REFERENCE, ratio, Draw(3)).degraded


@pytest.mark.parametrize("name", sorted(QUALITIES))
def test_the_counts_are_those_of_the_calls_that_the_chain_makes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for a few groups in a hundred, which are flat or larger than usual."""
    for module in (nl_bayes, compensate):
        monkeypatch.setattr(module, "map_tiles", map)  # what a pool's threads call is not counted
    selected: list[int] = []
    nearest_first = nl_bayes.nearest_first

    def counted(distances: torch.Tensor, usual: int, most: int) -> tuple[torch.Tensor, torch.Tensor]:
        selected.append(distances.numel() if usual < distances.shape[1] else 0)
        return nearest_first(distances, usual, most)

    monkeypatch.setattr(nl_bayes, "nearest_first", counted)
    image = acquisition(SIDE_PX)
    with FlopCounterMode(display=False) as flops:
        restore_traditional(image, Chain(DEGRADED, REFERENCE, name))
    height, width = image.shape
    work = chain_work(height, width, QUALITIES[name])
    assert work["box sums"] + work["group products"] == pytest.approx(flops.get_total_flops(), rel=0.05)
    assert work["selection"] == sum(selected)


@given(SIZES, SIZES, NAMES)
def test_every_kind_is_there_and_none_falls_with_the_image(height: int, width: int, name: str) -> None:
    small, large = (chain_work(height + more, width + more, QUALITIES[name]) for more in (0, 3))
    assert set(small) == set(UNITS)
    assert all(0 < small[kind] <= large[kind] for kind in UNITS)


@given(st.integers(1, 4), st.integers(1, 4), NAMES)
def test_large_images_take_work_by_their_pixels(rows: int, columns: int, name: str) -> None:
    """Squares on whose sides whole tiles and whole blocks end: what lies at the borders is little."""
    quality = QUALITIES[name]
    side = math.lcm(nl_bayes.TILE_REFERENCES * quality.stride_px, compensate.BLOCK_PX) * 16
    one, many = (chain_work(side * n, side * m, quality) for n, m in ((1, 1), (rows, columns)))
    for kind in UNITS:
        assert many[kind] == pytest.approx(rows * columns * one[kind], rel=0.03)


@given(SIZES, SIZES, NAMES)
def test_an_image_turned_on_its_side_takes_about_the_same(height: int, width: int, name: str) -> None:
    one, other = (chain_work(*size, QUALITIES[name]) for size in ((height, width), (width, height)))
    for kind in ("selection", "factorisations", "transforms", "gathers", "calls"):
        assert one[kind] == other[kind]


def test_denser_references_are_more_groups_and_not_more_filtering() -> None:
    fast, standard, best = (chain_work(1024, 1024, QUALITIES[name]) for name in ("fast", "standard", "best"))
    for kind in ("factorisations", "selection", "group products"):
        assert best[kind] / standard[kind] == pytest.approx((3 / 2) ** 2, rel=0.02)
        assert standard[kind] / fast[kind] == pytest.approx((4 / 3) ** 2, rel=0.02)
    assert fast["transforms"] == standard["transforms"] == best["transforms"]


def test_a_wider_window_is_searched_and_a_larger_group_is_estimated() -> None:
    first, second = first_pass(WORKING_SIGMA), second_pass(WORKING_SIGMA, QUALITIES["standard"])
    wide, narrow = (tile_work(Tile(24, 24, 3), settings) for settings in (first, second))
    assert wide["selection"] / narrow["selection"] == pytest.approx((first.window_px / second.window_px) ** 2)
    assert wide["factorisations"] == narrow["factorisations"]  # patches of one size
    assert wide["box sums"] > narrow["box sums"]
    assert wide["gathers"] > narrow["gathers"]


def test_an_image_without_pixels_has_no_work() -> None:
    with pytest.raises(ValueError, match="0 x 5"):
        chain_work(5, 0, QUALITIES["fast"])
