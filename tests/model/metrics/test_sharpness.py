import math
from functools import lru_cache

import numpy as np
import pytest
import torch

from model.metrics.edges import slanted_edge
from model.metrics.refusal import Refusal
from model.metrics.sharpness import EdgeMtf, edge_mtf
from model.simulator.detector import Draw, detect
from model.simulator.mtf import mtf, sensor_transfer, transfer_function
from model.simulator.sampling import sample, scene_spectrum
from profiles.errors import ImageError
from profiles.sensor import Sensor, noise_from_snr

RATIO, SCENE_PX, SIDE_PX, GAIN = 5, 240, 80, 10.2375
ALPHA, BETA = noise_from_snr(25, 50, 100, 110)
MTFS, ANGLES = (0.03, 0.07, 0.25), (2.0, 5.0, 8.0, 11.0, 15.0)
BIAS = {0.03: 0.005, 0.07: 0.005, 0.25: 0.01}
DRAWS = 50


@lru_cache
def clean(mtf_nyquist: float, angle_deg: float) -> torch.Tensor:
    """The middle of a simulated edge, where the second edge at the wrapped border no longer counts."""
    side = SCENE_PX * RATIO
    transfer = transfer_function(side, side, RATIO, mtf_nyquist)
    image = sample(scene_spectrum(slanted_edge(SCENE_PX, RATIO, angle_deg)), transfer, side, RATIO)
    start = (SCENE_PX - SIDE_PX) // 2
    return image[start : start + SIDE_PX, start : start + SIDE_PX]


def noisy(mtf_nyquist: float, angle_deg: float, seed: int) -> np.ndarray:
    sensor = Sensor(mtf_nyquist, ALPHA, BETA, GAIN, 12)
    return detect(clean(mtf_nyquist, angle_deg), sensor, Draw(seed), "degraded").numpy()


def measured(image: np.ndarray) -> EdgeMtf:
    result = edge_mtf(image, saturated=4095)
    assert isinstance(result, EdgeMtf), result
    return result


