"""The blur of an instrument from short straight edges, fitted by the curve that a sensor profile states.

`slanted_edge` measures a whole MTF curve across one long edge. Here a profile's own curve is fitted instead,
MTF(f) = exp(-gamma f) sinc(f) (`simulator.mtf`): one number an edge, for which 17 x 17 pixels are enough. All edges
together tell how much steeper the curve falls, by a Gaussian part exp(-shape f^2).

What has been sharpened, or was never a step, does not fit and is told apart by that: of 21 000 steep places that six
sensors saw in ten aerial photographs not one passed. A hedge or a shore is softer than any step, and would be taken
for blur.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.profiles.sensor import MTF_NYQUIST_MAX

HALF_PX = 8
"""Half the side of the square around a found edge, and how far from an edge pixels are fitted."""

GAMMAS = np.linspace(0.0, 10.0, 101)
"""For which the edge is tabulated: MTF at Nyquist from 64 to 0.4 %."""

SHAPES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 13.0)
"""Of the Gaussian part: 0 is the profile's curve. Smear, jitter and diffraction fall more steeply than it."""
STEEPER = (4.0, 8.0)
"""Tried on an edge that the profile's curve does not fit."""

PER_PX, REACH_PX = 16, 24
START_GAMMA, LEAST_GAMMA, LARGEST_GAMMA = 4.0, 0.05, 9.9
MAX_PLACE_PX, MAX_SLOPE = 3.0, math.tan(math.radians(35))
PASSES = 15

Noise = Callable[[np.ndarray], np.ndarray]
"""Variance of the noise of pixels with these values, of any shape, in the square of their unit."""


@dataclass(frozen=True)
class EdgeBlur:
    """The blur across one edge.

    Attributes:
        gamma: of MTF(f) = exp(-gamma f) sinc(f), f in cycles per pixel along the edge's normal.
        error: standard error of gamma.
        slope: pixels by which the edge leans each line; 0 runs along the grid.
        pixels: (H, W) that it was fitted to, over their noise.
        chi2: sum of squares that the fit leaves of those near the edge.
        count: how many these are, less the five numbers fitted.
    """

    gamma: float
    error: float
    slope: float
    pixels: np.ndarray
    chi2: float
    count: int


@dataclass(frozen=True)
class Limits:
    """What an edge must keep to count.

    Attributes:
        step_sigma: least difference of the plateaus over the noise of a pixel. A fainter edge may hide in noise that
            it is none.
        misfit: largest root mean square of what the noise does not explain, of the step.
        error: largest standard error of gamma; 0.6 is a third of the MTF.
    """

    step_sigma: float
    misfit: float
    error: float = 0.6


FOUND, POINTED_AT, ANY = Limits(30, 0.012), Limits(10, 0.03), Limits(0, math.inf, math.inf)
"""For edges found by search among much that is none, for those that a person vouches for, and for those known."""


@lru_cache(maxsize=16)
def _responses(shape: float) -> np.ndarray:
    """A step of 1 at 0, blurred, for each of GAMMAS and each distance: (101, 2 * REACH_PX * PER_PX + 1)."""
    step = 0.004  # the sum repeats, with the other sign, after 1 / 0.004 = 250 px
    f = np.arange(step / 2, 2.5, step)
    distance = np.arange(-REACH_PX * PER_PX, REACH_PX * PER_PX + 1) / PER_PX
    waves = np.sin(2 * math.pi * np.outer(f, distance)) / (math.pi * f)[:, None]
    return np.asarray(0.5 + step * (np.exp(-np.outer(GAMMAS, f) - shape * f**2) * np.sinc(f)) @ waves)


def edge_response(distance: np.ndarray, gamma: float, shape: float = 0.0) -> np.ndarray:
    """What a detector sees of a step of 1 at `distance` pixels (any shape) from it, behind a blur of `gamma`.

    `shape` adds a Gaussian part to the blur: MTF(f) = exp(-gamma f - shape f^2) sinc(f).
    """
    table = _responses(shape)
    place = np.clip((distance + REACH_PX) * PER_PX, 0, table.shape[1] - 1.001)
    column, row = place.astype(int), min(int(gamma / GAMMAS[1]), GAMMAS.size - 2)
    share, part = place - column, gamma / GAMMAS[1] - row
    line = table[row] * (1 - part) + table[row + 1] * part
    return np.asarray(line[column] * (1 - share) + line[column + 1] * share)


