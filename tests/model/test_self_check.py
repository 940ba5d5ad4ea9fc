"""Tests of the self-check.

Noise alone gives a chi2 of 1 under every blur, wrong images are found, and windows give the blocks
of the whole image.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.self_check import (
    BLOCK_PX,
    CELL_PX,
    LEAST_PX,
    LEAST_SHARPENING,
    NEAR_PX,
    REACH_PX,
    SMOOTH_WEIGHT,
    Judged,
    SelfCheck,
)
from beers_deploy.profiles.effects import Dsnu, Prnu, Striping
from beers_deploy.profiles.instrument import Instrument
from tests.model.consistency.images import (
    COLUMNS,
    FULL_SCALE,
    ROWS,
    SENSORS,
    acquired,
    blurred,
    noisy,
    scene,
    sigma_dn,
)
from tests.model.simulator.stages import REFERENCE, plain_sensor


def judged(check: SelfCheck, raw: np.ndarray, restored: np.ndarray) -> Judged:
    """Judge a whole image as one window."""
    whole = [Placed(side, 0, 0, side) for side in raw.shape]
    return check.judge(raw.astype(np.float32), restored.astype(np.float32), *whole)


def noise_of(sensor: Instrument, image: np.ndarray, seed: int = 1) -> np.ndarray:
    """Draw noise whose variance follows the signal, and the pattern of each column's detector."""
    generator = np.random.default_rng(seed)
    sigma = np.vectorize(lambda signal: sigma_dn(sensor, signal))(np.round(image, -1))
    noise = sigma * generator.normal(size=image.shape)
    for effect in sensor.effects.values():
        if isinstance(effect, Dsnu):
            noise += effect.rms_dn * generator.normal(size=image.shape[1])
        elif isinstance(effect, Prnu):
            noise += effect.rms * image * generator.normal(size=image.shape[1])
        elif isinstance(effect, Striping):
            noise += effect.odd_even_dn * (0.5 - np.arange(image.shape[1]) % 2)
    return np.asarray(noise)


PATTERNS = (plain_sensor(prnu=Prnu(0.01), dsnu=Dsnu(8.0)), plain_sensor(striping=Striping(30.0)))


@pytest.mark.parametrize("sensor", [*SENSORS.values(), *PATTERNS])
def test_the_true_scene_leaves_noise_alone(sensor: Instrument) -> None:
    """The true scene has the chi2 of noise for each sensor, and no block is outside the bound.

    The bound would be useless if blur, pattern or striping alone could exceed it.
    """
    # Some blurs ring below zero at the edges of the darkest ground, where a converter clips.
    truth = 0.8 * scene() + 400
    image = blurred(truth, sensor)
    raw = np.rint(image + noise_of(sensor, image))
    assert 0 < raw.min() < raw.max() < FULL_SCALE
    result = judged(SelfCheck.of(sensor, REFERENCE), raw, truth)
    assert not result.outside.any()
    if sensor in PATTERNS:
        # The allowance for patterns is larger than their effect in most blocks.
        assert np.nanmax(result.chi2) < 1.1
        return
    # chi2 of n cells scatters by sqrt(2 / n).
    scatter = 4 * np.sqrt(2 / LEAST_PX) * CELL_PX
    assert_allclose(result.chi2[np.isfinite(result.chi2)], 1, atol=scatter)


def test_the_scale_of_the_pixels_changes_nothing() -> None:
    """Digital numbers and fractions of full scale get the same verdict, since users have either."""
    sensor = SENSORS["offset"]
    raw = acquired(sensor)
    own = judged(SelfCheck.of(sensor, REFERENCE), raw, scene())
    of_shares = SelfCheck.of(sensor, REFERENCE, 1.0)
    shares = judged(of_shares, raw / FULL_SCALE, scene() / FULL_SCALE)
    assert_allclose(shares.chi2, own.chi2, rtol=1e-3)
    assert_allclose(shares.sharpening, own.sharpening, rtol=1e-3)


Wrong = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[Any]]

