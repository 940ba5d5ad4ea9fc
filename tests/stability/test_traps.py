"""Tests that the list in traps.md is complete, and controls in which the naive formula fails."""

import math
import re
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.mtf import gamma_from_mtf, mtf
from beers_deploy.model.traditional.noise import Noise
from beers_deploy.model.traditional.patch_groups import (
    QUALITIES,
    estimate_groups,
    first_pass,
    second_pass,
)
from beers_deploy.model.traditional.pipeline import Order, TraditionalPipeline, restore_traditional
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.sensor import Sensor
from tests.model.traditional.whole import compensate
from tests.project_files import ROOT

TRAPS = 18
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def trap_rows(page: str) -> dict[int, list[tuple[str, str]]]:
    """Return the tests that each numbered row of the table names."""
    lines = [line for line in page.splitlines() if re.match(r"\| \d+ \|", line)]
    return {int(line.split("|")[1]): NAMED.findall(line) for line in lines}


def missing_tests(rows: dict[int, list[tuple[str, str]]]) -> list[str]:
    """Return the rows without a test, and the tests that do not exist."""
    absent = [f"{number} has no test" for number, tests in rows.items() if not tests]
    for path, name in chain.from_iterable(rows.values()):
        file = ROOT / path
        if not file.is_file() or not re.search(
            rf"^def {name}\(", file.read_text(encoding="utf-8"), re.MULTILINE
        ):
            absent.append(f"{path}::{name}")
    return absent


def test_every_trap_has_a_test_and_every_test_is_there() -> None:
    rows = trap_rows((Path(__file__).parent / "traps.md").read_text(encoding="utf-8"))
    assert list(rows) == list(range(1, TRAPS + 1))
    assert missing_tests(rows) == []


@pytest.mark.parametrize(
    ("mtf_nyquist", "diagonal"), [(0.07, 0.0179), (0.25, 0.108), (0.001, 4.4e-5)]
)
def test_trap_2_the_diagonal_is_no_product_of_the_axes(mtf_nyquist: float, diagonal: float) -> None:
    value = float(mtf(0.5, 0.5, mtf_nyquist))
    assert value == pytest.approx(diagonal, rel=0.01)
    # Blurring rows and columns separately would leave the product of both contrasts.
    assert value > 1.5 * mtf_nyquist**2


def test_trap_3_a_filter_and_an_uncalibrated_blur_leave_half() -> None:
    assert float(mtf(0.5, 0.0, 0.07, 0.4)) == pytest.approx(0.07, rel=1e-9)
    filter_gain = math.exp(-2 * (math.pi * 0.4 * 0.5) ** 2)
    assert float(mtf(0.5, 0.0, 0.07)) * filter_gain == pytest.approx(0.032, abs=5e-4)


