"""Represent a falling MTF as a sum of simple ones, and compute the edge image of each.

    MTF(f) = sinc(f) * sum_k w_k P_k(f),    w_k >= 0,    sum w_k = 1

sinc is the square detector. P_k falls linearly from 1 to 0 within one step of 0.05 cycles per
pixel, each at its own frequency; the last one never falls. Any curve that falls from 1 is such a
sum. The image of an edge is the same sum of the edges' images, so that finding the curve is a
linear problem.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

STEP_CPX = 0.05
"""The width in cycles per pixel over which one part falls."""
CORNERS = np.linspace(0, 1, 21)
"""The frequencies between which the parts fall."""
PARTS = CORNERS.size
"""The number of parts. The last one represents the contrast beyond 1 cycle per pixel."""

SAMPLES_PER_PX = 16
REACH_PX = 24
HIGHEST_CPX = 2.5
"""The sampling and the reach of tabulated edges, and the highest wave in them."""
WAVES = 1250
"""The number of waves that form the tabulated edge; it repeats after 500 pixels."""

BENDS = (0.2, 0.4, 0.8)
"""Candidate standard deviations of the second differences of the weights, relative to the weights
there. The edges choose one.

exp(-gamma f), a Gaussian and diffraction with 2 to 30 % at Nyquist have 0.05 to 0.3 (computed). At
the cut-off of a pupil it is 1.
"""
FIRST_BEND = 0.1
"""Standard deviation of the first second difference: a curve may begin with a sudden loss (stray
light, far tails).
"""
LEAST_WEIGHT = 0.002
"""Smaller weights are treated as this weight when their bends are computed."""
SMOOTHING = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9
"""Window over which the weights are averaged before their expected bends are computed."""


def parts_at(frequencies: ArrayLike) -> np.ndarray:
    """Evaluate the simple curves P_k, of which an MTF is a weighted sum.

    Args:
        frequencies: in cycles per pixel, of any shape (...).

    Returns:
        The value of each curve, (..., PARTS).
    """
    frequency = np.asarray(frequencies, np.float64)[..., None]
    falling = np.clip((CORNERS[1:] - frequency) / STEP_CPX, 0.0, 1.0)
    return np.concatenate([falling, np.ones(frequency.shape)], axis=-1)


def mtf_at(frequencies: ArrayLike, weights: np.ndarray) -> np.ndarray:
    """Evaluate an MTF at some frequencies.

    Args:
        frequencies: in cycles per pixel, of any shape.
        weights: (PARTS,) the weights of the simple curves P_k.

    Returns:
        The contrast, of the same shape.
    """
    frequency = np.asarray(frequencies, np.float64)
    return np.asarray(np.sinc(frequency) * (parts_at(frequency) @ weights))


def weights_of(contrast: np.ndarray) -> np.ndarray:
    """Return the weights (PARTS,) of the curve that has the contrasts (PARTS,) at CORNERS, without
    the square detector; the first is 1.
    """
    return np.append(-np.diff(contrast), contrast[-1])


def softened(weights: np.ndarray, softness_px: float) -> np.ndarray:
    """Return the weights of an MTF curve that is multiplied by exp(-softness f).

    Args:
        weights: (PARTS,) of the curve.
        softness_px: the softness in pixels; a negative one sharpens.
    """
    contrast = np.append(1.0, 1.0 - np.cumsum(weights[:-1]))
    return weights_of(contrast * np.exp(-softness_px * CORNERS))


@cache
def responses() -> tuple[np.ndarray, np.ndarray]:
    """Compute the image of a step of 1 at 0, and of a thin line there, for each of the simple
    curves P_k.

    The step behind an MTF is 1/2 + the sum over f of MTF(f) sin(2 pi f d) / (pi f). The line is its
    derivative.

    Returns:
        Steps and lines, (2 * REACH_PX * SAMPLES_PER_PX + 1, PARTS) each, by the distance from
        -REACH_PX to REACH_PX pixels.
    """
    frequency = (np.arange(WAVES) + 0.5) * HIGHEST_CPX / WAVES
    distance = np.arange(-REACH_PX * SAMPLES_PER_PX, REACH_PX * SAMPLES_PER_PX + 1) / SAMPLES_PER_PX
    phase = 2 * math.pi * distance[:, None] * frequency
    transfer = np.sinc(frequency)[:, None] * parts_at(frequency) * HIGHEST_CPX / WAVES
    edges = 0.5 + np.sin(phase) @ (transfer / (math.pi * frequency[:, None]))
    return edges, np.cos(phase) @ (2 * transfer)


def at_distances(table: np.ndarray, distance_px: np.ndarray) -> np.ndarray:
    """Interpolate a table of `responses` at some distances from the edge.

    Args:
        table: (T,) for one curve or (T, PARTS) for all simple ones.
        distance_px: (N,) distances in pixels.

    Returns:
        Values (N,) or (N, PARTS).
    """
    # The last sample has no neighbour on its right.
    place = np.clip((distance_px + REACH_PX) * SAMPLES_PER_PX, 0, len(table) - 1.001)
    row = place.astype(int)
    share = place - row
    if table.ndim == 2:
        share = share[:, None]
    return np.asarray(table[row] * (1 - share) + table[row + 1] * share)


SECOND_DIFFERENCES = np.pad(np.diff(np.eye(PARTS - 1), 2, axis=0), ((0, 0), (0, 1)))


def expected_bends(weights: np.ndarray, bend: float) -> np.ndarray:
    """Build the matrix that computes the bends of a curve, the second differences of its weights,
    relative to their expected size.

    Args:
        weights: (PARTS,) of a similar curve. Bends are expected to be larger where these are
            larger.
        bend: the expected bend as a share of the weights there.

    Returns:
        (PARTS - 3, PARTS).
    """
    padded = np.pad(weights[:-1], 2, mode="edge")
    size = np.maximum(np.convolve(padded, SMOOTHING, mode="valid"), LEAST_WEIGHT)[1:-1] * bend
    size[0] = max(size[0], FIRST_BEND)
    return SECOND_DIFFERENCES / size[:, None]


def solve(
    gram: np.ndarray,
    moment: np.ndarray,
    near: np.ndarray,
    bend: float,
    bends: np.ndarray | None = None,
) -> np.ndarray:
    """Solve for the weights of the curve that fits best; they are not negative and have the sum 1.

    Args:
        gram: (PARTS, PARTS) left side of the normal equations, in units of the noise.
        moment: (PARTS,) right side of the normal equations.
        near: (PARTS,) weights near the solution; larger ones may bend more.
        bend: the expected bend, as a share of these weights.
        bends: (PARTS - 3,) the second differences to expect, over their standard deviations; None
            for 0, which is a smooth curve.

    Returns:
        The weights (PARTS,).
    """
    # Imported here, because only measurements of sensors need SciPy.
    from scipy.optimize import nnls

    expected = expected_bends(near, bend)
    gram = gram + expected.T @ expected
    if bends is not None:
        moment = moment + expected.T @ bends
    # A sum of 1 is held by a weight far above all others', and exactly by the division below.
    hold = 100.0 * np.trace(gram)
    root = np.linalg.cholesky(gram + hold + 1e-9 * np.trace(gram) * np.eye(PARTS))
    weights, _ = nnls(root.T, np.linalg.solve(root, moment + hold))
    return np.asarray(weights / weights.sum())


def likeliest_bend(gram: np.ndarray, moment: np.ndarray, near: np.ndarray) -> float:
    """Return the value of BENDS, the expected bend of a curve, that explains the edges best.

    It has the largest marginal likelihood of normally distributed weights.

    Args:
        gram: (PARTS, PARTS) left side of the normal equations, in units of the noise.
        moment: (PARTS,) right side of the normal equations.
        near: (PARTS,) weights near the solution.
    """

    def evidence(bend: float) -> float:
        expected = expected_bends(near, bend)
        weights = solve(gram, moment, near, bend)
        precision = gram + expected.T @ expected
        misfit = float(weights @ precision @ weights - 2 * moment @ weights)
        _, log_volume = np.linalg.slogdet(precision + np.trace(precision) * 1e-12 * np.eye(PARTS))
        return -0.5 * misfit - 0.5 * float(log_volume) - len(expected) * math.log(bend)

    return max(BENDS, key=evidence)
