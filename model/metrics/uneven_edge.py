"""Fit one straight edge between uneven sides, and derive what it contributes to the MTF.

Roofs, kerbs and shadows are no calibration targets. Each side is a plane of its own, and the rest
of its texture counts as noise: it lowers the weight of the edge instead of excluding it.

    pixel = left plane * (1 - E(d)) + right plane * E(d)
    d     = distance to the edge along its normal

E is the image of a step (`mtf_basis`). Gauss-Newton with Huber's weights finds the line and the
planes for a known E. The residual is linear in the weights of E, and is returned as normal
equations.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from beers_deploy.model.metrics.mtf_basis import PARTS, at_distances, responses, softened
from beers_deploy.model.metrics.statistics import robust_deviation

HALF_PX = 8.0
"""The distance from the edge up to which pixels are fitted."""
STRIP_PX = 5
"""Length of the strips along the edge that count as independent looks: longer
than blurred texture.
"""

GRADIENT = 0.08
"""Standard deviation of a plane's change over HALF_PX away from the edge, relative to the step.

Far tails of the blur look the same. With a larger value gradients would replace them.
"""
BOW_PX = 0.3
"""Standard deviation of how far an edge bends off a straight line at its ends:
distortion, kerbs.
"""
HUBER = 2.5
"""The number of robust deviations from which a pixel is weighted less: cars, branches and drains
lie next to edges.
"""

LEVELS = 6
NUMBERS = 9
"""The number of parameters of both planes; and with those of the line."""
MAX_STEP = np.array([0.7, 0.1, 0.3])
"""The largest change of place, slope and bow in one pass."""
SOFTER_PX = 0.05
"""Small change of softness by which the derivative is taken."""


@dataclass(frozen=True)
class EdgePixels:
    """The pixels around one near-vertical edge.

    Attributes:
        values: (H, W) digital numbers.
        variance: (H, W) variance of the noise of each pixel.
        label: the name of the edge, for messages.
    """

    values: np.ndarray
    variance: np.ndarray
    label: str


class NearPixels(NamedTuple):
    """The P pixels near an edge, which are fitted; (P,) each.

    Attributes:
        distance_px: the distance from the edge, negative on the left.
        along_px: the row, relative to the middle.
        values: the digital number.
        variance: the variance of its noise.
    """

    distance_px: np.ndarray
    along_px: np.ndarray
    values: np.ndarray
    variance: np.ndarray


class EdgeLine(NamedTuple):
    """The line of an edge: x = place + slope * y + bow * (2 y / H)^2, from the middle of its H
    rows.

    Attributes:
        place_px: the column in which the edge crosses the middle row, relative to the middle.
        slope: the number of columns by which the edge moves from one row to the next.
        bow_px: the deviation from a straight line at both ends, in pixels.
    """

    place_px: float
    slope: float
    bow_px: float = 0.0


@dataclass(frozen=True)
class FittedEdge:
    """An edge whose line and planes are known for one curve.

    Attributes:
        pixels: the pixels of the edge.
        line: the line of the edge.
        step: difference of the planes at the edge.
        unevenness: root mean square of the residual texture of the planes, relative to the step.
        normal: (P + 9, 9) weighted derivatives of the P pixels by planes and line, followed by the
            rows that regularise these 9 numbers.
        curve: (P + 9, PARTS) weighted derivatives by the weights of the curve, followed by zeros.
        rest: (P + 9,) the weighted residuals, followed by the right side of the regularisation.
        strip: (P,) number of the strip along the edge that each pixel lies in.
    """

    pixels: EdgePixels
    line: EdgeLine
    step: float
    unevenness: float
    normal: np.ndarray
    curve: np.ndarray
    rest: np.ndarray
    strip: np.ndarray


def fit_edge(
    pixels: EdgePixels, line: EdgeLine, weights: np.ndarray, passes: int
) -> FittedEdge | None:
    """Fit the line and both planes of an edge to a known MTF curve.

    Args:
        pixels: the pixels around the edge.
        line: where the edge runs approximately, within a pixel or two.
        weights: (PARTS,) of the curve, as in `mtf_basis`.
        passes: the number of iterations of Gauss-Newton.

    Returns:
        The edge, or None if it leaves its pixels or has no step.
    """
    levels = None
    fitted = None
    for _ in range(passes):
        near = _near(pixels, line)
        left = near.distance_px < -2
        right = near.distance_px > 2
        if min(left.sum(), right.sum()) < 4 * HALF_PX:
            return None
        if levels is None:
            on_left, on_right = (np.median(near.values[side]) for side in (left, right))
            levels = np.array([on_left, 0, 0, on_right, 0, 0])
        if levels[0] == levels[3]:
            return None
        fitted = _linearised(pixels, near, line, levels, weights)
        change = np.linalg.lstsq(fitted.normal, fitted.rest, rcond=None)[0]
        levels = levels + change[:LEVELS]
        numbers = np.array(line) + np.clip(change[LEVELS:], -MAX_STEP, MAX_STEP)
        line = EdgeLine(*numbers.tolist())
    return fitted


def _linearised(
    pixels: EdgePixels, near: NearPixels, line: EdgeLine, levels: np.ndarray, weights: np.ndarray
) -> FittedEdge:
    """Return an edge with the equations of one pass of Gauss-Newton.

    Args:
        pixels: the pixels around the edge.
        near: those that are fitted.
        line: the current line.
        levels: (6,) the current parameters of the left plane, then of the right one.
        weights: (PARTS,) of the curve.
    """
    edges, lines = responses()
    height = pixels.values.shape[0]
    step = levels[3] - levels[0]
    ones = np.ones_like(near.along_px)
    # The derivatives of each pixel by the three parameters of a plane.
    plane = np.stack([ones, 2 * near.along_px / height, near.distance_px / HALF_PX], axis=1)
    share = at_distances(edges @ weights, near.distance_px)[:, None]
    by_levels = np.hstack([plane * (1 - share), plane * share])
    rest = near.values - by_levels @ levels
    scale = max(robust_deviation(rest), 1e-9)
    # Cars, branches and drains lie next to edges, so pixels with large residuals count less.
    huber = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(rest), 1e-9))
    # A residual beyond the noise is texture, which lowers the weight of the edge.
    texture = max(float(np.average(rest**2, weights=huber)) - float(near.variance.mean()), 0.0)
    pixel_weights = np.sqrt(huber / (near.variance + texture))
    rise = plane @ (levels[3:] - levels[:3])
    # The derivatives of each pixel by place, slope and bow of the line.
    slope = rise * at_distances(lines @ weights, near.distance_px)
    by_place = -slope / math.hypot(1, line.slope)
    by_line = np.stack(
        [by_place, by_place * near.along_px, by_place * (2 * near.along_px / height) ** 2], axis=1
    )
    by_curve = (rise * pixel_weights)[:, None] * at_distances(edges, near.distance_px)
    expected, expected_rest = _expectations(levels, line, step)
    return FittedEdge(
        pixels=pixels,
        line=line,
        step=abs(step),
        unevenness=math.sqrt(texture) / abs(step),
        normal=np.vstack([np.hstack([by_levels, by_line]) * pixel_weights[:, None], expected]),
        curve=np.vstack([by_curve, np.zeros((NUMBERS, PARTS))]),
        rest=np.concatenate([rest * pixel_weights, expected_rest]),
        strip=np.floor((near.along_px + height / 2) / STRIP_PX).astype(int),
    )


def _near(pixels: EdgePixels, line: EdgeLine) -> NearPixels:
    """Return the pixels within HALF_PX of the line on both sides."""
    height, width = pixels.values.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    y -= (height - 1) / 2
    x -= (width - 1) / 2
    across = x - line.place_px - line.slope * y - line.bow_px * (2 * y / height) ** 2
    distance_px = across / math.hypot(1, line.slope)
    near = np.abs(distance_px) <= HALF_PX
    return NearPixels(distance_px[near], y[near], pixels.values[near], pixels.variance[near])


def _expectations(levels: np.ndarray, line: EdgeLine, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Build rows (9, 9) that regularise gradients and bow towards 0, and their right side (9,)."""
    rows = np.zeros((NUMBERS, NUMBERS))
    right = np.zeros(NUMBERS)
    gradient = GRADIENT * abs(step)
    # The change away from the edge on either side, which far tails of the blur resemble.
    for number in (2, 5):
        rows[number, number] = 1 / gradient
        right[number] = -levels[number] / gradient
    rows[-1, -1] = 1 / BOW_PX
    right[-1] = -line.bow_px / BOW_PX
    return rows, right


