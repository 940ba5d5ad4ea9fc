import math
from functools import lru_cache

import numpy as np
import pytest

from beers_deploy.model.metrics.noise_blocks import Blocks, cut_blocks, join
from beers_deploy.model.metrics.noise_line import NoiseModel, fit_noise
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.simulator.acquire import PreparedScene, acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.instrument import Instrument, noise_from_snr

RATIO = 4
GAIN = 10.2375
MAX_DN = 4095
PAIRS = ((50.0, 110.0), (80.0, 170.0), (20.0, 45.0))
RADIANCES = (25.0, 100.0)


@lru_cache
def scenes() -> list[PreparedScene]:
    """Return two procedural landscapes without any flat area."""
    generators = np.random.default_rng(7).spawn(2)
    return [prepare_scene(procedural_scene(1280, 1280, g).radiance, RATIO) for g in generators]


def acquired_blocks(pair: tuple[float, float], seed: int, mtf_nyquist: float = 0.07) -> Blocks:
    alpha, beta = noise_from_snr(RADIANCES[0], pair[0], RADIANCES[1], pair[1])
    sensor = Instrument(mtf_nyquist, alpha, beta, GAIN, 12)
    images = [acquire(scene, sensor, Draw(seed, k)) for k, scene in enumerate(scenes())]
    return join([cut_blocks(image, MAX_DN) for image in images])


def model(blocks: Blocks, incomplete: bool = False) -> NoiseModel:
    fit = fit_noise(blocks, incomplete)
    assert isinstance(fit, NoiseModel), fit
    return fit


@pytest.mark.parametrize("pair", PAIRS)
def test_the_noise_of_a_textured_landscape_is_right(pair: tuple[float, float]) -> None:
    models = [model(acquired_blocks(pair, seed)) for seed in range(3)]
    covered = []
    for radiance, snr in zip(RADIANCES, pair, strict=True):
        true = (radiance * GAIN / snr) ** 2
        at = [line.at(radiance * GAIN) for line in models]
        assert np.mean([math.sqrt(v.value / true) for v in at]) == pytest.approx(1, abs=0.07)
        covered += [v.interval[0] <= true <= v.interval[1] for v in at]
    assert np.mean(covered) > 0.8


def plain(shape: tuple[int, int] = (320, 320), low: float = 200, high: float = 2200) -> np.ndarray:
    """Return stripes of eight levels, each 40 pixels wide in an image of 320 columns."""
    level = np.arange(shape[1]) * 8 // shape[1]
    return np.broadcast_to(low + (high - low) * level / 7, shape).copy()


def noisy(sigma: float, image: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    image = plain() if image is None else image
    return np.asarray(
        np.rint(image + sigma * np.random.default_rng(seed).standard_normal(image.shape))
    )


@pytest.mark.parametrize("sigma", [0.6, 5.0])
def test_the_variance_of_rounding_is_subtracted(sigma: float) -> None:
    models = [model(cut_blocks(noisy(sigma, seed=seed), MAX_DN)) for seed in range(5)]
    assert np.mean([line.at(1000).value for line in models]) == pytest.approx(sigma**2, rel=0.03)
    assert models[0].total(np.array(1000.0)) == pytest.approx(sigma**2 + 1 / 12, rel=0.1)


def test_beyond_the_blocks_the_interval_is_wider() -> None:
    line = model(cut_blocks(noisy(5.0), MAX_DN))
    inside = line.at(1000)
    outside = line.at(40)
    assert (inside.extrapolated, outside.extrapolated) == (False, True)
    assert np.ptp(outside.interval) > 1.5 * np.ptp(inside.interval)


def test_clipped_pixels_are_left_out() -> None:
    image = noisy(5.0)
    unclipped = model(cut_blocks(image, MAX_DN))
    image[:, 275:] = MAX_DN
    image[:20] = 0
    part = model(cut_blocks(image, MAX_DN))
    assert part.blocks < unclipped.blocks
    assert part.measured_dn[1] < 2000 < unclipped.measured_dn[1]
    assert part.at(1000).value == pytest.approx(25, rel=0.08)


def refused(image: np.ndarray) -> str:
    outcome = fit_noise(cut_blocks(image, MAX_DN))
    assert isinstance(outcome, Refusal), outcome
    return outcome.reason


def test_noise_that_cannot_be_measured_is_refused() -> None:
    assert "rounding alone adds" in refused(np.rint(plain()))
    assert "rounding alone adds" in refused(noisy(0.1))
    assert "too narrow" in refused(noisy(5.0, plain(low=1000, high=1100)))
    assert "16 blocks" in refused(noisy(5.0, plain((64, 64))))
    assert "0 blocks" in refused(np.zeros((320, 320)))
    assert "0 blocks" in refused(np.zeros((3, 0)))


def test_texture_as_sharp_as_a_pixel_is_refused() -> None:
    """The texture of a photograph that no instrument has blurred would pass for noise."""
    rng = np.random.default_rng(8)
    radius = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.rfftfreq(512)[None, :])
    waves = np.fft.irfft2(
        np.fft.rfft2(rng.standard_normal((512, 512))) / np.maximum(radius, 1 / 100), s=(512, 512)
    )
    assert "texture" in refused(np.rint(plain((512, 512)) * np.exp(0.2 * waves / waves.std())))


