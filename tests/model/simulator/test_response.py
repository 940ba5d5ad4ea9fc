"""Tests of blurs by MTF tables and point-spread functions: contrast, position and radiance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from beers_deploy.model.metrics.slanted_edge import edge_mtf, slanted_edge
from beers_deploy.model.simulator.mtf import mtf, sensor_transfer, transfer_function
from beers_deploy.profiles.effects import AntiAlias, Smear
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.response import MtfTable, Response, centroid, unpacked
from tests.model.simulator import stages

GAIN = 10.2375
UNEVEN = (0.12, 0.05)
SIGMAS = 0.35, 0.5
BEHIND_0, BEHIND_1 = (math.exp(-2 * (math.pi * sigma * 0.5) ** 2) * 2 / math.pi for sigma in SIGMAS)
GAUSSIAN = BEHIND_0, BEHIND_1
MEASURED = MtfTable((0, 0.1, 0.3, 0.5, 0.8), (1, 0.85, 0.4, 0.15, 0.02), (1, 0.7, 0.2, 0.06, 0.01))

BLURS: dict[str, tuple[Response | tuple[float, float], tuple[float, float]]] = {
    "numbers": (UNEVEN, UNEVEN),
    "table": (MEASURED, (0.15, 0.06)),
    "formula's point, odd": (stages.formula_point(UNEVEN, 4, 64, odd=True), UNEVEN),
    "formula's point, even": (stages.formula_point(UNEVEN, 4, 64, odd=False), UNEVEN),
    "Gaussian and pixel, odd": (stages.gaussian_pixel(*SIGMAS, 8, 41), GAUSSIAN),
    "Gaussian and pixel, even": (stages.gaussian_pixel(*SIGMAS, 6, 32), GAUSSIAN),
    "lopsided": (stages.lopsided_point(), stages.lopsided_point().at_nyquist),
}


@pytest.mark.parametrize("name", [name for name in BLURS if name != "lopsided"])
def test_a_slanted_edge_shows_both_contrasts(name: str) -> None:
    blur, contrasts = BLURS[name]
    middle = slice(60, 140)
    scene = slanted_edge(200, 4, 5.0)
    upright, lying = (stages.blurred(s, 4, blur) for s in (scene, scene.T))
    assert [edge_mtf(image[middle, middle], 5.0) for image in (upright, lying.T)] == pytest.approx(
        contrasts, abs=0.005
    )


def lean(image: np.ndarray) -> float:
    """Return the mean product of the offsets down and right from the centroid, in square pixels."""
    down, right = (
        np.arange(n) - (n - 1) / 2 - middle
        for n, middle in zip(image.shape, centroid(image), strict=True)
    )
    return float(down @ image @ right / image.sum())


def test_a_sheared_point_stays_sheared() -> None:
    """The second moments of convolved functions add up, and the mixed moment of a blob is 0."""
    point = stages.lopsided_point()
    image = stages.blurred(stages.blob(192, 12.0), 4, point)
    expected = lean(unpacked(point)) / point.samples_per_px**2
    assert abs(expected) > 0.01
    assert lean(image.astype(np.float64)) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("ratio", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("name", BLURS)
def test_no_blur_shifts_a_blob_or_changes_its_light(name: str, ratio: int) -> None:
    blob = stages.blob(32 * ratio, 2.5 * ratio)
    image = stages.blurred(blob, ratio, BLURS[name][0])
    assert image.sum(dtype=np.float64) * ratio**2 == pytest.approx(float(blob.sum()), rel=1e-5)
    assert max(map(abs, centroid(image.astype(np.float64)))) < 0.01


@pytest.mark.parametrize("contrasts", [(0.07, 0.07), UNEVEN, (0.25, 0.3), (0.01, 0.2)])
@pytest.mark.parametrize("steps", [1, 5, 7])
def test_a_table_of_the_formula_is_the_formula(contrasts: tuple[float, float], steps: int) -> None:
    fx = np.linspace(-3, 3, 61)[None]
    fy = np.linspace(-2, 2, 47)[:, None]
    table = stages.formula_table(*contrasts, steps)
    assert_allclose(mtf(fx, fy, table), mtf(fx, fy, contrasts), rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("side", [64, 75])
@pytest.mark.parametrize("odd", [True, False])
def test_a_point_of_the_formula_gives_the_formulas_images(odd: bool, side: int) -> None:
    """At 3000 DN of contrast they agree best if the scene has the size of the point's window, 64
    pixels.

    Otherwise the tail beyond the window is missing. An even side has one row too many at one end,
    which moves the centroid by thousandths of a pixel.
    """
    ratio = 4
    point = stages.formula_point(UNEVEN, 4, 64, odd)
    radiance = 300 * np.random.default_rng(3).random((side * ratio, side * ratio), np.float32)
    radiance[: side * ratio // 2] *= 0.2
    expected, actual = (stages.blurred(radiance, ratio, blur) for blur in (UNEVEN, point))
    limit_dn = 5.0
    if side == 64:
        limit_dn = 0.2 if odd else 3.0
    assert np.abs(expected - actual).max() * GAIN < limit_dn


@pytest.mark.parametrize("name", BLURS)
def test_smear_multiplies_a_response_which_includes_the_antialias_filter(name: str) -> None:
    blur, _ = BLURS[name]
    transfer = transfer_function(30, 36, 3, blur, 0.0, 1.5)
    plain = transfer_function(30, 36, 3, blur)
    smear = np.sinc(1.5 * np.fft.fftfreq(30, 1 / 3))[:, None]
    assert_allclose(transfer, plain * smear, rtol=1e-5, atol=1e-7)
    if not isinstance(blur, tuple):
        sensor = stages.with_response(stages.plain_sensor(antialias=AntiAlias(0.1)), blur)
        with pytest.raises(OptionError, match="anti-alias filter"):
            sensor_transfer(30, 36, 3, sensor)
        smeared = replace(sensor, effects={"smear": Smear(1.5)})
        assert np.array_equal(sensor_transfer(30, 36, 3, smeared), transfer)