@dataclass
class _Line:
    """Where the edge is thought to run, about the middle of a region, and how soft it is."""

    place: float
    slope: float
    gamma: float = START_GAMMA
    shape: float = 0.0

    def distance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray((x - self.place - self.slope * y) / math.sqrt(1 + self.slope**2))

    def response(self, distance: np.ndarray) -> np.ndarray:
        return edge_response(distance, self.gamma, self.shape)

    def move(self, change: np.ndarray) -> float:
        """Take a bounded step; how far gamma went."""
        place, slope, gamma = np.clip(change, (-0.7, -0.1, -1.5), (0.7, 0.1, 1.5))
        before = self.gamma
        self.place, self.slope = self.place + float(place), self.slope + float(slope)
        self.gamma = min(max(self.gamma + float(gamma), 0.0), float(GAMMAS[-1]))
        return abs(self.gamma - before)


def fit_blur(region: np.ndarray, noise: Noise, limits: Limits) -> EdgeBlur | Refusal:
    """Fit the blur of the one near-vertical edge that crosses a region from top to bottom.

    Args:
        region: (H, W) finite values of any linear unit, rising or falling from left to right.
        noise: of the pixels.
        limits: what the edge must keep to.

    Returns:
        The blur by the profile's curve, or, of an edge that no shape of the curve fits, why there is none.
    """
    pixels = region / math.sqrt(float(noise(region).mean()))
    found = _fitted(pixels, limits)
    if isinstance(found, EdgeBlur):
        return found
    steeper = (_fitted(pixels, limits, shape) for shape in STEEPER)
    return _fitted(pixels, ANY) if any(isinstance(fit, EdgeBlur) for fit in steeper) else found


def _fitted(pixels: np.ndarray, limits: Limits, shape: float = 0.0) -> EdgeBlur | Refusal:
    """As `fit_blur`, for pixels whose noise is 1, and another shape of the curve."""
    y, x = (axis - (size - 1) / 2 for axis, size in zip(np.indices(pixels.shape), pixels.shape, strict=True))
    line = _centroids(pixels, y[:, 0], x[0])
    line.shape = shape
    start = line.place
    for _ in range(PASSES):
        near = np.abs(x - line.place - line.slope * y) <= HALF_PX
        if near.sum() < 10 * HALF_PX:
            return Refusal(f"{int(near.sum())} pixels near the edge, {10 * HALF_PX} are needed")
        terms, fitted = _linearised(line, x[near], y[near], pixels[near])
        left = pixels[near] - fitted
        covariance = np.linalg.pinv(terms.T @ terms)
        moved = line.move((covariance @ (terms.T @ left))[2:])
        if abs(line.place - start) > MAX_PLACE_PX or abs(line.slope) > MAX_SLOPE:
            break
        if moved < 1e-3:
            return _judged(line, pixels, float(np.ptp(fitted)), left, float(covariance[4, 4]), limits)
    return Refusal("no straight edge near to an axis")