WRONG: dict[str, Wrong] = {
    "not restored": lambda raw, _: raw,
    "moved by a pixel": lambda _, truth: np.roll(truth, 1, axis=1),
    "of another sensor": lambda _, truth: truth + 0.5 * (truth - blurred(truth, plain_sensor())),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_restorations_are_found(name: str) -> None:
    """Wrong images are found in every block with enough texture to tell: one that is not
    restored, one that is moved, and one that is too sharp.
    """
    sensor = plain_sensor()
    raw = acquired(sensor)
    check = SelfCheck.of(sensor, REFERENCE)
    result = judged(check, raw, WRONG[name](raw, scene()))
    textured = judged(check, raw, scene()).sharpening >= LEAST_SHARPENING
    assert textured.any()
    assert result.outside[textured].all()


def test_an_error_counts_by_its_size() -> None:
    """An offset of one deviation passes and one of four is found. Detail as large as the cells is
    found at half a deviation, and the finest at one and a half.
    """
    sensor = plain_sensor()
    image = blurred(scene(), sensor)
    raw = noisy(image, sensor)
    sigma = np.vectorize(lambda signal: sigma_dn(sensor, signal))(np.round(image, -1))
    check = SelfCheck.of(sensor, REFERENCE)
    right = judged(check, raw, scene()).chi2
    known = np.isfinite(right)
    assert known.any()
    rows, columns = np.indices(raw.shape)
    finest = np.where((rows + columns) % 2, sigma, -sigma)
    cells = np.where((rows // CELL_PX + columns // CELL_PX) % 2, sigma, -sigma)
    smooth = SMOOTH_WEIGHT * CELL_PX**2
    for error, weight in (
        (sigma, smooth),
        (4 * sigma, smooth),
        (0.5 * cells, CELL_PX**2),
        (1.5 * finest, 1.0),
    ):
        result = judged(check, raw + error, scene())
        expected = weight * np.square(error / sigma).mean()
        assert_allclose(result.chi2[known] - right[known], expected, rtol=0.2, atol=0.2)
        assert result.outside[known].all() == (expected > 2)


def test_a_broken_block_is_found_where_it_is() -> None:
    """A single wrong block is found, and blocks out of reach of its light are not blamed."""
    sensor = plain_sensor()
    raw = acquired(sensor)
    broken = scene().copy()
    broken[2 * BLOCK_PX : 3 * BLOCK_PX, BLOCK_PX : 2 * BLOCK_PX] *= 1.2
    result = judged(SelfCheck.of(sensor, REFERENCE), raw, broken)
    assert result.outside[2, 1]
    # The blur carries light over the border of the block, but no farther than to its neighbours.
    far = result.outside.copy()
    far[1:4, 0:3] = False
    assert not far.any()


def spans(size_px: int, cuts: set[int]) -> list[Placed]:
    """Return windows that end at these blocks, with the reach around each."""
    ends = [0, *sorted(BLOCK_PX * cut for cut in cuts), size_px]
    return [
        Placed(size_px, max(start - REACH_PX, 0), start, stop) for start, stop in pairwise(ends)
    ]


@given(
    down=st.sets(st.integers(1, ROWS // BLOCK_PX), max_size=3),
    across=st.sets(st.integers(1, COLUMNS // BLOCK_PX), max_size=2),
)
@settings(max_examples=6)
def test_windows_give_the_blocks_of_the_whole_image(down: set[int], across: set[int]) -> None:
    """Windows of any cut give the blocks that the whole image gives, so a large image may be
    judged in parts.
    """
    sensor = SENSORS["two axes"]
    check = SelfCheck.of(sensor, REFERENCE)
    raw = acquired(sensor)
    raw[150:160, 20:30] = np.nan
    raw[40, 200] = FULL_SCALE
    whole = judged(check, raw, scene())
    chi2 = []
    for rows in spans(ROWS, down):
        bottom = min(rows.keep_stop + REACH_PX, ROWS)
        blocks = []
        for columns in spans(COLUMNS, across):
            right = min(columns.keep_stop + REACH_PX, COLUMNS)
            window = np.s_[rows.start : bottom, columns.start : right]
            blocks.append(check.judge(raw[window], scene()[window], rows, columns).chi2)
        chi2.append(np.concatenate(blocks, axis=1))
    # A missing pixel may be filled from another window, which far tails see.
    assert_allclose(np.concatenate(chi2), whole.chi2, rtol=0.01)


def test_pixels_without_a_known_residual_do_not_count() -> None:
    """Missing and saturated pixels change no block out of their reach, and make none fail.

    The value that is stored for a missing pixel does not matter.
    """
    sensor = plain_sensor()
    check = SelfCheck.of(sensor, REFERENCE)
    image = blurred(scene(), sensor)
    raw = np.clip(image + noise_of(sensor, image), 0, FULL_SCALE - 1)
    clean = judged(check, raw, scene())
    hidden = raw.copy()
    hidden[BLOCK_PX : 2 * BLOCK_PX, BLOCK_PX : 2 * BLOCK_PX] = np.nan
    saturated = raw.copy()
    saturated[220, 220] = FULL_SCALE
    for other, (row, column) in ((hidden, (1, 1)), (saturated, (3, 3))):
        result = judged(check, other, scene())
        expected = replace(clean, chi2=clean.chi2.copy())
        unchanged = np.isfinite(expected.chi2)
        unchanged[row - 1 : row + 2, column - 1 : column + 2] = False
        assert_allclose(result.chi2[unchanged], expected.chi2[unchanged], rtol=0.02)
        assert not result.outside.any()
    assert np.isnan(judged(check, hidden, scene()).chi2[1, 1])
    # The stored value of a missing pixel is not part of the image.
    hidden_restored = scene().copy()
    hidden_restored[np.isnan(hidden)] = 4000
    expected = judged(check, hidden, scene())
    assert_array_equal(judged(check, hidden, hidden_restored).chi2, expected.chi2)


@pytest.mark.parametrize("shape", [(1, 1), (3, 700), (2 * NEAR_PX, 90), (65, 65), (96, 129)])
def test_small_images_have_blocks_of_their_own(shape: tuple[int, int]) -> None:
    """An image of any size has its blocks, and too few pixels make them unknown and not wrong."""
    sensor = plain_sensor()
    image = scene()[: shape[0], : shape[1]] if shape[1] <= COLUMNS else np.full(shape, 900.0)
    result = judged(SelfCheck.of(sensor, REFERENCE), image, image)
    assert result.chi2.shape == tuple(-(-side // BLOCK_PX) for side in shape)
    inside = [max(side - 2 * NEAR_PX, 0) for side in shape]
    if inside[0] * inside[1] < LEAST_PX:
        assert np.isnan(result.chi2).all()
        assert not result.decidable.any()
        assert not result.outside.any()
