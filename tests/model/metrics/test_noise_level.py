import math

import numpy as np
import pytest
import torch

from model.metrics.noise_level import NoiseLevel, Snr, noise_level
from model.metrics.refusal import Refusal
from model.simulator.detector import Draw, detect
from model.simulator.mtf import transfer_function
from model.simulator.sampling import sample, scene_spectrum
from profiles.errors import ImageError, OptionError
from profiles.sensor import Sensor, noise_from_snr

RATIO, CELLS, CELL_PX, GAIN, FULL_SCALE = 4, 6, 64, 10.2375, 4095
RADIANCES = (25.0, 100.0)
PAIRS = ((50.0, 110.0), (80.0, 170.0), (15.0, 50.0))
DRAWS = 50


def texture(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """1/f texture around 1, 12 % rms, like that of the drawn scenes."""
    radius = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    spectrum = np.fft.rfft2(rng.standard_normal((height, width))) / np.maximum(radius, 1 / 400)
    waves = np.fft.irfft2(spectrum, s=(height, width))
    return np.asarray(np.exp(0.12 * waves / waves.std()))


def field(textured: float, seed: int = 0, strength: float = 1.0) -> torch.Tensor:
    """Squares of many radiances, a share of them textured, seen through a sensor of MTF 7 %: (384, 384)."""
    rng = np.random.default_rng(seed)
    levels = rng.permutation(np.linspace(12, 220, CELLS**2)).reshape(CELLS, CELLS)
    rough = rng.random((CELLS, CELLS)) < textured
    square = np.ones((CELL_PX * RATIO, CELL_PX * RATIO))
    side = CELLS * CELL_PX * RATIO
    scene = np.kron(levels, square) * np.where(np.kron(rough, square) > 0, texture(side, side, rng) ** strength, 1)
    spectrum = scene_spectrum(torch.from_numpy(scene.astype(np.float32)))
    return sample(spectrum, transfer_function(side, side, RATIO, 0.07), side, RATIO)


def sensor(pair: tuple[float, float]) -> Sensor:
    return Sensor(0.07, *noise_from_snr(RADIANCES[0], pair[0], RADIANCES[1], pair[1]), GAIN, 12)


def seen(signal: torch.Tensor, pair: tuple[float, float], seed: int) -> np.ndarray:
    return detect(signal, sensor(pair), Draw(seed), "degraded").numpy()


def truth(pair: tuple[float, float]) -> list[float]:
    """The rounding is in the numbers, so it is in the truth."""
    return [L / math.hypot(sensor(pair).noise_sigma(L), math.sqrt(1 / 12) / GAIN) for L in RADIANCES]


def measured(dn: np.ndarray) -> NoiseLevel:
    result = noise_level(dn, GAIN, FULL_SCALE)
    assert isinstance(result, NoiseLevel), result
    return result


def snrs(dn: np.ndarray) -> list[Snr]:
    found = [snr for snr in measured(dn).snr if isinstance(snr, Snr)]
    assert len(found) == len(RADIANCES)
    return found


def refused(image: np.ndarray, gain: float = GAIN) -> str:
    result = noise_level(image, gain, FULL_SCALE)
    assert isinstance(result, Refusal)
    assert result.reason
    return result.status


def steps(shape: tuple[int, int], levels: int = 8) -> np.ndarray:
    """Flat stripes from 200 to 2200 DN."""
    level = np.arange(shape[1]) * levels // shape[1]
    return np.broadcast_to(200 + 2000 * level / (levels - 1), shape).copy()


@pytest.mark.parametrize("pair", PAIRS)
def test_the_snr_and_its_interval_are_right(pair: tuple[float, float]) -> None:
    signal = field(textured=0.4)
    draws = [snrs(seen(signal, pair, seed)) for seed in range(DRAWS)]
    for k, true in enumerate(truth(pair)):
        found = [draw[k] for draw in draws]
        assert np.mean([snr.value for snr in found]) == pytest.approx(true, rel=0.03)
        assert np.mean([snr.interval[0] <= true <= snr.interval[1] for snr in found]) >= 0.85
    assert not any(bright.extrapolated for _, bright in draws)


@pytest.mark.parametrize("pair", PAIRS)
def test_pure_texture_is_refused(pair: tuple[float, float]) -> None:
    signal = field(textured=1.1)
    assert {refused(seen(signal, pair, seed)) for seed in range(5)} == {"few-windows"}


@pytest.mark.parametrize("window_px", [8, 16])
def test_faint_texture_is_refused_or_does_no_harm(window_px: int) -> None:
    """1.2 % rms everywhere: some windows look flat by chance."""
    signal, pair = field(textured=1.1, strength=0.1), PAIRS[2]
    for seed in range(6):
        result = noise_level(seen(signal, pair, seed), GAIN, FULL_SCALE, window_px)
        if isinstance(result, NoiseLevel):
            found = [snr.value for snr in result.snr if isinstance(snr, Snr)]
            assert found == pytest.approx(truth(pair), rel=0.06)


def test_a_ramp_is_no_noise() -> None:
    """1 DN per pixel; the raw deviation of a window of 16 would be 8 DN instead of 5."""
    rng = np.random.default_rng(0)
    image = steps((320, 320)) + np.arange(320)[:, None] + 5 * rng.standard_normal((320, 320))
    result = noise_level(image, radiances=(1000,))
    assert isinstance(result, NoiseLevel)
    (snr,) = result.snr
    assert isinstance(snr, Snr)
    assert snr.value == pytest.approx(1000 / 5, rel=0.03)
    raw = image[:320, :40].reshape(20, 16, 40)[:, :, :16].std(axis=(1, 2), ddof=1).mean()
    assert 1000 / raw < 0.8 * snr.value


def test_choosing_the_quiet_windows_does_not_make_them_quieter() -> None:
    """Noise alone: half of the windows go, and the variance must stay."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(20):
        result = noise_level(steps((320, 640)) + 5 * rng.standard_normal((320, 640)), radiances=(1000,))
        assert isinstance(result, NoiseLevel)
        assert 0.3 < result.windows / 800 < 0.7
        found.append(result.alpha * 1000 + result.beta)
    assert np.mean(found) == pytest.approx(25, rel=0.01)


def test_a_radiance_beyond_the_windows_is_flagged() -> None:
    dn = seen(field(textured=0.0), PAIRS[0], 0)
    result = noise_level(dn, GAIN, FULL_SCALE, radiances=(100, 390))
    assert isinstance(result, NoiseLevel)
    assert [isinstance(snr, Snr) and snr.extrapolated for snr in result.snr] == [False, True]


def test_a_radiance_too_far_away_has_no_figure() -> None:
    rng = np.random.default_rng(0)
    bright = 5000 + steps((256, 256))
    image = bright + np.sqrt(bright - 4900) * rng.standard_normal(bright.shape)
    result = noise_level(image, radiances=(6000, 25))
    assert isinstance(result, NoiseLevel)
    near, far = result.snr
    assert isinstance(near, Snr)
    assert isinstance(far, Refusal)
    assert far.status == "range"


def test_dn_with_a_gain_and_radiance_are_the_same() -> None:
    dn = seen(field(textured=0.4), PAIRS[0], 0)
    first, second = noise_level(dn, GAIN, FULL_SCALE), noise_level(dn / GAIN, saturated=FULL_SCALE / GAIN)
    assert isinstance(first, NoiseLevel)
    assert isinstance(second, NoiseLevel)
    assert second.alpha == pytest.approx(first.alpha, rel=1e-5)
    assert second.windows == first.windows


def test_clipped_and_missing_pixels_are_left_out() -> None:
    rng = np.random.default_rng(3)
    image = np.rint(steps((321, 487)) + 5 * rng.standard_normal((321, 487)))
    whole = measured(image)
    image[:, 435:] = FULL_SCALE
    image[:16] = 0
    image[40, 40] = math.nan
    part = measured(image)
    assert part.windows < whole.windows
    assert part.radiances[1] < 210 < whole.radiances[1]
    assert part.alpha * 100 + part.beta == pytest.approx(whole.alpha * 100 + whole.beta, rel=0.05)


@pytest.mark.parametrize("window_px", [8, 11, 32])
def test_other_windows_agree(window_px: int) -> None:
    rng = np.random.default_rng(4)
    image = steps((512, 768), 4) + 5 * rng.standard_normal((512, 768))
    result = noise_level(image, window_px=window_px, radiances=(1000,))
    assert isinstance(result, NoiseLevel)
    assert result.alpha * 1000 + result.beta == pytest.approx(25, rel=0.04)


def test_what_cannot_be_measured_is_refused() -> None:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((200, 200))
    assert refused(1000 + 5 * noise) == "range"
    assert refused(np.full((200, 200), 1000.0)) == "no-noise"
    assert refused(steps((200, 200))) == "no-noise"
    assert refused(steps((40, 40)) + 5 * noise[:40, :40]) == "few-windows"
    assert refused(np.zeros((200, 200))) == "few-windows"
    assert refused(np.zeros((0, 7))) == "few-windows"


def test_smoothed_noise_is_refused() -> None:
    """What a denoiser leaves is no white noise: its fine part alone would flatter it."""
    noise = 10 * np.random.default_rng(6).standard_normal((320, 320))
    smooth = sum(np.roll(noise, (y, x), (0, 1)) for y in range(3) for x in range(3)) / 9
    assert refused(steps((320, 320)) + smooth) == "few-windows"


def test_bad_arguments_are_errors() -> None:
    with pytest.raises(ImageError, match="one band"):
        noise_level(np.zeros((2, 80, 80)))
    with pytest.raises(OptionError, match="8 pixels"):
        noise_level(np.ones((80, 80)), window_px=4)