@pytest.mark.parametrize("angle_deg", [5.0, 11.0])
def test_a_sensor_of_two_axes_is_measured_at_both(angle_deg: float) -> None:
    """Edges upright and lying, acquired by one sensor: 12 % across the track, 5 % along it."""
    sensor, side = Sensor(0.12, 0.0, 0.0, GAIN, 12, {}, 0.05), SCENE_PX * RATIO
    transfer, upright = sensor_transfer(side, side, RATIO, sensor), slanted_edge(SCENE_PX, RATIO, angle_deg)
    middle = slice((SCENE_PX - SIDE_PX) // 2, (SCENE_PX + SIDE_PX) // 2)
    found = []
    for scene in (upright, upright.T.contiguous()):
        image = sample(scene_spectrum(scene), transfer, side, RATIO)[middle, middle]
        found.append(measured(image.numpy() * GAIN).mtf_nyquist)
    assert found == pytest.approx([0.12, 0.05], abs=0.005)


def refused(image: np.ndarray, noise_sigma: float | None = None, saturated: float | None = None) -> str:
    result = edge_mtf(image, noise_sigma, saturated)
    assert isinstance(result, Refusal)
    assert result.reason
    return result.status


def gaussian_edge(
    angle_deg: float, sigma_px: float, shape: tuple[int, int] = (80, 80), step: float = 1600
) -> np.ndarray:
    """An edge that owes nothing to the simulator: the error function along the normal."""
    angle = math.radians(angle_deg)
    y, x = (np.arange(size) - (size - 1) / 2 + 0.13 for size in shape)
    distance = x[None, :] * math.cos(angle) + y[:, None] * math.sin(angle)
    erf = torch.erf(torch.from_numpy(distance / (sigma_px * math.sqrt(2)))).numpy()
    return np.asarray(400 + step / 2 * (1 + erf))


@pytest.mark.parametrize("angle_deg", ANGLES)
@pytest.mark.parametrize("mtf_nyquist", MTFS)
def test_a_clean_edge_gives_the_simulated_mtf(mtf_nyquist: float, angle_deg: float) -> None:
    result = measured(clean(mtf_nyquist, angle_deg).numpy())
    assert result.mtf_nyquist == pytest.approx(mtf_nyquist, abs=0.002)
    assert result.angle_deg == pytest.approx(angle_deg, abs=0.01)
    angle = math.radians(angle_deg)
    f = torch.from_numpy(result.frequencies)
    expected = mtf(f * math.cos(angle), f * math.sin(angle), mtf_nyquist)
    np.testing.assert_allclose(result.mtf, expected, atol=0.006)


@pytest.mark.parametrize("angle_deg", ANGLES)
@pytest.mark.parametrize("mtf_nyquist", MTFS)
def test_noise_neither_biases_nor_escapes_the_interval(mtf_nyquist: float, angle_deg: float) -> None:
    results = [measured(noisy(mtf_nyquist, angle_deg, seed)) for seed in range(DRAWS)]
    assert np.mean([r.mtf_nyquist for r in results]) == pytest.approx(mtf_nyquist, abs=BIAS[mtf_nyquist])
    covered = [r.interval[0] <= mtf_nyquist <= r.interval[1] for r in results]
    assert np.mean(covered) >= 0.85


def test_another_mtf_would_fail_the_check_of_the_bias() -> None:
    results = [measured(noisy(0.085, 8.0, seed)).mtf_nyquist for seed in range(20)]
    assert abs(np.mean(results) - 0.07) > BIAS[0.07]


@pytest.mark.parametrize("angle_deg", [2.0, 5.0, 11.31, 14.04, 40.0])
@pytest.mark.parametrize("sigma_px", [0.4, 0.53, 0.8])
def test_a_gaussian_edge_gives_its_mtf_too(sigma_px: float, angle_deg: float) -> None:
    expected = math.exp(-2 * (math.pi * sigma_px * 0.5) ** 2)
    assert measured(gaussian_edge(angle_deg, sigma_px)).mtf_nyquist == pytest.approx(expected, abs=0.0015)


def test_sharpening_shows_as_much_as_it_does() -> None:
    """A filter of 3 taps across: gain 1 + b (1 - cos(2 pi f)) / 2, so 1 + b at Nyquist."""
    boost = 2.0
    before, after = [], []
    for seed in range(20):
        image = noisy(0.07, 5.0, seed).astype(np.float64)
        turned = (image[:, :-2] + image[:, 2:]) / 2 - image[:, 1:-1]
        before.append(measured(image).mtf_nyquist)
        after.append(measured(image[:, 1:-1] - boost / 2 * turned).mtf_nyquist)
    assert np.mean(after) == pytest.approx((1 + boost) * np.mean(before), rel=0.02)


def test_turned_mirrored_and_falling_edges_give_the_same_figure() -> None:
    image = noisy(0.07, 8.0, 3)[:77]
    results = [measured(view) for view in (image, image.T, image[:, ::-1], image[::-1], 2400 - image)]
    for result in results[1:]:
        assert result.mtf_nyquist == pytest.approx(results[0].mtf_nyquist, abs=1e-9)
        assert result.interval == pytest.approx(results[0].interval, abs=1e-9)


def test_the_unit_does_not_matter() -> None:
    image = noisy(0.25, 5.0, 0).astype(np.float64)
    assert measured(image / 4095).mtf_nyquist == pytest.approx(measured(image).mtf_nyquist, abs=1e-9)


@pytest.mark.parametrize("shape", [(25, 61), (47, 43), (101, 64), (31, 200)])
def test_odd_shapes(shape: tuple[int, int]) -> None:
    assert measured(gaussian_edge(8, 0.6, shape)).mtf_nyquist == pytest.approx(0.169, abs=0.01)


@pytest.mark.parametrize("angle_deg", [0.0, 1.0, 1.8, 44.5, 18.435, 26.565])
def test_a_useless_angle_is_refused(angle_deg: float) -> None:
    assert refused(gaussian_edge(angle_deg, 0.6, (120, 170))) == "angle"


def test_a_faint_edge_is_refused() -> None:
    noise = np.random.default_rng(0).standard_normal((80, 80))
    assert refused(gaussian_edge(8, 0.6, step=90) + 10 * noise) == "contrast"
    assert refused(400 + 10 * noise) == "contrast"
    assert refused(np.full((80, 80), 7.0)) == "contrast"
    assert refused(gaussian_edge(8, 0.6, step=90), noise_sigma=10) == "contrast"
    assert isinstance(edge_mtf(gaussian_edge(8, 0.6, step=130) + 10 * noise), EdgeMtf)


def test_clipped_plateaus_are_refused() -> None:
    image = gaussian_edge(8, 0.6)
    assert refused(np.minimum(image, 1990.0), saturated=1990) == "clipped"
    assert refused(np.maximum(image - 410, 0.0)) == "clipped"
    image[:2, 60:] = 2020  # 0.6 % of the pixels
    assert isinstance(edge_mtf(image, saturated=2020), EdgeMtf)


def test_too_few_rows_are_refused() -> None:
    for shape in ((19, 80), (80, 19), (80, 29), (1, 80), (0, 0)):
        assert refused(gaussian_edge(8, 0.6, shape)) == "few-rows"
    assert refused(gaussian_edge(8, 0.6)[:, 29:]) == "few-rows"


def test_what_is_no_straight_edge_is_refused() -> None:
    y, x = np.mgrid[:80, :80]
    bent = 400 + 1600 / (1 + np.exp(-(x - 40 - 6 * np.sin(y / 8)) / 0.5))
    assert refused(bent) == "no-convergence"


def test_a_pixel_that_is_not_finite_is_refused() -> None:
    for bad in (math.nan, math.inf):
        image = gaussian_edge(8, 0.6)
        image[3, 4] = bad
        assert refused(image) == "not-finite"


def test_two_bands_are_an_error() -> None:
    with pytest.raises(ImageError, match="one band"):
        edge_mtf(np.zeros((2, 80, 80)))


def test_the_target_has_its_two_radiances_and_its_edge_in_the_middle() -> None:
    scene = slanted_edge(40, 3, 8.0, (50.0, 90.0))
    assert scene.shape == (120, 120)
    assert scene.dtype == torch.float32
    assert float(scene[:, 0].mean()) == 50
    assert float(scene[:, -1].mean()) == 90
    assert float(scene.double().mean()) == pytest.approx(70, abs=1e-3)
