"""Tests that calibration patches cover the ranges, repeat, and can be processed in pieces."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.response import MtfTable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.graph import PLANES, Graph, graph_to_onnx, tensors
from beers_deploy.quant.passes.least_squares import choose_frac_bits
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.samples.simulated import draw_patches
from beers_deploy.quant.samples.views import stratified
from beers_deploy.quant.session import (
    TILE_PX,
    crops,
    halo_of,
    open_session,
    planes_of,
    tensor_values,
)
from tests.quant.quick import image

VARIABLE = Sensor.load("pleiades-variable")
REFERENCE = Sensor.load("pleiades-reference")


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [procedural_scene(700, 940, np.random.default_rng(k)) for k in (1, 2)]


@pytest.fixture(scope="module")
def drawn(scenes: list[Scene]) -> Patches:
    return draw_patches(scenes, VARIABLE, REFERENCE, count=12, seed=3, patch_px=40)


def test_patches_are_the_same_at_each_access(drawn: Patches) -> None:
    passes = [list(drawn.pairs), list(drawn.pairs)]
    for number, (once, second) in enumerate(zip(*passes, strict=True)):
        alone = drawn.degraded[number]
        assert alone.shape == once[1].shape == (1, 1, 40, 40)
        assert alone.dtype == once[1].dtype == np.float32
        assert_array_equal(once, second)
        assert_array_equal(alone, once[0])
        # Both sensors see the same ground.
        assert np.corrcoef(once[0].ravel(), once[1].ravel())[0, 1] > 0.7
    with pytest.raises(IndexError):
        drawn.pairs[12]


def test_the_digest_identifies_the_bytes(scenes: list[Scene], drawn: Patches) -> None:
    def digest(seed: int, count: int = 12) -> str:
        return draw_patches(scenes, VARIABLE, REFERENCE, count, seed, patch_px=40).digest

    assert digest(3) == drawn.digest
    assert len({digest(3), digest(4), digest(3, 11)}) == 3


def test_the_ranges_are_covered_without_gaps(scenes: list[Scene]) -> None:
    """With 40 strata, no gap in the MTF exceeds a few of them, and both ends are covered."""
    views = draw_patches(scenes, VARIABLE, REFERENCE, count=40, seed=0, patch_px=40).views
    low = VARIABLE.mtf_nyquist.low
    high = VARIABLE.mtf_nyquist.high
    positions = (np.sort([view.degraded.mtf_nyquist for view in views]) - low) / (high - low)
    assert positions[0] < 2 / 40
    assert positions[-1] > 1 - 2 / 40
    assert np.diff(positions).max() < 3 / 40


def test_a_whole_response_stays_with_every_view(scenes: list[Scene]) -> None:
    table = MtfTable((0.0, 0.25, 0.5), (1.0, 0.5, 0.12), (1.0, 0.4, 0.05))
    across, along = (replace(VARIABLE.mtf_nyquist, value=contrast) for contrast in table.at_nyquist)
    profile = replace(VARIABLE, response=table, mtf_nyquist=across, mtf_nyquist_along=along)
    views = draw_patches(scenes, profile, REFERENCE, count=3, seed=0, patch_px=40).views
    assert all(view.degraded.response == table for view in views)
    assert len({view.degraded.noise_sigma(25) for view in views}) == 3


@settings(max_examples=40)
@given(count=st.integers(1, 30), size=st.integers(1, 9), seed=st.integers(0, 2**31))
def test_each_stratum_gives_one_pick(count: int, size: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    candidates = [float(k) for k in generator.permutation(count * size)]
    picks = stratified(candidates, lambda value: value, count, generator)
    assert sorted(int(value) // size for value in picks) == list(range(count))


def test_light_blur_and_noise_are_uncorrelated(scenes: list[Scene]) -> None:
    views = draw_patches(scenes, VARIABLE, REFERENCE, count=200, seed=1, patch_px=40).views
    keys: list[Callable[[int], float]] = [
        lambda k: views[k].ground.brightness,
        lambda k: views[k].degraded.mtf_nyquist,
        lambda k: views[k].degraded.noise_sigma(25),
    ]
    ranks = np.array([np.argsort(np.argsort([key(k) for k in range(200)])) for key in keys])
    assert np.abs(np.corrcoef(ranks) - np.eye(3)).max() < 0.25


def test_scenes_too_small_for_a_patch_are_refused(scenes: list[Scene]) -> None:
    with pytest.raises(ImageError, match="300 target pixels"):
        draw_patches(scenes, VARIABLE, REFERENCE, count=1, seed=0, patch_px=300)


@pytest.mark.parametrize(
    "shape", [(TILE_PX, 31), (TILE_PX + 1, 37), (2 * TILE_PX + 3, TILE_PX + 70)]
)
def test_pieces_contain_the_values_of_the_whole_image(graph: Graph, shape: tuple[int, int]) -> None:
    """No run returns more than a piece with its halo, which bounds memory."""
    names = tensors(graph)
    full_image = image(*shape)
    halo_px = halo_of(graph)
    assert halo_px is not None
    session = open_session(graph_to_onnx(graph, names))
    expected = session.run(names, {PLANES: planes_of(full_image)})
    pieces, without_halo = (
        list(tensor_values(session, names, full_image, px)) for px in (halo_px, 0)
    )
    for tensor, parts in zip(expected, zip(*pieces, strict=True), strict=True):
        values = np.sort(np.concatenate([part.ravel() for part in parts]))
        assert_allclose(values, np.sort(tensor, axis=None), rtol=1e-5, atol=1e-6)
    sides_px = [array.base.shape[2] for array in chain.from_iterable(pieces)]  # type: ignore[union-attr]
    assert max(sides_px) <= TILE_PX + 2 * halo_px
    if len(pieces) > 1:
        values = np.concatenate([piece[-1].ravel() for piece in without_halo])
        assert np.abs(np.sort(values) - np.sort(expected[-1], axis=None)).max() > 1e-3


def test_crops_tile_the_image() -> None:
    full_image = image(2 * TILE_PX + 5, TILE_PX)
    pieces = crops(full_image)
    assert [max(crop.shape) <= TILE_PX for crop in pieces] == [True] * 3
    assert_array_equal(np.concatenate(pieces, axis=2), full_image)


def test_scales_of_a_large_image_are_those_of_whole_tensors(
    graph: Graph,
) -> None:
    """The image is calibrated in pieces. The expected scales follow from whole tensors."""
    full_image = image(TILE_PX + 21, 50)
    frac_bits = choose_frac_bits(graph, [full_image], least_squares=False)
    names = tensors(graph)
    values = open_session(graph_to_onnx(graph, names)).run(names, {PLANES: planes_of(full_image)})
    for name, tensor in zip(names, values, strict=True):
        largest = float(np.abs(tensor).max())
        assert largest * 2.0 ** frac_bits[name] <= 127 < largest * 2.0 ** (frac_bits[name] + 1)
