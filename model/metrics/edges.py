"""A slanted edge: where it runs in an image, what it looks like across, and how one is drawn as a scene.

One position per row gives the straight line through them; the profile across is kept in quarter pixels, with how
well it is known; a model of its plateaus, far tails and softness says where that profile may be trusted.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from model.metrics.refusal import Refusal

WINDOW_PX = 10
"""Half width of the Hamming window around the edge, in pixels."""

PLATEAU_PX = 5
"""What must lie beyond the window on either side of every row."""

MIN_ROWS, MAX_RESIDUAL_PX = 20, 0.5
MIN_ANGLE_DEG, MAX_ANGLE_DEG = 2.0, 43.0
ANGLE_ERROR_DEG = 0.05
"""What noise leaves open: an edge of 2 degrees must not be refused by the toss of a coin."""
PASSES = 3


@dataclass(frozen=True)
class Edge:
    """A near-vertical edge in an image whose values rise to the right.

    Attributes:
        image: (H, W) float64, turned so that the edge is near-vertical and rising.
        slope: columns per row.
        offset: column of the edge in row 0, counted in pixel centres.
        rows: (R,) rows that the line crosses with the window and a plateau on both sides.
    """

    image: np.ndarray
    slope: float
    offset: float
    rows: np.ndarray

    @property
    def angle_deg(self) -> float:
        """Angle to the vertical of the turned image."""
        return math.degrees(math.atan(self.slope))

    def distance(self) -> np.ndarray:
        """Signed distance (R, W) of every pixel of the rows to the line, in pixels, along its normal."""
        columns = np.arange(self.image.shape[1])
        across = columns[None, :] - (self.offset + self.slope * self.rows)[:, None]
        return np.asarray(across * math.cos(math.atan(self.slope)))


def find_edge(image: np.ndarray) -> Edge | Refusal:
    """The one edge of a region, near-vertical or near-horizontal, rising or falling.

    Args:
        image: (H, W) finite values.

    Returns:
        The edge, or a refusal: "few-rows", "no-convergence" or "angle".
    """
    image = upright(image)
    if image.shape[0] < MIN_ROWS or image.shape[1] <= 2 * (WINDOW_PX + PLATEAU_PX):
        return Refusal("few-rows", f"{image.shape[1]} x {image.shape[0]} pixels, 31 x 20 are needed")
    rows = np.arange(image.shape[0])
    slope, offset = _median_line(rows, _steepest(image))
    for _ in range(PASSES):
        rows = _inside(image, slope, offset)
        if rows.size < MIN_ROWS:
            return _too_few(rows.size)
        line = _refined(image, rows, slope, offset)
        if isinstance(line, Refusal):
            return line
        slope, offset = line
    return _checked(Edge(image, slope, offset, _inside(image, slope, offset)))


def upright(image: np.ndarray) -> np.ndarray:
    """The image (H, W), transposed and mirrored so that values rise from left to right: float64, (H, W) or (W, H)."""
    across, down = (_rise(image, axis) for axis in (1, 0))
    if abs(down) > abs(across):
        image, across = image.T, down
    return np.asarray(image if across >= 0 else image[:, ::-1], np.float64)


def _rise(image: np.ndarray, axis: int) -> float:
    first, *_, last = np.array_split(image, 3, axis=axis)
    return float(last.mean() - first.mean())


def _steepest(image: np.ndarray) -> np.ndarray:
    """Column of the steepest rise of each row, in a derivative smoothed over 9 pixels."""
    # Wide enough that noise does not win over the edge of a faint, blurred row.
    kernel = np.hamming(9)
    rise = np.diff(image, axis=1)
    smooth = np.stack([np.convolve(row, kernel, mode="same") for row in rise])
    return np.asarray(np.argmax(smooth, axis=1) + 0.5)


def _median_line(rows: np.ndarray, columns: np.ndarray) -> tuple[float, float]:
    """Line through the median of all slopes (Theil-Sen): a third of the rows may be wrong."""
    first, second = np.triu_indices(rows.size, 1)
    slope = float(np.median((columns[second] - columns[first]) / (rows[second] - rows[first])))
    return slope, float(np.median(columns - slope * rows))


def _inside(image: np.ndarray, slope: float, offset: float) -> np.ndarray:
    rows = np.arange(image.shape[0])
    columns = offset + slope * rows
    margin = WINDOW_PX + PLATEAU_PX
    return np.asarray(rows[(columns >= margin) & (columns <= image.shape[1] - 1 - margin)])


def _refined(image: np.ndarray, rows: np.ndarray, slope: float, offset: float) -> tuple[float, float] | Refusal:
    """Fit the centroids of the derivative within the window around the present line."""
    centre = (offset + slope * rows)[:, None]
    place = np.arange(image.shape[1] - 1) + 0.5 - centre
    weights = np.diff(image[rows], axis=1) * hamming(place)
    total = weights.sum(1)
    # A row crossed by a defect has no rise, or one elsewhere; its centroid would be anywhere.
    sound = total > 0.25 * np.median(total)
    if np.median(total) <= 0 or sound.sum() < MIN_ROWS:
        return Refusal("no-convergence", f"only {int(sound.sum())} rows rise at the line")
    shift = (weights * place)[sound].sum(1) / total[sound]
    return _line(rows[sound], centre[sound, 0] + shift)


def _line(rows: np.ndarray, columns: np.ndarray) -> tuple[float, float] | Refusal:
    """Least squares without the rows beyond 3 robust deviations of the first fit."""
    slope, offset = _median_line(rows, columns)
    off = np.abs(columns - slope * rows - offset)
    kept = off <= max(3 * 1.4826 * float(np.median(off)), 1e-6)
    slope, offset = (float(c) for c in np.polyfit(rows[kept], columns[kept], 1))
    residual = float(np.sqrt(np.mean((columns - slope * rows - offset) ** 2)))
    if residual > MAX_RESIDUAL_PX:
        return Refusal("no-convergence", f"the rows lie {residual:.2f} px off a line, {MAX_RESIDUAL_PX} at most")
    return slope, offset


def hamming(place: np.ndarray) -> np.ndarray:
    """Hamming window of half width WINDOW_PX around 0, and 0 beyond; `place` in pixels, of any shape."""
    window = 0.54 + 0.46 * np.cos(np.pi * place / WINDOW_PX)
    return np.asarray(np.where(np.abs(place) <= WINDOW_PX, window, 0.0))


def _checked(edge: Edge) -> Edge | Refusal:
    if edge.rows.size < MIN_ROWS:
        return _too_few(edge.rows.size)
    angle = abs(edge.angle_deg)
    if not MIN_ANGLE_DEG - ANGLE_ERROR_DEG <= angle <= MAX_ANGLE_DEG + ANGLE_ERROR_DEG:
        limits = f"{MIN_ANGLE_DEG:g} to {MAX_ANGLE_DEG:g} are needed"
        return Refusal("angle", f"{angle:.2f} degrees to the nearest axis, {limits}")
    return edge


def _too_few(count: int) -> Refusal:
    margin = WINDOW_PX + PLATEAU_PX
    return Refusal("few-rows", f"{count} rows with {margin} px on both sides of the edge, {MIN_ROWS} are needed")


SOFTNESS_PX = 0.35 * 1.2 ** np.arange(12)
"""What the model may have, 0.35 to 2.6 px: quarter pixels sample the least of it without alias."""

MODEL_FREQUENCIES = np.arange(0.01, 2, 0.02)
"""Where the model's spectrum is added up, cycles per pixel; it ends before 2, and its tails are cut at 50 px."""


