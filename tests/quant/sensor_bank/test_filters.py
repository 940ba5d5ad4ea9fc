"""Tests of a sensor's integer filter bank: its response to flat ground, and its copies' mean."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.bank import FILTERS, SIDE_PX, UNIT_STEPS, WIDE, Bank, bank_of_vector
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.graph import Window
from beers_deploy.quant.host_part import BANK_SLICES
from beers_deploy.quant.integer.arithmetic import convolve
from beers_deploy.quant.sensor_bank.filters import (
    COPIES,
    IMAGE_STEP_DN,
    PART,
    STEP_DN,
    channels,
    integer_bank,
)

VECTOR = st.tuples(*[st.floats(-1, 1)] * 4)

COARSE = 2 + FILTERS
"""The coarse copy's kernel, after those of the image, the planes and the analytic restoration."""


def sums(image: np.ndarray, own: Bank) -> np.ndarray:
    """Return the first convolution of an image (1, 1, H, W), in steps, before rounding and bias."""
    bank = integer_bank(own, 1, own.gain)
    return convolve(BANK_SLICES.encode(image), bank.weight, Window()) / 2.0**bank.frac_bits


def textured(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    """Return natural ground (1, 1, rows, columns), float32, from 0.05 to 0.95 of full scale."""
    generator = np.random.default_rng(seed)
    fy = np.fft.fftfreq(rows)[:, None]
    fx = np.fft.rfftfreq(columns)[None, :]
    frequency = np.hypot(fy, fx)
    falling = (
        np.fft.rfft2(generator.standard_normal((rows, columns)))
        * np.exp(-5 * frequency)
        / (frequency + 0.02)
    )
    ground = np.asarray(np.fft.irfft2(falling, (rows, columns)))
    return np.asarray(
        (0.05 + 0.9 * (ground - ground.min()) / np.ptp(ground))[None, None], np.float32
    )


@settings(max_examples=15)
@given(VECTOR, st.integers(0, MAX_DN))
def test_the_response_to_flat_ground_is_its_brightness_alone(
    vector: tuple[float, ...], dn: int
) -> None:
    flat = np.full((1, 1, SIDE_PX, SIDE_PX), dn / MAX_DN, np.float32)
    own = bank_of_vector(vector)
    response = sums(flat, own)[0, :, 0, 0]
    assert_array_equal(response[COPIES[0] :], 0)
    assert abs(response[0] - (dn - BANK_SLICES.middle) * own.gain / IMAGE_STEP_DN) <= 0.5 * own.gain


@settings(max_examples=15)
@given(VECTOR)
def test_the_weights_are_int8_and_near_the_filters(vector: tuple[float, ...]) -> None:
    own = bank_of_vector(vector)
    gain = own.gain
    bank = integer_bank(own, 1, gain)
    coarse_pair = bank.weight[:, :2].astype(int)
    # The scale is the finest one that clips no weight.
    assert 62 <= np.abs(coarse_pair).max() < 127
    assert np.ptp(coarse_pair, axis=1).max() <= 1
    for channel, (kernel, _) in enumerate(channels()):
        steps_per_dn = gain * (UNIT_STEPS / MAX_DN if kernel else 1 / IMAGE_STEP_DN)
        kernel_values = own.kernels[-1] / WIDE if kernel == COARSE else own.kernels[kernel]
        expected = kernel_values * steps_per_dn * 2.0**bank.frac_bits
        one, two, fine, part = bank.weight[channel].astype(float)
        assert np.abs((one + two) / STEP_DN - expected).max() < 5 / STEP_DN
        assert kernel == 0 or np.abs(fine + part / PART - expected).max() < 5 / PART


@settings(max_examples=8)
@given(VECTOR)
def test_the_mean_of_the_copies_is_the_result_of_the_filter(vector: tuple[float, ...]) -> None:
    """The mean errs by a fraction of a step: rounding weights costs less than rounding results."""
    own = bank_of_vector(vector)
    image = textured(90, 101)
    centred = np.lib.stride_tricks.sliding_window_view(
        image[0, 0].astype(np.float64), (SIDE_PX, SIDE_PX)
    )
    responses = sums(image, own)[0]
    kernels = [kernel for kernel, _ in channels()]
    for kernel, values in enumerate((*own.kernels[1:], own.kernels[-1] / WIDE), 1):
        expected = own.gain * UNIT_STEPS * np.einsum("ijkl,kl->ij", centred, values)
        mean = responses[np.equal(kernels, kernel)].mean(0)
        most = 0.3 * np.sqrt(mean.size) + 0.05 * np.linalg.norm(expected)
        assert np.linalg.norm(mean - expected) < most


def test_copies_are_rounded_at_offsets_spread_over_a_step() -> None:
    counts: dict[Kernels, int] = {"cut": COPIES[2], "fitted": COPIES[2] - 1}
    for kernels, count in counts.items():
        offsets = [offset for kernel, offset in channels(kernels) if kernel == 1 + FILTERS]
        assert len(offsets) == count
        assert_allclose(np.diff(offsets), 1 / count)
        assert sum(offsets) == pytest.approx(0)


def test_at_half_resolution_the_same_filters_read_the_same_pixels() -> None:
    own = bank_of_vector((0.3, -0.4, 0.1, 0.2))
    image = textured(32, 36)
    fine = integer_bank(own, 1, 1)
    coarse = integer_bank(own, 2, 1)
    assert fine.frac_bits == coarse.frac_bits
    planes = BANK_SLICES.encode(image)
    blocks = planes.reshape(1, 4, 16, 2, 18, 2).transpose(0, 1, 3, 5, 2, 4).reshape(1, 16, 16, 18)
    # The result covers rows 2 to 13 of the 16 rows of blocks.
    actual = convolve(blocks, coarse.weight, Window())
    first = [kernel for kernel, _ in channels()].index(1)
    expected = convolve(planes, fine.weight, Window())[0, first, 1:-1, 1:-1]
    mine = (
        actual[0]
        .reshape(-1, 2, 2, *actual.shape[2:])[first]
        .transpose(2, 0, 3, 1)
        .reshape(expected.shape)
    )
    assert_array_equal(mine, expected)
