import math
from functools import lru_cache

import numpy as np
import pytest
from scipy.special import erf

from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import edge_mtf, slanted_edge
from beers_deploy.model.simulator.detector import Draw, detect
from beers_deploy.profiles.instrument import Instrument, noise_from_snr
from tests.model.simulator.stages import blurred

RATIO = 5
SCENE_PX = 240
SIDE_PX = 80
GAIN = 10.2375
ANGLE_DEG = 8.0
ALPHA, BETA = noise_from_snr(25, 50, 100, 110)
MIDDLE = slice((SCENE_PX - SIDE_PX) // 2, (SCENE_PX + SIDE_PX) // 2)


@lru_cache
def clean(mtf_nyquist: float, angle_deg: float) -> np.ndarray:
    """Return the middle of a simulated edge, far from the second edge at the wrapped border."""
    scene = slanted_edge(SCENE_PX, RATIO, angle_deg)
    return blurred(scene, RATIO, mtf_nyquist)[MIDDLE, MIDDLE]


def noisy(mtf_nyquist: float, angle_deg: float, seed: int) -> np.ndarray:
    sensor = Instrument(mtf_nyquist, ALPHA, BETA, GAIN, 12)
    return detect(clean(mtf_nyquist, angle_deg), sensor, Draw(seed), "degraded")


def measured(image: np.ndarray, angle_deg: float = ANGLE_DEG) -> float:
    result = edge_mtf(image, angle_deg, saturated=4095)
    assert isinstance(result, float), result
    return result


def refused(image: np.ndarray, saturated: float = math.inf) -> str:
    result = edge_mtf(image, ANGLE_DEG, saturated)
    assert isinstance(result, Refusal)
    return result.reason


def gaussian_edge(
    angle_deg: float, sigma_px: float, shape: tuple[int, int] = (80, 80)
) -> np.ndarray:
    """Return an edge independent of the simulator: an error function, 0.13 px off the middle."""
    angle = math.radians(angle_deg)
    y, x = (np.arange(size) - (size - 1) / 2 + 0.13 for size in shape)
    distance = x[None, :] * math.cos(angle) + y[:, None] * math.sin(angle)
    return np.asarray(400 + 800 * (1 + erf(distance / (sigma_px * math.sqrt(2)))))


@pytest.mark.parametrize("angle_deg", [2.0, 15.0])
@pytest.mark.parametrize(("mtf_nyquist", "bias"), [(0.03, 0.003), (0.25, 0.005)])
def test_noise_does_not_bias(mtf_nyquist: float, bias: float, angle_deg: float) -> None:
    results = [measured(noisy(mtf_nyquist, angle_deg, seed), angle_deg) for seed in range(50)]
    assert np.mean(results) == pytest.approx(mtf_nyquist, abs=bias)


@pytest.mark.parametrize("angle_deg", [3.0, 5.0, 11.31, 14.04])
@pytest.mark.parametrize("sigma_px", [0.4, 0.53, 0.8])
def test_a_gaussian_edge_gives_its_mtf_wherever_it_lies(sigma_px: float, angle_deg: float) -> None:
    """Bins are one-sided at 1 / 4 pixel a row, and a restoration may have moved its image."""
    expected = math.exp(-2 * (math.pi * sigma_px * 0.5) ** 2)
    image = gaussian_edge(angle_deg, sigma_px, (80, 84))
    for crop in (image[:, 2:-2], image[:, 1:-3], image[:, 3:-1]):
        assert measured(crop, angle_deg) == pytest.approx(expected, abs=0.002)


def test_an_edge_that_cannot_be_measured_is_refused() -> None:
    edge = gaussian_edge(ANGLE_DEG, 0.6)
    generator = np.random.default_rng(0)
    assert "10 times are needed" in refused(edge + 170 * generator.standard_normal(edge.shape))
    assert "does not rise" in refused(np.full((80, 80), 700.0))
    assert "does not rise" in refused(edge[:, ::-1])
    assert "off its place" in refused(np.roll(edge, 8, axis=1))
    assert "are clipped" in refused(edge, saturated=1990)
    assert "are clipped" in refused(np.maximum(edge - 410, 0.0))
    for bad in (math.nan, math.inf):
        edge[3, 4] = bad
        assert "not finite" in refused(edge)


def test_the_target_has_its_two_radiances_and_its_edge_in_the_middle() -> None:
    scene = slanted_edge(40, 3, 8.0, (50.0, 90.0))
    assert scene.shape == (120, 120)
    assert scene.dtype == np.float32
    assert float(scene[:, 0].mean()) == 50
    assert float(scene[:, -1].mean()) == 90
    assert scene.mean(dtype=np.float64) == pytest.approx(70, abs=1e-3)