@dataclass(frozen=True)
class Plateaus:
    """Fit of low + c / |d| on the left and high - c / |d| on the right of the edge, d the distance in pixels.

    Attributes:
        low: far on the left.
        high: far on the right.
        tail_px: a = pi c / (high - low), the tails of a PSF whose MTF begins as exp(-2 pi a |f|); 0 or more.
        sigma: scatter of a pixel around the fit.
        step_error: standard error of high - low, for white noise.
        softness_px: standard deviation of the Gaussian that, with the tails, comes closest to the edge itself.
    """

    low: float
    high: float
    tail_px: float
    sigma: float
    step_error: float
    softness_px: float = float(SOFTNESS_PX[0])

    @property
    def step(self) -> float:
        """Difference of the plateaus far from the edge: the DC of the MTF."""
        return self.high - self.low

    def model(self, distance: np.ndarray) -> np.ndarray:
        """An edge with these plateaus, tails and softness: (N,) for distances (N,) of a few pixels."""
        f = MODEL_FREQUENCIES
        waves = np.sin(2 * math.pi * f * distance[:, None]) / (math.pi * f)
        return np.asarray(self.low + self.step * (0.5 + (f[1] - f[0]) * waves @ self.transfer(f)))

    def transfer(self, frequencies: np.ndarray) -> np.ndarray:
        """MTF (F,) of that model at frequencies (F,) in cycles per pixel: 1 at 0."""
        gaussian = np.exp(-2 * (math.pi * self.softness_px * frequencies) ** 2)
        return np.asarray(np.exp(-2 * math.pi * self.tail_px * frequencies) * gaussian)

    def softened(self, distance: np.ndarray, values: np.ndarray) -> "Plateaus":
        """With the softness that comes closest to an edge of `values` (N,) at `distance` (N,) from its middle."""
        candidates = [replace(self, softness_px=float(s)) for s in SOFTNESS_PX]
        return min(candidates, key=lambda c: float(((values - c.model(distance)) ** 2).sum()))


