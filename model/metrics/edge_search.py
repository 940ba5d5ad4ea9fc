"""Find edges to measure an MTF on: by searching an image, or the one that crosses a box.

An edge is a square or box of pixels and the line that runs through it; `edge_curve` fits both again
together with the curve.
"""

import math

import numpy as np

from beers_deploy.model.metrics.edge_blur import THOROUGH, plain_squares
from beers_deploy.model.metrics.edge_fit import (
    ANY,
    MAX_SLOPE,
    Limits,
    Noise,
    centroids,
    fit_shape,
)
from beers_deploy.model.metrics.mtf_basis import CORNERS, weights_of
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.uneven_edge import EdgeLine, EdgePixels, fit_edge

START = weights_of(np.exp(-4.0 * CORNERS))
"""The curve to begin with: 8.6 % at Nyquist."""
FIRST_PASSES = 6
MOST_EDGES = 60
"""The maximum number of edges, the least uneven first; more take time and improve little."""

SEARCHED = Limits(20, 0.12, 0.8)
MAX_ROUGHNESS = 0.15
"""Limits for a square to be fitted. They are looser than for a target, because its planes and
texture are fitted too.
"""
POINTED_STEP_SIGMA = 10.0
POINTED_UNEVENNESS = 0.2

Edge = tuple[EdgePixels, EdgeLine]


def find_edges(image: np.ndarray, noise: Noise, clipped_at: float, label: str) -> list[Edge]:
    """Find squares around near-vertical edges of an image (H, W), and the line of each edge.

    Transpose the image for near-horizontal edges. Of more than MOST_EDGES, those that fit a blurred
    step best are returned.

    Args:
        image: (H, W), finite values.
        noise: returns the variance of the noise of pixels of given values.
        clipped_at: the smallest value that counts as clipped. Values of 0 or below are clipped too.
        label: the name of the image, for messages on its edges.

    Returns:
        The pixels and the line of each edge, the best first.
    """
    squares = plain_squares(image, noise, clipped_at, THOROUGH, MAX_ROUGHNESS)
    if not squares.size:
        return []
    scaled = squares / np.sqrt(noise(squares).mean((1, 2)))[:, None, None]
    fits = zip(squares, fit_shape(scaled, SEARCHED), strict=True)
    blurs = [(fit, square) for square, fit in fits if fit is not None]
    blurs.sort(key=lambda pair: pair[0].chi2 / pair[0].count / float(np.ptp(pair[1])) ** 2)
    return [
        (EdgePixels(square, noise(square), label), EdgeLine(fit.place, fit.slope))
        for fit, square in blurs[:MOST_EDGES]
    ]


def edge_in(region: np.ndarray, noise: Noise, label: str) -> Edge | Refusal:
    """Find the one near-vertical edge that crosses a region from top to bottom, which a person has
    pointed at.

    Args:
        region: (H, W) finite pixels.
        noise: returns the variance of the noise of pixels of given values.
        label: the name of the edge, for messages.

    Returns:
        The pixels and the line of the edge, or the reason why there is none.
    """
    scale = math.sqrt(float(noise(region).mean()))
    pixels = EdgePixels(region, noise(region), label)
    fit = fit_shape(region[None] / scale, ANY)[0]
    if fit:
        line = EdgeLine(fit.place, fit.slope)
    else:
        # From the position of the rise in each row.
        rows, columns = (np.arange(size) - (size - 1) / 2 for size in region.shape)
        rough = centroids(region[None], rows, columns)
        slope = float(np.clip(rough.slope[0], -MAX_SLOPE, MAX_SLOPE))
        line = EdgeLine(float(rough.place[0]), slope)
    fitted = fit_edge(pixels, line, START, FIRST_PASSES)
    if fitted is None or abs(fitted.line.slope) > MAX_SLOPE:
        return Refusal("no straight edge near to an axis with 8 pixels on both sides")
    if fitted.step < POINTED_STEP_SIGMA * scale:
        return Refusal(
            f"a step of {fitted.step / scale:.3g} times the noise, {POINTED_STEP_SIGMA:g} are "
            "needed"
        )
    if fitted.unevenness > POINTED_UNEVENNESS:
        return Refusal(
            f"sides that are uneven by {fitted.unevenness:.0%} of the step, "
            f"{POINTED_UNEVENNESS:.0%} at most"
        )
    return pixels, fitted.line
