"""SNR of an image at given radiances, from the homogeneous areas in it (facts, metrics (b)).

1. Cut windows; fit a plane and slow waves to each. The waves' energy is structure, the rest's is noise.
2. Keep windows whose waves hold no more than the noise would put there: no look at the noise estimate itself, so
   that keeping the quiet ones does not bias it.
3. Fit variance = alpha L + beta to the rest's variance, with the weights that its own scatter calls for.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.metrics.noise_line import NoiseLine, fit_noise
from model.metrics.refusal import Refusal
from model.metrics.windows import cut_windows
from profiles.errors import ImageError, OptionError

RADIANCES = (25.0, 100.0)
WINDOW_PX, MIN_WINDOW_PX = 16, 8
NORMAL_90 = 1.6449


@dataclass(frozen=True)
class Snr:
    """Signal-to-noise ratio at one radiance.

    Attributes:
        radiance: W/m2/sr/um.
        value: L / sigma(L), a linear ratio.
        interval: 90 % interval of it.
        extrapolated: no window that was used lies so low or so high.
    """

    radiance: float
    value: float
    interval: tuple[float, float]
    extrapolated: bool


@dataclass(frozen=True)
class NoiseLevel:
    """The noise line of an image and what it means as SNR.

    Attributes:
        alpha: slope of the variance, W/m2/sr/um.
        beta: variance at radiance 0, (W/m2/sr/um)^2.
        snr: for each radiance asked for, or why there is none there.
        windows: how many windows were used.
        radiances: lowest and highest mean among them.
    """

    alpha: float
    beta: float
    snr: tuple[Snr | Refusal, ...]
    windows: int
    radiances: tuple[float, float]


def noise_level(
    image: np.ndarray,
    gain_dn_per_radiance: float = 1.0,
    saturated: float | None = None,
    window_px: int = WINDOW_PX,
    radiances: Sequence[float] = RADIANCES,
) -> NoiseLevel | Refusal:
    """Measure the noise that is in the pixels, the converter's rounding (1/12 DN^2) included.

    The noise must be white: what a filter or a network has smoothed has waves of its own, and is refused. Texture
    finer than the blur of a sensor would pass for noise; blurred texture does not. A natural scene of a few hundred
    pixels a side seldom has a flat window: expect refusals, and do not trust an extrapolated figure from few windows.

    Args:
        image: (H, W) digital numbers, or radiance with a gain of 1.
        gain_dn_per_radiance: DN per W/m2/sr/um.
        saturated: the value at which pixels clip, in the image's unit; None for none. They also clip at 0.
        window_px: side of a window, 8 or more; homogeneous areas must be twice as wide.
        radiances: where the SNR is wanted, W/m2/sr/um.

    Returns:
        The noise and the SNRs, or why there are none: "few-windows", "range", "no-noise".

    Raises:
        ImageError: not two axes.
        OptionError: a window too small to tell waves from noise.
    """
    if image.ndim != 2:
        remedy = "give one band"
        raise ImageError("noise level", expected="an image (H, W)", got=f"shape {image.shape}", remedy=remedy)
    if window_px < MIN_WINDOW_PX:
        expected, remedy = f"{MIN_WINDOW_PX} pixels or more", "give a larger one"
        raise OptionError("window_px", expected=expected, got=str(window_px), remedy=remedy)
    clipped_at = math.inf if saturated is None else saturated
    windows = cut_windows(image, window_px, clipped_at).scaled(1 / gain_dn_per_radiance)
    fit = fit_noise(windows)
    if isinstance(fit, Refusal):
        return fit
    alpha, beta = (float(c) for c in fit.line)
    snr = tuple(_snr(fit, float(radiance)) for radiance in radiances)
    return NoiseLevel(alpha, beta, snr, fit.windows.mean.size, _range(fit))


def _range(fit: NoiseLine) -> tuple[float, float]:
    return float(fit.windows.mean.min()), float(fit.windows.mean.max())


def _snr(fit: NoiseLine, radiance: float) -> Snr | Refusal:
    """The interval is that of the variance, carried over."""
    variance, reach = float(fit.at(radiance)), NORMAL_90 * fit.error(radiance)
    if variance <= reach:
        return Refusal("range", f"too far from the homogeneous areas to know the noise at {radiance:g} W/m2/sr/um")
    low, value, high = (radiance / math.sqrt(v) for v in (variance + reach, variance, variance - reach))
    darkest, brightest = _range(fit)
    return Snr(radiance, value, (low, high), not darkest <= radiance <= brightest)
