"""The line variance = alpha L + beta through the homogeneous windows of an image."""

from dataclasses import dataclass

import numpy as np

from model.metrics.refusal import Refusal
from model.metrics.windows import Windows

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
    """A fitted line.

    Attributes:
        line: (alpha, beta).
        covariance: (2, 2) of it.
        windows: those it goes through.
    """

    line: np.ndarray
    covariance: np.ndarray
    windows: Windows

    def at(self, radiance: float | np.ndarray) -> np.ndarray:
        """Variance of the noise."""
        return np.asarray(self.line[0] * radiance + self.line[1])

    def error(self, radiance: float) -> float:
        """Standard error of that variance."""
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
        expected = np.maximum(terms @ line, 0.05 * expected.mean())
    scatter = float((weights * (windows.variance - terms @ line) ** 2).sum() / (windows.mean.size - 2))
    return NoiseLine(line, covariance * max(scatter, 1.0), windows)