def fit_plateaus(edge: Edge) -> Plateaus:
    """Least squares over all pixels beyond the window, both sides at once."""
    distance, values = edge.distance(), edge.image[edge.rows]
    far = np.abs(distance) > WINDOW_PX
    d, v = distance[far], values[far]
    terms = np.stack([d < 0, d > 0, -1 / d], axis=1).astype(np.float64)
    inverse = np.linalg.inv(terms.T @ terms)
    low, high, tail = (float(c) for c in inverse @ (terms.T @ v))
    sigma = float(np.sqrt(np.mean((v - terms @ (low, high, tail)) ** 2)))
    tail_px = max(math.pi * tail / (high - low), 0.0) if high > low else 0.0
    spread = inverse[0, 0] + inverse[1, 1] - 2 * inverse[0, 1]
    return Plateaus(low, high, tail_px, sigma, sigma * math.sqrt(spread))


BINS_PER_PX = 4
HALF = WINDOW_PX * BINS_PER_PX + 1
"""Bins on each side: one more than the window, for the derivative."""

ROW_LAG = 4
"""Rows over which the noise may be correlated; a restored image is smooth over a few."""


@dataclass(frozen=True)
class EdgeSpread:
    """The edge less the plateaus' model of it, in B bins of a quarter pixel.

    Without the tails it is compact, so the window around it costs next to nothing. The model only has to have the
    right tails: what else it gets wrong stands in the bins.

    Attributes:
        model: what was taken off.
        values: (B,) at the bins' centres.
        variance_px2: mean variance of the pixels' places within a bin: the blur that averaging adds.
        empty: share of bins that no pixel fell into.
        index: (R, W) each pixel's bin, -1 for none.
        counts: (B,) pixels in each bin.
        residual: (R, W) what each pixel is off the averaged edge.
    """

    model: Plateaus
    values: np.ndarray
    variance_px2: float
    empty: float
    index: np.ndarray
    counts: np.ndarray
    residual: np.ndarray

    def weights(self, frequencies: np.ndarray) -> np.ndarray:
        """(F, B) what each bin adds to the transform: derivative, window and cosine, the losses undone."""
        place = np.arange(-HALF + 1, HALF) / BINS_PER_PX
        wave = np.cos(2 * math.pi * frequencies[:, None] * place) * hamming(place)
        weights = np.zeros((frequencies.size, 2 * HALF + 1))
        # The derivative as a central difference, turned onto the weights so that it costs no pass of its own.
        weights[:, 2:] += wave / 2
        weights[:, :-2] -= wave / 2
        averaging = np.exp(-2 * (math.pi * frequencies) ** 2 * self.variance_px2)
        return np.asarray(weights / (averaging * np.sinc(2 * frequencies / BINS_PER_PX))[:, None])

    def standard_error(self, weights: np.ndarray) -> float:
        """Standard error of `weights @ values` for weights (B,), from what each row adds to the sum.

        Rows that lie near each other may be correlated: their products count too (Newey and West 1987).
        """
        share = weights / np.maximum(self.counts, 1)
        rows = (share[self.index] * self.residual).sum(1)
        products = [float(rows[lag:] @ rows[: rows.size - lag]) for lag in range(ROW_LAG + 1)]
        fading = [2 * (1 - lag / (ROW_LAG + 1)) for lag in range(1, ROW_LAG + 1)]
        variance = products[0] + sum(f * p for f, p in zip(fading, products[1:], strict=True))
        return math.sqrt(max(variance, 0.0))


