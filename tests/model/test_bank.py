"""Tests of a sensor's filter bank, its kernels and its planes, for any blur and noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from torch.nn.functional import conv2d, pixel_unshuffle

from beers_deploy.model.bank import (
    EPSILON_PER_SIGMA,
    FILTERS,
    GRID,
    SIDE_PX,
    STEP,
    UNIT,
    bank_of_vector,
    in_places,
    network_bank,
)
from beers_deploy.model.family import RANGES, sensor_vector
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.profiles.effects import Smear
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import unpacked
from tests.model.simulator.stages import (
    NOMINAL,
    REFERENCE,
    lopsided_point,
    point_spread,
    with_response,
)

CONTRAST = st.floats(0.015, 0.15)


def sensor(across: float, along: float, snr: float = 110.0) -> Instrument:
    """Return a sensor with constant noise, and with that SNR at a quarter of full scale."""
    return replace(
        NOMINAL, mtf_nyquist=across, mtf_nyquist_along=along, alpha=0.0, beta=(100 / snr) ** 2
    )


@settings(max_examples=40)
@given(CONTRAST, CONTRAST, st.floats(35, 220))
def test_details_have_sum_0_and_noise_makes_planes_of_one_size(
    across: float, along: float, snr: float
) -> None:
    bank = network_bank(sensor(across, along, snr))
    assert bank.details.shape == (FILTERS, SIDE_PX, SIDE_PX)
    # Details without a mean keep the gain of every restoration 1 at DC.
    assert np.abs(bank.details.sum((1, 2))).max() < 1e-12
    noise = bank.sigma * np.sqrt(np.square(bank.planes).sum((1, 2)))
    assert_allclose(noise, 1 / UNIT, rtol=1e-12)
    assert bank.unit == pytest.approx(UNIT * bank.sigma * np.linalg.norm(bank.analytic))


def test_a_lopsided_point_spread_transposed_has_its_kernels_transposed() -> None:
    point = lopsided_point()
    other = point_spread(unpacked(point).T, point.samples_per_px)
    upright, turned = (
        network_bank(with_response(NOMINAL, point_spread)) for point_spread in (point, other)
    )
    assert_allclose(turned.details.transpose(0, 2, 1), upright.details, atol=1e-6)
    # Control: the kernels are not symmetric. Otherwise the test would prove nothing.
    assert np.abs(upright.details - upright.details[:, ::-1, ::-1]).max() > 0.01


def test_smear_is_undone_along_the_track_alone() -> None:
    plain, smeared = (
        network_bank(instrument)
        for instrument in (NOMINAL, replace(NOMINAL, effects={"smear": Smear(0.9)}))
    )
    down, across = (
        np.abs(smeared.analytic.sum(axis) - plain.analytic.sum(axis)).max() for axis in (1, 0)
    )
    assert down > 10 * across


def frequencies() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    fy, fx = np.meshgrid(*[np.fft.fftfreq(GRID)] * 2, indexing="ij")
    return fy, fx, np.hypot(fy, fx) / 0.5


def response(kernel: np.ndarray) -> np.ndarray:
    """Return the response of a kernel (7, 7) at the frequencies of the grid."""
    transfer = np.zeros((GRID, GRID))
    transfer[:SIDE_PX, :SIDE_PX] = kernel
    return np.fft.fft2(np.roll(transfer, (-(SIDE_PX // 2),) * 2, (0, 1)))


def error(kernel: np.ndarray, instrument: Instrument, epsilon: float) -> float:
    """Return the error of a restoration for scenes of power 1 / r^2 and noise of power epsilon."""
    fy, fx, r = frequencies()
    blur, target = (sensor_mtf(fx[:1], fy[:, :1], camera) for camera in (instrument, REFERENCE))
    gain = response(kernel)
    nonzero = r > 0
    errors = (
        np.abs(gain * blur - target)[nonzero] ** 2 / r[nonzero] ** 2
        + epsilon * np.abs(gain[nonzero]) ** 2
    )
    return float(errors.mean())


@settings(max_examples=15)
@given(CONTRAST, CONTRAST, st.floats(36, 219), st.integers(0, 2**20))
def test_no_other_kernel_of_its_size_restores_better(
    across: float, along: float, snr: float, seed: int
) -> None:
    """Any change of a kernel that keeps its sum makes the error larger."""
    instrument = sensor(across, along, snr)
    generator = np.random.default_rng(seed)
    bank = network_bank(instrument)
    itself = np.zeros((SIDE_PX, SIDE_PX))
    itself[SIDE_PX // 2, SIDE_PX // 2] = 1
    for k in range(FILTERS):
        kernel = itself + bank.details[k:].sum(0)
        epsilon = EPSILON_PER_SIGMA * bank.sigma * STEP ** (k - 1)
        least = error(kernel, instrument, epsilon)
        change = generator.standard_normal(kernel.shape)
        change -= change.mean()
        for size in (-0.01, 0.01):
            assert error(kernel + size * change, instrument, epsilon) > least


@pytest.mark.parametrize(("alpha", "end"), [(0.0, 0), (1.0, 1)])
def test_noise_outside_the_trained_range_is_clamped_to_it(alpha: float, end: int) -> None:
    assert (
        network_bank(replace(NOMINAL, alpha=alpha, beta=0.0)).sigma == RANGES["sigma_bright"][end]
    )


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_filters_on_places_equal_filters_on_pixels(scale: int) -> None:
    kernels = network_bank(sensor(0.08, 0.05)).kernels
    image = torch.rand(
        1,
        1,
        10 * scale,
        12 * scale,
        dtype=torch.float64,
        generator=torch.Generator().manual_seed(0),
    )
    places = torch.from_numpy(in_places(kernels, scale))
    around = places.shape[-1] // 2
    planes = conv2d(image, torch.from_numpy(kernels)[:, None], padding=SIDE_PX // 2)
    actual = conv2d(pixel_unshuffle(image, scale), places)
    expected = pixel_unshuffle(planes, scale)[..., around:-around, around:-around]
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-12)


@settings(max_examples=20)
@given(CONTRAST, CONTRAST, st.floats(36, 219))
def test_a_sensor_vector_gives_the_bank_of_its_sensor(
    across: float, along: float, snr: float
) -> None:
    instrument = sensor(across, along, snr)
    from_vector = bank_of_vector(sensor_vector(instrument).values)
    own = network_bank(instrument)
    assert from_vector.sigma == pytest.approx(own.sigma)
    assert_allclose(from_vector.details, own.details, atol=1e-9)
