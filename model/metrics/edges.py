"""Where a slanted edge runs: one position per row, and the straight line through them."""

import math
from dataclasses import dataclass

import numpy as np

from model.metrics.refusal import Refusal

WINDOW_PX = 10
"""Half width of the Hamming window around the edge (facts, metrics (a))."""

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
    """Transposed and mirrored so that values rise from left to right."""
    across, down = (_rise(image, axis) for axis in (1, 0))
    if abs(down) > abs(across):
        image, across = image.T, down
    return np.asarray(image if across >= 0 else image[:, ::-1], np.float64)


def _rise(image: np.ndarray, axis: int) -> float:
    first, *_, last = np.array_split(image, 3, axis=axis)
    return float(last.mean() - first.mean())


def _steepest(image: np.ndarray) -> np.ndarray:
    """Column of the steepest rise of each row, in a derivative smoothed over 9 pixels."""
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
    """Hamming window of half width WINDOW_PX around 0, 0 beyond."""
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
