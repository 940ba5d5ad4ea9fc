"""Tests that tiles restored several at a time give the same rows as one at a time."""

import os
import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.profiles.errors import ImageError
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.plan import Plan, make_plan
from beers_deploy.restoration.runtime import AT_ONCE, Infer, session_threads, tiles_at_once
from beers_deploy.restoration.tiles.engine import Restorer
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import gathered, restore_rows

SHAPE = (2, 75, 133)
TILE_PX = 32
RADIUS_PX = 3


def restored_by(infer: Infer, at_once: int, tick: Callable[[], None] = lambda: None) -> np.ndarray:
    """Restore a noisy image of two bands by `infer`."""
    pixels = np.random.default_rng(0).integers(0, 4096, SHAPE).astype(np.uint16)
    raster = Raster(*SHAPE, pixels.dtype, None)
    plan: Plan = make_plan(raster.shape, TILE_PX, RADIUS_PX, Tiling(RADIUS_PX))
    restorer = Restorer(raster, (ExposedNetwork({1: infer}),), 4095.0, plan)
    rows = restore_rows(ArraySource(pixels, raster), restorer, plan.rows, tick, at_once)
    result, tally = gathered(rows, SHAPE, pixels.dtype)
    assert (tally.valid_results, tally.clipped) == (result.size, 0)
    return result


def brighter(image: np.ndarray) -> np.ndarray:
    return np.asarray(image * np.float32(0.5) + np.float32(0.25))


@pytest.mark.parametrize("at_once", [2, 3, 4])
def test_rows_are_the_same_however_many_tiles_run_at_once(at_once: int) -> None:
    assert np.array_equal(restored_by(brighter, at_once), restored_by(brighter, 1))


def test_the_requested_number_of_tiles_run_at_once() -> None:
    """Each call waits for a second one, so that a single call would time out.

    Two bands make the number of calls even.
    """
    together = threading.Barrier(2, timeout=10)

    def patient(image: np.ndarray) -> np.ndarray:
        together.wait()
        return brighter(image)

    assert np.array_equal(restored_by(patient, 2), restored_by(brighter, 1))


@pytest.mark.parametrize(
    ("factor", "error", "words"),
    [(np.nan, ImageError, "NaN or infinite pixels"), (1, KeyboardInterrupt, "a stop")],
)
def test_after_an_error_or_a_stop_no_further_tile_is_begun(
    factor: float, error: type[BaseException], words: str
) -> None:
    calls = []
    going = threading.Event()

    def slow(image: np.ndarray) -> np.ndarray:
        calls.append(1)
        # A real tile takes longer than an error takes to arrive, so later calls wait a little.
        if len(calls) > 2:
            going.wait(0.2)
        return brighter(image) * np.float32(factor)

    def stop() -> None:
        raise KeyboardInterrupt("a stop")

    with pytest.raises(error, match=words):
        restored_by(slow, 2, stop)
    assert len(calls) < 10, "the first two rows have 20 tiles"


@given(threads=st.integers(0, 256), tiles=st.integers(0, 1000))
def test_tiles_share_the_threads_evenly(threads: int, tiles: int) -> None:
    count = tiles_at_once(threads, tiles)
    cores = threads or os.cpu_count() or 1
    assert 1 <= count <= min(AT_ONCE, max(tiles, 1))
    assert cores % count == 0
    if count > 1:
        # The caller of a session is one of its threads: onnxruntime starts one less of its own.
        own_threads = session_threads(threads, count) - 1
        assert own_threads + count == cores