def test_noise_of_one_level_is_photon_noise_with_an_interval_that_holds_a_constant() -> None:
    """Sky behind stars, or a flat field, does not show how the noise grows with light."""
    generator = np.random.default_rng(5)
    flat = generator.normal(800, 20, (320, 320))
    assert isinstance(fit_noise(cut_blocks(flat, MAX_DN)), Refusal)
    line = model(cut_blocks(flat, MAX_DN), incomplete=True)
    assert line.one_level
    assert line.at(800).value == pytest.approx(400, rel=0.05)
    bright = line.at(3200)
    assert bright.value == pytest.approx(1600, rel=0.05)
    assert bright.interval[0] <= 400 * 1.05


@pytest.mark.parametrize(
    ("kernel", "stronger"), [((0.2, 0.6, 0.2), "middle"), ((-0.25, 1.0, -0.25), "finest")]
)
def test_coloured_noise_is_described_by_its_stronger_part(
    kernel: tuple[float, float, float], stronger: str
) -> None:
    generator = np.random.default_rng(6)
    level = np.linspace(300, 3000, 320)[:, None] * np.ones(320)
    white = generator.normal(0, 1, (322, 322)) * 30
    rows = np.sum([weight * white[i : i + 320] for i, weight in enumerate(kernel)], axis=0)
    coloured = np.sum([weight * rows[:, i : i + 320] for i, weight in enumerate(kernel)], axis=0)
    image = level + coloured
    assert isinstance(fit_noise(cut_blocks(image, MAX_DN)), Refusal)
    line = model(cut_blocks(image, MAX_DN), incomplete=True)
    assert not line.white
    assert (line.colour > 1) == (stronger == "middle")
    assert (np.diff(line.spectrum) < 0).all() == (stronger == "middle")


def test_a_mosaic_of_unequal_channels_is_refused() -> None:
    generator = np.random.default_rng(7)
    channels = (
        np.kron(np.ones((160, 160)), [[1.0, 0.6], [0.6, 0.4]])
        * np.linspace(300, 3000, 320)[:, None]
    )
    outcome = fit_noise(cut_blocks(generator.poisson(channels), MAX_DN), incomplete=True)
    assert isinstance(outcome, Refusal)
    assert "mosaic" in outcome.reason


def test_parts_of_different_images_have_different_numbers() -> None:
    """The interval counts parts. Two images that share a number would count as one."""
    generator = np.random.default_rng(0)
    images = [100 + generator.normal(0, 5, (150, side)) for side in (90, 200)]
    blocks = [cut_blocks(image, 4095) for image in images]
    first, second = (set(each.part.tolist()) for each in blocks)
    assert len(set(join(blocks).part.tolist())) == len(first) + len(second)