def _centroids(region: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> _Line:
    """The line through the centres of what rises in each row."""
    rise = np.diff(region, axis=1)
    rise = np.maximum(rise * np.sign(rise.sum()), 0) * np.hamming(rise.shape[1])
    centre = (rise * (columns[1:] - 0.5)).sum(1) / np.maximum(rise.sum(1), 1e-9)
    return _Line(float(np.median(centre)), float((centre * rows).sum() / max((rows**2).sum(), 1.0)))


def _linearised(line: _Line, x: np.ndarray, y: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (N, 5) by the plateau, the step, place, slope and gamma; and the best fit (N,) of the first two."""
    distance = line.distance(x, y)
    plateaus = np.stack([np.ones_like(x), line.response(distance)], axis=1)
    levels, *_ = np.linalg.lstsq(plateaus, seen, rcond=None)
    rise = line.response(distance + 0.1) - line.response(distance - 0.1)
    rise *= levels[1] / 0.2 / math.sqrt(1 + line.slope**2)
    low, high = max(line.gamma - 0.15, 0.0), min(line.gamma + 0.15, float(GAMMAS[-1]))
    change = edge_response(distance, high, line.shape) - edge_response(distance, low, line.shape)
    softer = change * levels[1] / (high - low)
    return np.column_stack([plateaus, -rise, -rise * y, softer]), plateaus @ levels


def _judged(
    line: _Line, pixels: np.ndarray, step: float, left: np.ndarray, variance: float, limits: Limits
) -> EdgeBlur | Refusal:
    chi2, count = float((left**2).sum()), left.size - 5
    scatter = chi2 / count
    misfit = math.sqrt(max(scatter - 1, 0.0)) / max(step, 1e-9)
    error = math.sqrt(variance * max(scatter, 1.0))
    if limits is not ANY and not LEAST_GAMMA * (not line.shape) <= line.gamma < LARGEST_GAMMA:
        return Refusal("sharper than a detector's pixel or softer than any profile: no plain edge")
    if misfit > limits.misfit:
        return Refusal(f"{misfit:.1%} of the step fit no blurred edge, {limits.misfit:.1%} at most")
    if step < limits.step_sigma or error > limits.error:
        return Refusal(f"a step of {step:.3g} times the noise, {limits.step_sigma:g} are needed")
    return EdgeBlur(line.gamma, error, line.slope, pixels, chi2, count)


MAX_CANDIDATES, MAX_FITS = 6000, 400
MIN_STEEPNESS = 6
"""Of a gradient over its noise."""
MAX_ROUGHNESS = 0.03
"""Of the outer columns of a square, beyond noise, of the step: more is no plateau."""


def find_blurs(image: np.ndarray, noise: Noise, clipped_at: float) -> list[EdgeBlur]:
    """The blurs across the near-vertical edges of an image (H, W); transpose it for the near-horizontal ones.

    Args:
        image: finite values.
        noise: of the pixels.
        clipped_at: values from here on are clipped, and so are those from 0 down.
    """
    squares = _squares(image, noise)
    sound = ((squares > 0) & (squares < clipped_at)).all((1, 2))
    smooth = squares[sound & _flat(squares, noise)][:MAX_FITS]
    fits = (fit_blur(square, noise, FOUND) for square in smooth)
    return [fit for fit in fits if isinstance(fit, EdgeBlur)]


def _squares(image: np.ndarray, noise: Noise) -> np.ndarray:
    """Squares (N, S, S) around the steepest places, S = 2 * HALF_PX + 1, no centre in another's middle."""
    steep = _steepness(image, noise)
    order = np.argsort(steep, axis=None, kind="stable")[::-1]
    taken, centres = np.zeros(image.shape, bool), list[tuple[int, int]]()
    for place in order[: int((steep > MIN_STEEPNESS).sum())]:
        row, column = divmod(int(place), image.shape[1])
        if not taken[row, column]:
            taken[max(row - HALF_PX, 0) : row + HALF_PX + 1, max(column - 3, 0) : column + 4] = True
            centres.append((row, column))
            if len(centres) == MAX_CANDIDATES:
                break
    reach = np.arange(-HALF_PX, HALF_PX + 1)
    rows, columns = (np.array([c[axis] for c in centres], int)[:, None, None] for axis in (0, 1))
    return np.asarray(image[rows + reach[:, None], columns + reach])


def _steepness(image: np.ndarray, noise: Noise) -> np.ndarray:
    """Rise along the rows over its noise, (H, W): where it leads that down the columns, and a square has room."""
    across, down = _rise(image), _rise(image.T).T
    inside = (slice(2, -2),) * 2
    steep = np.where(down > across, 0, across / np.sqrt(2 / 5 * noise(image[inside])))
    room = np.zeros(image.shape)
    deep = slice(HALF_PX + 2, -HALF_PX - 2)
    room[deep, deep] = steep[HALF_PX:-HALF_PX, HALF_PX:-HALF_PX]
    return room


def _rise(image: np.ndarray) -> np.ndarray:
    """Difference over 4 columns, the mean of 5 rows, of the pixels (H - 4, W - 4) that have 2 on each side."""
    step = image[:, 4:] - image[:, :-4]
    rows = len(image) - 4
    return np.asarray(np.abs(sum(step[k : k + rows] for k in range(5))) / 5)


def _flat(squares: np.ndarray, noise: Noise) -> np.ndarray:
    """Whether the three outer columns on either side scatter by noise alone: (N,) of bool."""
    left, right = squares[:, :, :3], squares[:, :, -3:]
    step = np.abs(right.mean((1, 2)) - left.mean((1, 2)))
    # The tails of the blur slope: what a column does along itself is what counts.
    scatter = [side.var(axis=1, ddof=1).mean(1) - noise(side).mean((1, 2)) for side in (left, right)]
    return np.asarray(np.sqrt(np.maximum(np.maximum(*scatter), 0)) < MAX_ROUGHNESS * step)


MIN_FOUND = 3
FLOOR = 0.05
"""Least standard error of gamma: what the fit is off on edges along the grid (measured), 2.5 % of the MTF."""
ROBUST = 1.4826
"""Of a median absolute deviation: the standard deviation of normal values."""
LONE_ERROR = 0.1
"""Scatter of gamma between edges where only one is known."""
SHAPED_EDGES = 40
"""As many tell the shape."""
WORST = 1e12
"""Sum of squares over noise that stands for no fit at all."""
OTHER_SHAPES = 0.25
"""Standard error for shapes that no Gaussian part has, of what the Gaussian part changes."""


@dataclass(frozen=True)
class AxisMtf:
    """The MTF at Nyquist along one axis.

    Attributes:
        mtf_nyquist: contrast kept at 0.5 cycles per pixel, of whichever shapes of the curve explain the edges.
        interval: 95 % interval of it, from the scatter between edges and between such shapes.
        edges: how many.
        nearest: that of the profile's curve that comes nearest to the edges, whatever their own shape.
    """

    mtf_nyquist: float
    interval: tuple[float, float]
    edges: int
    nearest: float


def combine(own: Sequence[EdgeBlur], others: Sequence[EdgeBlur]) -> AxisMtf:
    """The MTF along one axis from the edges across it, at least one, and those across the other axis.

    The shape of the curve is left open: each one counts by what it leaves unexplained of the edges.
    """
    from scipy.special import stdtrit  # here: who tells no sensor need not wait for SciPy

    other = float(np.median([edge.gamma for edge in others])) if others else None
    known = own[:SHAPED_EDGES]
    logs, errors, left = (np.array(part) for part in zip(*(_of_shape(own, other, s) for s in SHAPES), strict=True))
    scatter = np.maximum(left.min(0) / [edge.count for edge in known], 1.0)
    # The median and not the sum: an edge that another crosses nearby has a shape of its own.
    weights = -len(known) / 2 * np.median((left - left[0]) / scatter, axis=1)
    # Before any edge is seen, half of the belief is in the profile's curve: of few edges nothing else can be said.
    belief = np.gradient(SHAPES)
    belief[0] = belief[1:].sum()
    weights = np.exp(weights - weights.max()) * belief
    weights /= weights.sum()
    value = float(weights @ logs)
    error = math.sqrt(float(weights @ ((logs - value) ** 2 + errors**2)))
    # A lone edge has its scatter assumed.
    quantile = float(stdtrit(len(own) - 1 or math.inf, 0.975))
    reach = quantile * math.hypot(error, FLOOR / 2, OTHER_SHAPES * (logs[0] - value))
    low, centre, high, nearest = (
        MTF_NYQUIST_MAX * math.exp(x) for x in (value - reach, value, value + reach, logs[0])
    )
    return AxisMtf(centre, (low, min(high, MTF_NYQUIST_MAX)), len(own), nearest)


def _of_shape(own: Sequence[EdgeBlur], other: float | None, shape: float) -> tuple[float, float, np.ndarray]:
    """Logarithm of the MTF at Nyquist over a perfect lens', its standard error, and what each edge leaves over.

    gamma^2 of a leaning edge is (gamma_x cos)^2 + (gamma_y sin)^2: the other axis has a part in it. An edge that the
    shape cannot be fitted to leaves more than any other.
    """
    fits = [_fitted(edge.pixels, ANY, shape) for edge in own[:SHAPED_EDGES]] if shape else list(own)
    known = [fit for fit in fits if isinstance(fit, EdgeBlur)] or list(own)
    gammas, errors = (np.array([getattr(edge, name) for edge in known]) for name in ("gamma", "error"))
    if other is not None and not shape:
        lean = np.array([edge.slope for edge in known]) ** 2
        gammas = np.sqrt(np.maximum(gammas**2 * (1 + lean) - lean * other**2, 1e-4))
    gamma, error = _centre(gammas, errors)
    left = [fit.chi2 if isinstance(fit, EdgeBlur) else WORST for fit in fits[:SHAPED_EDGES]]
    return -gamma / 2 - shape / 4, error / 2, np.array(left)


def _centre(values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """Weighted mean (N,) without what lies 3 robust deviations off the median, and its standard error."""
    if values.size == 1:
        return float(values[0]), math.hypot(float(errors[0]), LONE_ERROR)
    off = np.abs(values - np.median(values))
    scatter = ROBUST * float(np.median(off))
    kept = off <= 3 * np.maximum(scatter, errors)
    v, e = values[kept], errors[kept]
    between = max(float(v.var(ddof=1)) - float((e**2).mean()), 0.0) if v.size > 1 else LONE_ERROR**2
    weights = 1 / (e**2 + between)
    return float((weights * v).sum() / weights.sum()), float(weights.sum() ** -0.5)
