"""SNR of an image at given radiances, from the homogeneous areas in it.

1. Cut windows; fit a plane and slow waves to each. The waves' energy is structure, the rest's is noise.
2. Keep windows whose waves hold no more than the noise would put there: no look at the noise estimate itself, so
   that keeping the quiet ones does not bias it.
3. Fit variance = alpha L + beta to the rest's variance, with the weights that its own scatter calls for.

scikit-image's `estimate_sigma` gives one sigma for all radiances of an image, and counts texture as noise: 20 DN in
a photograph of 12 bits that none was added to, and that is refused here (measured).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.metrics.bootstrap import NORMAL_90
from model.metrics.refusal import Refusal
from profiles.errors import ImageError, OptionError

SLOW, FINE = 0.2, 0.35
"""Cycles per pixel. A blur leaves little texture above SLOW (MTF 7 %: 0.39 of it) and less above FINE (0.18)."""


@dataclass(frozen=True)
class Windows:
    """N windows of n * n pixels.

    Attributes:
        mean: (N,) in the image's unit.
        structure: (N,) mean square of the slow waves, per degree of freedom: the variance where there is only noise.
        variance: (N,) unbiased variance of what plane and waves leave.
        middle: (N,) that of it between SLOW and FINE: as much for white noise, more for texture.
        degrees: degrees of freedom of structure, variance and middle.
    """

    mean: np.ndarray
    structure: np.ndarray
    variance: np.ndarray
    middle: np.ndarray
    degrees: tuple[int, int, int]

    def only(self, chosen: np.ndarray) -> "Windows":
        """The windows that `chosen`, (N,) of bool, is true for."""
        structure, variance, middle = (x[chosen] for x in (self.structure, self.variance, self.middle))
        return Windows(self.mean[chosen], structure, variance, middle, self.degrees)

    def scaled(self, factor: float) -> "Windows":
        """The same windows in another unit: means times `factor`, variances times its square."""
        structure, variance, middle = (x * factor**2 for x in (self.structure, self.variance, self.middle))
        return Windows(self.mean * factor, structure, variance, middle, self.degrees)


def cut_windows(image: np.ndarray, side_px: int, clipped_at: float) -> Windows:
    """Cut (H, W) into squares side by side, without those that hold a clipped or a non-finite pixel.

    Args:
        image: any linear unit.
        side_px: side of a window.
        clipped_at: values from here on are clipped, and so are those from 0 down.
    """
    rows, columns = (size // side_px for size in image.shape)
    whole = np.asarray(image[: rows * side_px, : columns * side_px], np.float64)
    pixels = whole.reshape(rows, side_px, columns, side_px).swapaxes(1, 2).reshape(-1, side_px**2)
    with np.errstate(invalid="ignore"):
        # NaN compares false and so is not sound.
        sound = ((pixels > 0) & (pixels < clipped_at)).all(1)
    return _split(pixels[sound], side_px)


def _split(pixels: np.ndarray, side_px: int) -> Windows:
    plane, slow, middle = bases = _bases(side_px)
    mean = pixels.mean(1)
    centred = pixels - mean[:, None]
    in_plane, in_slow, in_middle = (((centred @ basis) ** 2).sum(1) for basis in bases)
    slow_count, middle_count = slow.shape[1], middle.shape[1]
    rest_count = side_px**2 - plane.shape[1] - slow_count
    rest = np.maximum((centred**2).sum(1) - in_plane - in_slow, 0)
    degrees = (slow_count, rest_count, middle_count)
    return Windows(mean, in_slow / slow_count, rest / rest_count, in_middle / middle_count, degrees)


@lru_cache
def _bases(side_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal columns (n * n, K) of a plane, of the cosines up to SLOW less their plane, and on to FINE."""
    place = np.arange(side_px) + 0.5
    ramp, one = place - side_px / 2, np.ones(side_px)
    plane = [np.outer(one, one), np.outer(ramp, one), np.outer(one, ramp)]
    cosines = [np.cos(math.pi * k * place / side_px) for k in range(side_px)]
    numbers = sorted((math.hypot(k, m) / (2 * side_px), k, m) for k in range(side_px) for m in range(side_px))
    # k + m > 1: the first two waves are all but the plane.
    waves = [np.outer(cosines[k], cosines[m]) for f, k, m in numbers if f <= FINE and k + m > 1]
    joined, _ = np.linalg.qr(np.stack([wave.ravel() for wave in plane + waves], axis=1))
    fine = 3 + sum(f <= SLOW and k + m > 1 for f, k, m in numbers)
    return joined[:, :3], joined[:, 3:fine], joined[:, fine:]


MIN_WINDOWS = 12
MIN_RANGE = 0.25
MIN_FLAT = 0.35
"""Of the windows whose structure could be noise, those that have less than its mean: a half, if all are flat."""
MAX_EXCESS = 0.05
"""Variance that the middle frequencies may have over the fine ones: 2 % of the SNR."""

