"""Tests that the list in traps.md is complete, and tests of traps that no other file has."""

import math
import re

import numpy as np
import pytest
import torch
from torch import Tensor

from beers_deploy.model.metrics.fidelity import psnr_db
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
from tests.project_files import text_of

TRAPS = 18
ROWS = re.findall(r"^\| \d+ \|.*", text_of("tests/stability/traps.md"), re.MULTILINE)
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


@pytest.mark.parametrize("number", range(1, TRAPS + 1))
def test_every_trap_has_tests_that_exist(number: int) -> None:
    assert len(ROWS) == TRAPS
    row = ROWS[number - 1]
    assert row.startswith(f"| {number} |")
    named = NAMED.findall(row)
    assert named
    for path, name in named:
        assert re.search(rf"^def {name}\(", text_of(path), re.MULTILINE), name


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


@pytest.mark.parametrize("order", ["denoise-first", "deconvolve-first"])
def test_trap_13_infinity_is_no_missing_pixel(order: Order) -> None:
    image = torch.full((12, 12), 300.0)
    image[5, 5] = torch.inf
    degraded = Sensor.load("pleiades-degraded").nominal()
    reference = Sensor.load("pleiades-reference").nominal()
    with pytest.raises(ImageError, match="infinity"):
        restore_traditional(image, TraditionalPipeline(degraded, reference, "fast", order))


@pytest.mark.parametrize("pixel", [np.nan, np.inf, -np.inf])
def test_trap_15_no_psnr_of_pixels_that_are_lost(pixel: float) -> None:
    image = np.full((12, 12), 5.0)
    image[3, 3] = pixel
    assert math.isnan(psnr_db(image, np.zeros((12, 12)), 4095))


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
