"""Tests of simulator, traditional pipeline, losses and metrics on the hard cases of `stress`.

Each returns a correct value or refuses. Losses and their gradients are finite and bounded.
"""

import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from torch import Tensor

from beers_deploy.model.metrics.fidelity import MIN_SIDE_PX, psnr_db, ssim
from beers_deploy.model.shipped import SENSOR
from beers_deploy.model.simulator.acquire import acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.mtf import mtf, sensor_transfer
from beers_deploy.model.simulator.plan import ringing_of, scene_stats
from beers_deploy.model.simulator.sampling import read_scene, sample, scene_spectrum
from beers_deploy.model.traditional.pipeline import (
    TraditionalPipeline,
    restore_strips,
    restore_traditional,
)
from beers_deploy.model.training.losses import LossWeights, RestorationLoss
from beers_deploy.profiles.errors import BeersError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE
from beers_deploy.studies.stress.cases import CASES, FULL_DN, Case
from beers_deploy.studies.stress.checks import FLAT_DN, gain, ringing

RATIO = 2
FLOAT32_DN = 0.05
NOISE_DN = 5.0
BY_NAME = {case.name: case for case in CASES}
VALID = [case for case in CASES if case.pixels == "valid" and not case.large]
LOST = [case for case in CASES if case.pixels in ("missing", "infinite")]