def normal_equations(
    edge: FittedEdge, weights: np.ndarray, counts: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute what one edge says about the MTF curve, as normal equations with its line and planes
    projected out.

    Args:
        edge: the edge, fitted to the curve of `weights`.
        weights: (PARTS,) of the curve, as in `mtf_basis`.
        counts: the number of times that each strip along the edge counts; None counts each once.

    Returns:
        The left side (PARTS, PARTS) and the right side (PARTS,) of the equations for the weights of
        the curve; those of several edges are added.
    """
    normal = edge.normal
    curve = edge.curve
    residuals = edge.rest
    if counts is not None:
        root_counts = np.sqrt(counts[np.minimum(edge.strip, len(counts) - 1)])
        root_counts = np.append(root_counts, np.ones(NUMBERS))
        normal = normal * root_counts[:, None]
        curve = curve * root_counts[:, None]
        residuals = residuals * root_counts
    curve, residuals = _unexplained(normal, curve, residuals)
    return curve.T @ curve, curve.T @ (residuals + curve @ weights)


def _unexplained(normal: np.ndarray, *values: np.ndarray) -> list[np.ndarray]:
    """Return values without the part that planes and line could explain, so that the rest depends
    on the curve alone.
    """
    basis, _ = np.linalg.qr(normal)
    return [value - basis @ (basis.T @ value) for value in values]


def strips_of(edge: FittedEdge) -> int:
    """Return the number of independent strips, of STRIP_PX rows each, along the edge."""
    return max(int(edge.pixels.values.shape[0]) // STRIP_PX, 2)


def softness(edges: Sequence[FittedEdge], weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate by how much edges are softer than an MTF curve, and the standard errors.

    The softness is s in pixels of a further factor exp(-s f). Its error is the larger of two: that
    from noise and texture, and that from the differences between the strips along the edge.

    Args:
        edges: the N edges, fitted to the curve of `weights`.
        weights: (PARTS,) of the curve, as in `mtf_basis`.

    Returns:
        The softness of each edge and its standard error, (N,) each, both in pixels.
    """
    values = []
    errors = []
    for edge in edges:
        change = edge.curve @ (softened(weights, SOFTER_PX) - weights) / SOFTER_PX
        by_softness, residuals = _unexplained(edge.normal, change, edge.rest)
        size = float(by_softness @ by_softness)
        value = float(by_softness @ residuals) / size
        contributions = (by_softness * (residuals - value * by_softness))[: edge.strip.size]
        # Texture is alike over some pixels along the edge: strips are independent, pixels are not.
        by_strip = np.bincount(edge.strip - edge.strip.min(), weights=contributions)
        values.append(value)
        errors.append(max(size**-0.5, math.sqrt(float((by_strip**2).sum())) / size))
    return np.array(values), np.array(errors)