PASSES = 30
ROUNDING = 1e-6
"""What float32 may leave of a noise that is not there, of the mean."""


@dataclass(frozen=True)
class NoiseLine:
    """A fitted line, variance of the noise = alpha L + beta.

    Attributes:
        line: (alpha, beta).
        covariance: (2, 2) of it.
        windows: those it goes through.
    """

    line: np.ndarray
    covariance: np.ndarray
    windows: Windows

    def at(self, radiance: float | np.ndarray) -> np.ndarray:
        """Variance of the noise at radiances of any shape, in the square of their unit."""
        return np.asarray(self.line[0] * radiance + self.line[1])

    def error(self, radiance: float) -> float:
        """Standard error of the variance at one radiance, from the fit's covariance."""
        at = np.array([radiance, 1.0])
        return float(np.sqrt(at @ self.covariance @ at))


def fit_noise(windows: Windows) -> NoiseLine | Refusal:
    """Choose the homogeneous windows and fit the noise line, in turn, until the choice stands."""
    if windows.mean.size < MIN_WINDOWS:
        return _too_few(windows.mean.size)
    chosen = windows.structure <= windows.variance
    for _ in range(PASSES):
        used = windows.only(chosen)
        refusal = _unusable(used)
        if refusal is not None:
            return refusal
        fit = _weighted_line(used)
        previous, chosen = chosen, windows.structure <= np.maximum(fit.at(windows.mean), 0)
        if np.array_equal(previous, chosen):
            break
    return _unusable(used) or _textured(windows, fit) or _coloured(used, fit) or fit


def _textured(windows: Windows, line: NoiseLine) -> Refusal | None:
    """Flat windows stand apart from textured ones; the quietest of a texture are the tail of many more."""
    ratio = windows.structure / np.maximum(line.at(windows.mean), 1e-300)
    quiet, possible = int((ratio <= 1).sum()), int((ratio <= 1 + 2 * (2 / windows.degrees[0]) ** 0.5).sum())
    scatter = 0.5 * possible**0.5  # of a count of halves
    if quiet >= MIN_FLAT * possible - scatter:
        return None
    return Refusal("few-windows", f"only {quiet} of {possible} windows that might be flat are, the rest is texture")


def _coloured(used: Windows, line: NoiseLine) -> Refusal | None:
    """White noise is as strong at all frequencies; what is stronger at the lower ones has been through a blur."""
    _, rest, middle = used.degrees
    expected = np.maximum(line.at(used.mean), ROUNDING * used.variance.mean())
    in_middle, in_rest = (float((x / expected).mean()) for x in (used.middle, used.variance))
    excess = in_middle * (rest - middle) / (in_rest * rest - in_middle * middle) - 1
    scatter = (2 / used.mean.size * (1 / middle + 1 / (rest - middle))) ** 0.5
    if excess <= MAX_EXCESS + 3 * scatter:
        return None
    return Refusal("few-windows", f"the flattest windows hold texture or smoothed noise, {excess:.0%} over white")


def _unusable(used: Windows) -> Refusal | None:
    if used.mean.size < MIN_WINDOWS:
        return _too_few(used.mean.size)
    if not (used.variance > (ROUNDING * used.mean) ** 2).any():
        return Refusal("no-noise", "the homogeneous windows hold no noise at all")
    low, high = float(used.mean.min()), float(used.mean.max())
    if high - low < MIN_RANGE * high:
        return Refusal("range", f"homogeneous areas from {low:.4g} to {high:.4g} only, too narrow for a line")
    return None


def _too_few(count: int) -> Refusal:
    return Refusal("few-windows", f"{count} homogeneous windows, {MIN_WINDOWS} are needed")


def _weighted_line(windows: Windows) -> NoiseLine:
    """Weighted least squares; a variance v of n degrees of freedom scatters by 2 v^2 / n, v from the line itself."""
    terms = np.stack([windows.mean, np.ones_like(windows.mean)], axis=1)
    expected = np.full_like(windows.mean, windows.variance.mean())
    for _ in range(PASSES):
        weights = windows.degrees[1] / (2 * expected**2)
        covariance = np.linalg.inv(terms.T * weights @ terms)
        line = covariance @ (terms.T * weights @ windows.variance)
        # A line that dips to 0 would give its dark windows all of the weight.
        expected = np.maximum(terms @ line, 0.05 * expected.mean())
    scatter = float((weights * (windows.variance - terms @ line) ** 2).sum() / (windows.mean.size - 2))
    return NoiseLine(line, covariance * max(scatter, 1.0), windows)


RADIANCES = (25.0, 100.0)
WINDOW_PX, MIN_WINDOW_PX = 16, 8


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