def named(cases: list[Case]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", cases, ids=lambda case: str(case.name))


def images(case: Case, side_px: int = 32) -> list[np.ndarray]:
    return case.draw(side_px, np.random.default_rng([0, zlib.crc32(case.name.encode())]))


def sensor_of(case: Case) -> Instrument:
    """Return the shipped sensor, with the MTF of the case if it has one."""
    sensor = Sensor.load(SENSOR).nominal()
    return replace(
        sensor, mtf_nyquist={"MTF 0.1 %": 0.001, "MTF 60 %": 0.6}.get(case.name, sensor.mtf_nyquist)
    )


def radiance_of(image: np.ndarray, sensor: Instrument) -> np.ndarray:
    """Repeat each pixel as RATIO x RATIO scene pixels, in W/m2/sr/um."""
    fine = np.repeat(np.repeat(np.asarray(image, np.float32), RATIO, 0), RATIO, 1)
    return np.asarray(fine / np.float32(sensor.gain_dn_per_radiance))


def acquired(image: np.ndarray, sensor: Instrument) -> np.ndarray:
    scene = prepare_scene(radiance_of(image, sensor), RATIO)
    return acquire(scene, sensor, Draw(0), margin_px=0)


@named([*VALID, BY_NAME["beyond 12 bits"]])
def test_the_simulator_gives_digital_numbers_and_the_same_ones_again(case: Case) -> None:
    sensor = sensor_of(case)
    for image in images(case):
        dn = acquired(image, sensor)
        assert 0 <= dn.min() <= dn.max() <= FULL_DN
        assert np.array_equal(dn, np.rint(dn))
        assert np.array_equal(dn, acquired(image, sensor))
        torch.set_num_threads(2)
        assert np.array_equal(dn, acquired(image, sensor))
        torch.set_num_threads(1)


@named(VALID)
def test_the_signal_is_that_of_the_formulas(case: Case) -> None:
    """Before noise and digitization the mean is kept, and the kernel bounds ringing and gain."""
    sensor = sensor_of(case)
    for image in images(case):
        dn = signal(image, sensor)
        assert abs(dn.mean(dtype=np.float64) - image.mean(dtype=np.float64)) < FLOAT32_DN
        assert np.abs(dn - signal_by_formula(image, sensor)).max() < FLOAT32_DN
        kernel = ringing_of(sensor, scene_stats(radiance_of(image, sensor), RATIO))
        middle = (image.max() + image.min()) / 2
        reach = kernel * (image.max() - image.min()) / 2
        assert (np.abs(dn - middle) - reach).max() < FLOAT32_DN
        change = gain(lambda pixels: signal(pixels, sensor), image, dn, np.random.default_rng(0))
        assert change <= kernel + FLOAT32_DN


def signal(image: np.ndarray, sensor: Instrument) -> np.ndarray:
    radiance = radiance_of(image, sensor)
    height, width = radiance.shape
    sampled = sample(
        scene_spectrum(radiance), sensor_transfer(height, width, RATIO, sensor), width, RATIO
    )
    return np.asarray(sampled * np.float32(sensor.gain_dn_per_radiance))


def signal_by_formula(image: np.ndarray, sensor: Instrument) -> np.ndarray:
    """Transform the whole scene in float64, and sample it between two scene pixels."""
    radiance = radiance_of(image, sensor).astype(np.float64)
    fy, fx = (np.fft.fftfreq(side) for side in radiance.shape)
    response = mtf(RATIO * fx[None, :], RATIO * fy[:, None], sensor.mtf_axes)
    shift = np.exp(1j * np.pi * (RATIO - 1) * fy)[:, None] * np.exp(1j * np.pi * (RATIO - 1) * fx)
    blurred = np.fft.ifft2(np.fft.fft2(radiance) * response * shift).real
    return np.asarray(blurred[::RATIO, ::RATIO] * sensor.gain_dn_per_radiance)


@named(LOST)
def test_a_scene_that_lacks_pixels_is_refused(case: Case, tmp_path: Path) -> None:
    (image,) = images(case)
    tifffile.imwrite(tmp_path / "scene.tif", image * np.float32(1 / FULL_DN))
    with pytest.raises(BeersError):
        read_scene(tmp_path / "scene.tif", sensor_of(case))


TRADITIONAL = (
    "full scale",
    "hot pixel",
    "night",
    "NaN pixels",
    "1 x 1",
    "MTF 0.1 %",
    "beyond 12 bits",
)
GROUPS_DN = 200.0
"""The allowed change of a pixel: a change of the last bit can make NL-Bayes group other patches."""


@named([BY_NAME[name] for name in TRADITIONAL])
def test_the_traditional_pipeline_is_calm(case: Case) -> None:
    pipeline = TraditionalPipeline(sensor_of(case), Sensor.load(REFERENCE).nominal(), "fast")
    for image in images(case):
        result = restored(image, pipeline)
        valid = ~np.isnan(image)
        assert 0 <= result[valid].min() <= result[valid].max() <= FULL_DN
        assert np.array_equal(result, restored(image, pipeline), equal_nan=True)
        torch.set_num_threads(2)
        assert np.array_equal(result, restored(image, pipeline), equal_nan=True)
        torch.set_num_threads(1)
        strips = [torch.from_numpy(image[top : top + 13]) for top in range(0, len(image), 13)]
        joined = torch.cat(
            list(restore_strips(strips, len(image), pipeline.fitted_to(strips)))
        ).numpy()
        assert np.array_equal(result, joined, equal_nan=True)
        assert np.array_equal(result[~valid], image[~valid], equal_nan=True)
        if case.pixels == "valid":
            faithful(image, result, pipeline)


def faithful(image: np.ndarray, result: np.ndarray, pipeline: TraditionalPipeline) -> None:
    exact = restore_traditional(torch.from_numpy(image).double(), pipeline).numpy()
    change = gain(
        lambda pixels: restored(pixels, pipeline), image, result, np.random.default_rng(0)
    )
    assert ringing(result, image, 19, 100).holds
    assert change <= GROUPS_DN
    assert np.abs(result - exact).max() <= GROUPS_DN
    assert image.std() > 0 or abs(float(result.mean() - image.mean())) <= FLAT_DN


def restored(image: np.ndarray, pipeline: TraditionalPipeline) -> np.ndarray:
    return np.asarray(
        restore_traditional(torch.from_numpy(np.asarray(image, np.float32)), pipeline).numpy()
    )


def noisy(image: np.ndarray) -> np.ndarray:
    return np.asarray(image + NOISE_DN * np.random.default_rng(0).standard_normal(image.shape))


def both(image: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return the noisy image and the image, (1, 1, H, W) as fractions of full scale."""
    parts = (np.asarray(plane / FULL_DN, np.float32) for plane in (noisy(image), image))
    restored, reference = (torch.from_numpy(part)[None, None] for part in parts)
    return restored, reference


def with_gradient(restored: Tensor, reference: Tensor) -> tuple[float, Tensor]:
    image = restored.clone().requires_grad_()
    total = RestorationLoss()(image, reference)[0]
    (gradient,) = torch.autograd.grad(total, image)
    return float(total.detach()), gradient


@named([*VALID, BY_NAME["beyond 12 bits"]])
def test_the_loss_is_its_formula_and_its_gradient_is_bounded(case: Case) -> None:
    weights = RestorationLoss().weights
    for image in images(case):
        noisy_one, reference = both(image)
        for other in (noisy_one, reference):
            value, gradient = with_gradient(other, reference)
            repeated, gradient_again = with_gradient(other, reference)
            assert value == repeated
            assert torch.equal(gradient, gradient_again)
            exact = by_formula(weights, other.double(), reference.double())
            assert value == pytest.approx(exact, rel=1e-4, abs=1e-4 * NOISE_DN / FULL_DN)
            # A pixel moves each coefficient of an orthonormal FFT by at most 1 / sqrt(pixels), and
            # so the mean of their sizes. This is proven, not measured.
            allowed = 1 + weights.fft * math.sqrt(gradient.numel())
            assert gradient.numel() * float(gradient.abs().max()) <= allowed * (1 + 1e-4)


def by_formula(weights: LossWeights, restored: Tensor, reference: Tensor) -> float:
    difference = restored - reference
    spectrum = torch.fft.rfft2(difference, norm="ortho").abs().mean()
    return float(weights.l1 * difference.abs().mean() + weights.fft * spectrum)


@named(LOST)
def test_lost_pixels_give_no_number(case: Case) -> None:
    for image in images(case):
        assert not math.isfinite(with_gradient(*both(image))[0])
        other = np.clip(np.rint(noisy(image)), 0, FULL_DN).astype(np.float32)
        for metric in (psnr_db, ssim):
            assert not math.isfinite(metric(image, other, FULL_DN))


@named([case for case in VALID if min(images(case)[0].shape) >= MIN_SIDE_PX])
def test_ssim_is_bounded_symmetric_and_precise(case: Case) -> None:
    for image in images(case):
        other = np.clip(np.rint(noisy(image)), 0, FULL_DN).astype(np.float32)
        value = ssim(image, other, FULL_DN)
        assert abs(value) <= 1 + 1e-9
        assert ssim(image, image, FULL_DN) == pytest.approx(1, abs=1e-9)
        assert value == pytest.approx(
            ssim(image.astype(float), other.astype(float), FULL_DN), abs=1e-9
        )
        assert value == pytest.approx(ssim(other, image, FULL_DN), abs=1e-6)
        assert (
            abs(ssim(image, np.where(other < FULL_DN, other + 1, other - 1), FULL_DN) - value)
            < 0.05
        )
        assert math.isinf(psnr_db(image, image, FULL_DN))
