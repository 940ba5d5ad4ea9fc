"""MTF of an image from one slanted edge in it (ISO 12233:2017, with another DC: see below).

1. Locate the edge and take every pixel's distance to it along the normal (`edges.find_edge`).
2. Fit the plateaus: they give the step, which is the MTF's DC, and the PSF's far tails (`edges.fit_plateaus`).
3. Take off an edge with these tails, whose MTF is known. Average what it leaves in bins of a quarter pixel
   (`edges.spread`), differentiate, window, transform; add the known MTF.

ISO 12233 divides by the windowed derivative's own sum instead. With the tails of optics, MTF = exp(-gamma f), that
sum lacks 4 to 12 % of the step, and the MTF comes out too high by as much. The window resolves some 0.1 cycles per
pixel: a narrower peak of the curve comes out flatter.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.metrics.bootstrap import NORMAL_90
from model.metrics.edges import MIN_ROWS, ROW_LAG, Edge, Plateaus, find_edge, fit_plateaus, spread
from model.metrics.refusal import Refusal
from profiles.errors import ImageError

MIN_CONTRAST_SIGMA = 10
MAX_CLIPPED, MAX_EMPTY = 0.01, 0.05
SIGMA_PER_MEDIAN_STEP = 1.0484
"""Standard deviation of white noise over the median absolute difference of neighbours."""

FREQUENCIES = np.linspace(0, 1, 41)
NYQUIST = 20
"""Index of 0.5 cycles per pixel."""


@dataclass(frozen=True)
class EdgeMtf:
    """The MTF across one edge.

    Attributes:
        mtf_nyquist: contrast kept at 0.5 cycles per pixel; below 0 by noise or where contrast is reversed.
        interval: 90 % interval of it, from the scatter between rows.
        angle_deg: angle of the edge to the nearest axis, 2 to 43.
        frequencies: (41,) cycles per pixel along the edge's normal, 0 to 1.
        mtf: (41,) the whole curve.
        rows: how many rows (columns for a near-horizontal edge) were used.
    """

    mtf_nyquist: float
    interval: tuple[float, float]
    angle_deg: float
    frequencies: np.ndarray
    mtf: np.ndarray
    rows: int


def edge_mtf(
    image: np.ndarray, noise_sigma: float | None = None, saturated: float | None = None
) -> EdgeMtf | Refusal:
    """Measure the MTF across the one edge that crosses a region from side to side.

    The phase counts from the edge's own position, so noise does not add up to a contrast that is not there. The
    figure is that along the edge's normal: a square detector keeps 0.6 % more at 15 degrees than along the axis.

    Args:
        image: (H, W) pixels of any linear unit, 12-bit DN or radiance; about 80 x 80.
        noise_sigma: noise of a pixel, in the image's unit; None takes the scatter on the plateaus.
        saturated: the value at which pixels clip, in the image's unit; None for none. They also clip at 0.

    Returns:
        The MTF, or why there is none.

    Raises:
        ImageError: not two axes.
    """
    if image.ndim != 2:
        remedy = "give one band of one region"
        raise ImageError("slanted edge", expected="an image (H, W)", got=f"shape {image.shape}", remedy=remedy)
    pixels = np.asarray(image, np.float64)
    found = _unusable(pixels, saturated) or find_edge(pixels)
    if isinstance(found, Refusal):
        return found
    plateaus = fit_plateaus(found)
    sigma = plateaus.sigma if noise_sigma is None else noise_sigma
    if not plateaus.step > MIN_CONTRAST_SIGMA * sigma:
        return _faint(plateaus.step, sigma)
    return _measure(found, plateaus)


def _unusable(image: np.ndarray, saturated: float | None) -> Refusal | None:
    """What can be said before the edge is found."""
    if min(image.shape) < MIN_ROWS:
        return Refusal("few-rows", f"{image.shape[1]} x {image.shape[0]} pixels, {MIN_ROWS} rows are needed")
    lost = ~np.isfinite(image)
    if lost.any():
        return Refusal("not-finite", f"{int(lost.sum())} pixels are not finite")
    clipped = float(((image <= 0) | (image >= (math.inf if saturated is None else saturated))).mean())
    if clipped > MAX_CLIPPED:
        return Refusal("clipped", f"{clipped:.1%} of the pixels are clipped, {MAX_CLIPPED:.0%} at most")
    step = float(np.subtract(*np.percentile(image, [95, 5])))
    noise = SIGMA_PER_MEDIAN_STEP * min(float(np.median(np.abs(np.diff(image, axis=axis)))) for axis in (0, 1))
    return None if step > MIN_CONTRAST_SIGMA * noise else _faint(step, noise)


def _faint(step: float, sigma: float) -> Refusal:
    return Refusal("contrast", f"a step of {step:.4g} in noise of {sigma:.4g}, {MIN_CONTRAST_SIGMA} times are needed")


def _measure(edge: Edge, plateaus: Plateaus) -> EdgeMtf | Refusal:
    across = spread(edge, plateaus)
    if across.empty > MAX_EMPTY:
        return Refusal(
            "angle", f"{edge.rows.size} rows at {edge.angle_deg:.2f} degrees repeat each other and leave gaps"
        )
    weights = across.weights(FREQUENCIES)
    curve = across.model.transfer(FREQUENCIES) + weights @ across.values / plateaus.step
    value = float(curve[NYQUIST])
    error = math.hypot(across.standard_error(weights[NYQUIST]), value * plateaus.step_error) / plateaus.step
    reach = _quantile_90(edge.rows.size) * error
    return EdgeMtf(value, (value - reach, value + reach), abs(edge.angle_deg), FREQUENCIES, curve, edge.rows.size)


def _quantile_90(rows: int) -> float:
    """Of Student's t, to first order; the lags leave some 3 rows / (2 (ROW_LAG + 1)) degrees of freedom."""
    degrees = 3 * rows / (2 * (ROW_LAG + 1))
    return NORMAL_90 + (NORMAL_90**3 + NORMAL_90) / (4 * degrees)