def contrast_of_cut_kernel(radius_px: int, frequency: float, side: int = 512) -> float:
    """Return the MTF at a frequency of the 7 % kernel, cut at a radius and divided by its sum."""
    fy = np.fft.fftfreq(side)[:, None]
    fx = np.fft.rfftfreq(side)
    kernel = np.roll(np.fft.irfft2(mtf(fx, fy, 0.07), (side, side)), (side // 2, side // 2), (0, 1))
    inside = slice(side // 2 - radius_px, side // 2 + radius_px + 1)
    cut = kernel[inside, inside] / kernel[inside, inside].sum()
    x = np.arange(-radius_px, radius_px + 1)
    return float((cut.sum(0) * np.cos(2 * math.pi * frequency * x)).sum())


def test_trap_6_a_cut_kernel_is_sharper_than_its_profile() -> None:
    true = float(mtf(0.1, 0.0, 0.07))
    assert true == pytest.approx(0.6325, abs=1e-3)
    assert contrast_of_cut_kernel(3, 0.1) > 1.2 * true
    assert contrast_of_cut_kernel(64, 0.1) == pytest.approx(true, abs=0.01)


def test_trap_8_without_the_clamp_ringing_gives_nan() -> None:
    below = torch.tensor(-50.0)
    sensor = Sensor.load("pleiades-degraded").nominal()
    assert bool((sensor.alpha * below + sensor.beta).sqrt().isnan())


@pytest.mark.parametrize(("mtf_nyquist", "largest"), [(0.07, 56), (0.03, 186), (0.01, 878)])
def test_trap_10_a_full_inverse_blows_up(mtf_nyquist: float, largest: float) -> None:
    assert 1 / float(mtf(0.5, 0.5, mtf_nyquist)) == pytest.approx(largest, rel=0.02)
    assert gamma_from_mtf(1e-4) < 20


def groups(kind: str) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    # A covariance of 25 pixels from 15 patches has no full rank.
    if kind == "few":
        return 100 + 12 * torch.randn(1, 15, 25, generator=generator)
    return torch.full((1, 35, 25), 4095.0 if kind == "saturated" else 0.0)


@pytest.mark.parametrize("kind", ["few", "saturated", "black"])
def test_trap_13_a_bare_covariance_has_no_factor_and_the_estimate_is_finite(kind: str) -> None:
    patches = groups(kind)
    noise = Noise(12.0)
    centred = (patches - patches.mean(1, keepdim=True)).double()
    covariance = centred.mT @ centred / patches.shape[1]
    assert int(torch.linalg.cholesky_ex(covariance)[1]) != 0
    for settings in (first_pass(12.0), second_pass(12.0, QUALITIES["fast"])):
        estimate = estimate_groups(patches, patches, None, noise, settings)
        assert bool(torch.isfinite(estimate).all())


def test_trap_13_infinity_is_no_missing_pixel() -> None:
    image = torch.full((12, 12), 300.0)
    image[5, 5] = torch.inf
    sensors = (Sensor.load(name).nominal() for name in ("pleiades-degraded", "pleiades-reference"))
    degraded, reference = sensors
    orders: tuple[Order, Order] = ("denoise-first", "deconvolve-first")
    for order in orders:
        with pytest.raises(ImageError, match="infinity"):
            restore_traditional(image, TraditionalPipeline(degraded, reference, "fast", order))


def test_trap_15_the_variance_in_float32_comes_out_negative() -> None:
    rng = np.random.default_rng(0)
    image, other = (4000 + 0.5 * rng.standard_normal((64, 64)).astype(np.float32) for _ in range(2))
    x = torch.from_numpy(image)[None, None]
    mean, square = (torch.nn.functional.avg_pool2d(values, 7, 1) for values in (x, x * x))
    assert float((square - mean * mean).min()) < 0
    assert -1 <= ssim(image, other, 1.0) <= 1
    assert ssim(image, other, 255.0) == pytest.approx(
        ssim(image.astype(np.float64), other.astype(np.float64), 255.0), abs=1e-9
    )


@pytest.mark.parametrize("pixel", [np.nan, np.inf, -np.inf])
def test_trap_15_no_psnr_of_pixels_that_are_lost(pixel: float) -> None:
    image = np.full((12, 12), 5.0)
    image[3, 3] = pixel
    assert math.isnan(psnr_db(image, np.zeros((12, 12)), 4095))


def test_trap_17_a_plain_cast_wraps_around() -> None:
    dn = np.array([-1.0, 70_000.0], np.float32)
    assert dn.astype(np.int64).astype(np.uint16).tolist() == [65535, 4464]
    assert to_uint16(dn).tolist() == [0, 65535]


def test_trap_18_one_generator_for_all_would_change_every_draw() -> None:
    def noise(first: bool) -> np.ndarray:
        shared = np.random.default_rng(0)
        if first:
            # The other run skips this effect, which moves all later draws.
            shared.standard_normal(5)
        return shared.standard_normal(4)

    assert not np.array_equal(noise(True), noise(False))
    alone = Draw(0).generator("noise-degraded").standard_normal(4)
    Draw(0).generator("prnu-degraded").standard_normal(5)
    np.testing.assert_array_equal(alone, Draw(0).generator("noise-degraded").standard_normal(4))


def test_threads_change_no_bit_of_the_compensation() -> None:
    """Threads change the order of sums in an FFT: here by 0.0002 W/m2/sr/um (measured)."""
    image = torch.from_numpy(np.random.default_rng(0).uniform(0, 400, (96, 96)).astype(np.float32))[
        :60, :71
    ]
    results = []
    for threads in (1, 2, 3):
        # The fixture restores the number of threads.
        torch.set_num_threads(threads)
        results.append(compensate(image, 0.07, 0.25, epsilon=0.004))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])
