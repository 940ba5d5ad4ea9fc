"""Measure the blur of an instrument from short straight edges, fitted by the curve that a sensor
profile states.

`slanted_edge` measures a whole MTF curve across one long edge. Here a profile's own curve is fitted
instead, MTF(f) = exp(-gamma f) sinc(f) (`simulator.mtf`): one number per edge, for which 17 x 17
pixels are enough. All edges jointly determine how much more steeply the curve falls, by a Gaussian
part exp(-shape f^2).

An edge that was sharpened, or was never a step, does not fit and is excluded. Of 21 000 steep
places that six sensors saw in ten aerial photographs not one passed. A hedge or a shore is softer
than any step, and would be mistaken for blur.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beers_deploy.model.metrics.edge_fit import (
    ANY,
    HALF_PX,
    STRICT,
    EdgeBlur,
    Fit,
    Noise,
    fit_blurs,
    fit_shape,
)
from beers_deploy.model.metrics.statistics import robust_deviation
from beers_deploy.profiles.instrument import MTF_NYQUIST_MAX

SHAPES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 13.0)
"""Values of the Gaussian part's coefficient; 0 is the profile's curve.

Smear, jitter and diffraction fall more steeply than that curve.
"""

MIN_STEEPNESS = 6
"""The least ratio of a gradient to its noise."""
MAX_ROUGHNESS = 0.03
"""The largest scatter of a square's outer columns beyond noise, relative to the step. A plateau has
less.
"""
MARGIN_PX = HALF_PX + 2
"""The room that a square needs around its middle, with that for the gradient."""


@dataclass(frozen=True)
class Effort:
    """The effort of searching edges in an image, which limits the time.

    Attributes:
        step_px: only every `step_px`-th row is searched, because edges are longer than that.
        cell_px: the height and width of a cell in pixels, the height a multiple of `step_px`; only
            the steepest place of each cell is tried.
        candidates: the number of steepest places whose squares are checked for even sides.
        fits: the number of squares that are fitted, the steepest first.
    """

    step_px: int
    cell_px: tuple[int, int]
    candidates: int
    fits: int


THOROUGH = Effort(step_px=1, cell_px=(4, 2), candidates=6000, fits=400)
"""The most thorough search. With cells twice as large fewer edges are found: of 80 wrong MTFs of
drawn towns 41 are detected instead of 47 (measured).
"""


def blurs_of(squares: np.ndarray, noise: Noise) -> list[EdgeBlur]:
    """Fit the blur across the edge in each square, and return it for those that contain a clean
    edge.

    Args:
        squares: (N, S, S) pixels, each possibly with a near-vertical edge.
        noise: returns the variance of the noise of pixels of given values.
    """
    return [fit for fit in fit_blurs(squares, noise, STRICT) if fit is not None]


def plain_squares(
    image: np.ndarray,
    noise: Noise,
    clipped_at: float,
    effort: Effort,
    roughness: float = MAX_ROUGHNESS,
) -> np.ndarray:
    """Cut squares around the steepest places of an image, where near-vertical edges between plain
    sides may be.

    Args:
        image: (H, W), finite values; transpose it for near-horizontal edges.
        noise: returns the variance of the noise of pixels of given values.
        clipped_at: the smallest value that counts as clipped. Values of 0 or below are clipped too.
        effort: limits of the search.
        roughness: the largest accepted scatter of a square's outer columns beyond noise, relative
            to the step.

    Returns:
        The squares (N, S, S), S = 2 * HALF_PX + 1, the steepest first.
    """
    if min(image.shape) <= 2 * MARGIN_PX:
        return np.empty((0, 2 * HALF_PX + 1, 2 * HALF_PX + 1))
    rows, columns = _steepest(_steepness(image, noise, effort.step_px), effort)
    occupied = np.zeros(image.shape, bool)
    numbers = list[int]()
    # No square is centred in the middle of another.
    for k, (row, column) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        if not occupied[row, column]:
            occupied[row - HALF_PX : row + HALF_PX + 1, column - 3 : column + 4] = True
            numbers.append(k)
            if len(numbers) == effort.candidates:
                break
    reach = np.arange(-HALF_PX, HALF_PX + 1)
    rows, columns = (places[numbers][:, None, None] for places in (rows, columns))
    squares = image[rows + reach[:, None], columns + reach]
    valid = ((squares > 0) & (squares < clipped_at)).all((1, 2))
    # The three outer columns on either side scatter by noise alone. The tails of the blur have a
    # slope, so only the scatter within a column counts.
    left = squares[:, :, :3]
    right = squares[:, :, -3:]
    step = np.abs(right.mean((1, 2)) - left.mean((1, 2)))
    scatter = [
        side.var(axis=1, ddof=1).mean(1) - noise(side).mean((1, 2)) for side in (left, right)
    ]
    flat = np.sqrt(np.maximum(np.maximum(*scatter), 0)) < roughness * step
    plain: np.ndarray = squares[valid & flat]
    return plain[: effort.fits]


def _steepest(steepness: np.ndarray, effort: Effort) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the steepest place of each cell that is steep, the steepest of all
    first.
    """
    height, width = steepness.shape
    down = effort.cell_px[0] // effort.step_px
    across = effort.cell_px[1]
    padded = np.pad(steepness, ((0, -height % down), (0, -width % across)))
    blocks = padded.reshape(padded.shape[0] // down, down, -1, across).swapaxes(1, 2)
    cells = blocks.reshape(*blocks.shape[:2], -1)
    place_in_cell = cells.argmax(2)
    best = np.take_along_axis(cells, place_in_cell[:, :, None], 2)[:, :, 0]
    order = np.argsort(best, axis=None, kind="stable")[::-1][: int((best > MIN_STEEPNESS).sum())]
    cell_row, cell_column = np.divmod(order, best.shape[1])
    inner_row, inner_column = np.divmod(place_in_cell.ravel()[order], across)
    rows = cell_row * down + inner_row
    columns = cell_column * across + inner_column
    return MARGIN_PX + rows * effort.step_px, MARGIN_PX + columns


def _steepness(image: np.ndarray, noise: Noise, step_px: int) -> np.ndarray:
    """Compute the rise along the rows over its noise, for every `step_px`-th row with room for a
    square.

    It is the difference over 4 columns of the mean of 5 rows. It is 0 if the rise down the columns
    is larger.
    """
    height, width = image.shape

    def row(k: int) -> np.ndarray:
        return image[MARGIN_PX + k : height - MARGIN_PX + k : step_px]

    def column(rows: np.ndarray, k: int) -> np.ndarray:
        return rows[:, MARGIN_PX + k : width - MARGIN_PX + k]

    offsets = range(-2, 3)
    lengthwise = np.asarray(sum(row(k) for k in offsets))
    step_down = row(2) - row(-2)
    across = np.abs(column(lengthwise, 2) - column(lengthwise, -2)) / 5
    down = np.abs(sum(column(step_down, k) for k in offsets)) / 5
    # A mean of 5 rows less another one has 2 / 5 of a pixel's variance.
    deviation = np.sqrt(2 / 5 * noise(column(row(0), 0)))
    return np.where(down > across, 0, across / deviation)


MIN_EDGES = 3
FLOOR = 0.05
"""Least standard error of gamma: the error of the fit on edges along the grid (measured), 2.5 % of
the MTF.
"""
LONE_ERROR = 0.1
"""Assumed scatter of gamma between edges if only one edge is known."""
WORST = 1e12
"""Sum of squares over noise that is used if the fit fails."""
OTHER_SHAPES = 0.25
"""Standard error for shapes without a Gaussian part, relative to the change that the Gaussian part
makes.
"""


@dataclass(frozen=True)
class AxisMtf:
    """The MTF at Nyquist along one axis of an image.

    Attributes:
        mtf_nyquist: contrast at 0.5 cycles per pixel, averaged over the curve shapes that explain
            the edges.
        interval: the ends of its 95 % interval, from the scatter between edges and between these
            shapes.
        edges: the number of edges that were measured.
        nearest: contrast at 0.5 cycles per pixel of the curve MTF(f) = exp(-gamma f) sinc(f), which
            a sensor's profile states, that is nearest to the edges whatever their own shape.
    """

    mtf_nyquist: float
    interval: tuple[float, float]
    edges: int
    nearest: float


def combine(own: Sequence[EdgeBlur], others: Sequence[EdgeBlur]) -> AxisMtf:
    """Estimate the MTF at Nyquist along one axis from the edges across it.

    Several shapes of the curve are fitted. Each is weighted by how well it explains the edges and
    by a prior, which gives half to the curve of sensor profiles.

    Args:
        own: the blurs of the edges across this axis, at least two, all in regions of one size.
        others: the blurs of the edges across the other axis, from which the fit of the profiles'
            curve corrects inclined edges; may be empty.
    """
    # Imported here, because only measurements of sensors need SciPy.
    from scipy.special import stdtrit

    other_gamma = float(np.median([edge.gamma for edge in others])) if others else None
    logs, errors, chi2 = (
        np.array(part)
        for part in zip(*(_of_shape(own, other_gamma, s) for s in SHAPES), strict=True)
    )
    # Even the best shape leaves the noise. A smaller rest is chance.
    scatter = np.maximum(chi2.min(0) / [edge.count for edge in own], 1.0)
    # The median is used, because an edge that another crosses nearby has another shape.
    weights = -len(own) / 2 * np.median((chi2 - chi2[0]) / scatter, axis=1)
    # The prior gives half of its weight to the profile's curve, because few edges cannot determine
    # another one.
    belief = np.gradient(SHAPES)
    belief[0] = belief[1:].sum()
    weights = np.exp(weights - weights.max()) * belief
    weights /= weights.sum()
    value = float(weights @ logs)
    error = math.sqrt(float(weights @ ((logs - value) ** 2 + errors**2)))
    quantile = float(stdtrit(len(own) - 1, 0.975))
    reach = quantile * math.hypot(error, FLOOR / 2, OTHER_SHAPES * (logs[0] - value))
    low, centre, high, nearest = (
        MTF_NYQUIST_MAX * math.exp(x) for x in (value - reach, value, value + reach, logs[0])
    )
    return AxisMtf(centre, (low, min(high, MTF_NYQUIST_MAX)), len(own), nearest)


def _of_shape(
    edges: Sequence[EdgeBlur], other_gamma: float | None, shape: float
) -> tuple[float, float, np.ndarray]:
    """Fit one shape of the curve to all edges.

    gamma^2 of an inclined edge is (gamma_x cos)^2 + (gamma_y sin)^2, so the other axis contributes
    to it. An edge that the shape cannot be fitted to has a larger residual than any other.

    Returns:
        The logarithm of the MTF at Nyquist relative to a perfect lens, its standard error, and the
        residual of each edge.
    """
    fits: Sequence[Fit] = edges
    if shape:
        fits = fit_shape(np.stack([edge.pixels for edge in edges]), ANY, shape)
    blurs = [fit for fit in fits if fit is not None] or edges
    gammas, errors = np.array([(edge.gamma, edge.error) for edge in blurs]).T
    if other_gamma is not None and not shape:
        lean = np.array([edge.slope for edge in blurs]) ** 2
        gammas = np.sqrt(np.maximum(gammas**2 * (1 + lean) - lean * other_gamma**2, 1e-4))
    # The weighted mean of the values within 3 robust deviations from the median.
    if gammas.size == 1:
        gamma = float(gammas[0])
        error = math.hypot(float(errors[0]), LONE_ERROR)
    else:
        off = np.abs(gammas - np.median(gammas))
        inliers = off <= 3 * np.maximum(robust_deviation(off), errors)
        values = gammas[inliers]
        variances = errors[inliers] ** 2
        between = LONE_ERROR**2
        if values.size > 1:
            between = max(float(values.var(ddof=1)) - float(variances.mean()), 0.0)
        weights = 1 / (variances + between)
        gamma = float((weights * values).sum() / weights.sum())
        error = float(weights.sum() ** -0.5)
    chi2 = [fit.chi2 if fit else WORST for fit in fits]
    return -gamma / 2 - shape / 4, error / 2, np.array(chi2)