def spread(edge: Edge, plateaus: Plateaus) -> EdgeSpread:
    """Average the pixels around the edge into bins, and what the best model leaves of them."""
    place = edge.distance() * BINS_PER_PX
    bins = np.rint(place).astype(int)
    inside = np.abs(bins) <= HALF
    index = np.where(inside, bins + HALF, -1)
    counts = np.bincount(index[inside], minlength=2 * HALF + 1)
    filled, centres = counts > 0, np.arange(-HALF, HALF + 1)

    def mean(x: np.ndarray) -> np.ndarray:
        sums = np.bincount(index[inside], x[inside], counts.size)
        return np.asarray(np.interp(centres, centres[filled], sums[filled] / counts[filled]))

    model = plateaus.softened(centres / BINS_PER_PX, mean(edge.image[edge.rows]))
    values = np.zeros_like(place)
    values[inside] = edge.image[edge.rows][inside] - model.model(place[inside] / BINS_PER_PX)
    shift = mean(place - bins)
    averages = _at_centres(mean(values), shift)
    variance = float((mean((place - bins) ** 2) - shift**2).mean()) / BINS_PER_PX**2
    # An average takes part of each of its pixels along, and of their like in the next row: both scatter too little.
    grown = (counts / np.maximum(counts - 2, 1))[index]
    residual = np.where(inside, values - np.interp(place, centres, averages), 0) * grown
    return EdgeSpread(model, averages, variance, float(1 - filled.mean()), index, counts, residual)


def _at_centres(averages: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Bin averages moved from their pixels' mean place to the bins' centres, to second order.

    Few rows or an unlucky angle (a slope of 1/4) leave a bin's pixels on one side of its centre.
    """
    place = np.arange(averages.size) + shift
    slope = np.gradient(averages, place)
    return np.asarray(averages - shift * slope + shift**2 / 2 * np.gradient(slope, place))


def slanted_edge(
    side_px: int, oversampling: int, angle_deg: float, radiance: tuple[float, float] = (40.0, 200.0)
) -> Tensor:
    """A straight edge through the middle of a square scene, (S, S) with S = side_px * oversampling.

    Simulate a scene much larger than the part you measure: its borders wrap around, which puts a second edge there.
    240 target pixels for a central part of 80 leave an error of 0.05 MTF points (measured).

    Args:
        side_px: side of the scene in target pixels.
        oversampling: scene pixels per target pixel.
        angle_deg: from the vertical; positive leans the edge's lower end to the left.
        radiance: W/m2/sr/um on the left and on the right.

    Returns:
        (side_px * oversampling,) * 2 float32 radiance. Edge pixels hold the share that the edge covers; the blur of
        that averaging, 1.6 % at Nyquist for an oversampling of 5, is taken off again to fourth order, at the price
        of an overshoot of some 4 % of the step.
    """
    angle = math.radians(angle_deg)
    place = np.arange(-2, side_px * oversampling + 2) - (side_px * oversampling - 1) / 2
    distance = place[None, :] * math.cos(angle) + place[:, None] * math.sin(angle)
    covered = _covered(distance, abs(math.cos(angle)), abs(math.sin(angle)))
    left, right = radiance
    return torch.from_numpy((left + (right - left) * _sharpened(covered)).astype(np.float32))


def _covered(distance: np.ndarray, width: float, height: float) -> np.ndarray:
    """Share of a unit square on the right of an edge at `distance` from its centre, whose projections are given.

    The square seen along the edge is a box of `width` smeared by one of `height`: the share is its double integral.
    """
    small, large = sorted((width, height))
    if small < 1e-9:
        return np.asarray(np.clip(distance / large + 0.5, 0, 1))
    ramps = [(sa * sb, distance + (sa * large + sb * small) / 2) for sa in (1, -1) for sb in (1, -1)]
    return np.asarray(sum(sign * np.maximum(x, 0) ** 2 for sign, x in ramps) / (2 * small * large))


def _sharpened(image: np.ndarray) -> np.ndarray:
    """The image without 1/24 of its second differences, which undoes a box of one pixel; 2 pixels a side shorter."""
    rows = image[1:-1] - (image[2:] - 2 * image[1:-1] + image[:-2]) / 24
    both = rows[:, 1:-1] - (rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2]) / 24
    return np.asarray(both[1:-1, 1:-1])
