"""A falling MTF as a sum of simple ones, and the edge that each of them would show.

    MTF(f) = sinc(f) * sum_k w_k P_k(f),    w_k >= 0,    sum w_k = 1

sinc is the square detector. P_k falls linearly from 1 to 0 within one step of 0.05 cycles per
pixel, each at its own frequency; the last one never falls. Any curve that falls from 1 is such a
sum, and the image of an edge is the same sum of the edges' images: that makes finding the curve a
linear problem.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

STEP_CPX = 0.05
"""Cycles per pixel over which one part falls."""
CORNERS = np.linspace(0, 1, 21)
"""Frequencies between which the parts fall."""
PARTS = CORNERS.size
"""The last part stands for what is left beyond 1 cycle per pixel."""

SAMPLES_PER_PX = 16
REACH_PX = 24
HIGHEST_CPX = 2.5
WAVES = 1250
"""Waves that make the tabulated edge: it repeats after 500 pixels."""

BENDS = (0.2, 0.4, 0.8)
"""Standard deviations of the second differences of the weights over the weights there, of which
edges choose one.

exp(-gamma f), a Gaussian and diffraction with 2 to 30 % at Nyquist have 0.05 to 0.3 (computed);
where a pupil cuts off, 1.
"""
FIRST_BEND = 0.1
"""Standard deviation of the first of them: a curve may begin with a sudden loss (stray light, far
tails).
"""
LEAST_WEIGHT = 0.002
"""Below it bends are as those of this weight."""
SMOOTHING = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9
"""Over which the weights are averaged before their bends are expected."""


def parts_at(frequencies: ArrayLike) -> np.ndarray:
    """P_k at frequencies of any shape (...): (..., PARTS)."""
    frequency = np.asarray(frequencies, np.float64)[..., None]
    falling = np.clip((CORNERS[1:] - frequency) / STEP_CPX, 0.0, 1.0)
    return np.concatenate([falling, np.ones(frequency.shape)], axis=-1)


def mtf_at(frequencies: ArrayLike, weights: np.ndarray) -> np.ndarray:
    """The MTF of weights (PARTS,) at frequencies of any shape, in cycles per pixel."""
    frequency = np.asarray(frequencies, np.float64)
    return np.asarray(np.sinc(frequency) * (parts_at(frequency) @ weights))


def weights_of(contrast: np.ndarray) -> np.ndarray:
    """The weights (PARTS,) of optics with these contrasts at CORNERS, 1 at the first."""
    return np.append(-np.diff(contrast), contrast[-1])


def softened(weights: np.ndarray, softness_px: float) -> np.ndarray:
    """The weights of a curve times exp(-softness f)."""
    contrast = np.append(1.0, 1.0 - np.cumsum(weights[:-1]))
    return weights_of(contrast * np.exp(-softness_px * CORNERS))


@cache
def responses() -> tuple[np.ndarray, np.ndarray]:
    """What a detector sees of a step of 1 at 0, and of a thin line there, behind each part.

    The step behind an MTF is 1/2 + the sum over f of MTF(f) sin(2 pi f d) / (pi f); the line is its
    derivative.

    Returns:
        Edges and lines, (2 * REACH_PX * SAMPLES_PER_PX + 1, PARTS) each.
    """
    frequency = (np.arange(WAVES) + 0.5) * HIGHEST_CPX / WAVES
    distance = np.arange(-REACH_PX * SAMPLES_PER_PX, REACH_PX * SAMPLES_PER_PX + 1) / SAMPLES_PER_PX
    phase = 2 * math.pi * distance[:, None] * frequency
    transfer = np.sinc(frequency)[:, None] * parts_at(frequency) * HIGHEST_CPX / WAVES
    edges = 0.5 + np.sin(phase) @ (transfer / (math.pi * frequency[:, None]))
    return edges, np.cos(phase) @ (2 * transfer)


def at_distances(table: np.ndarray, distance_px: np.ndarray) -> np.ndarray:
    """A tabulated edge or line, (T,) or (T, PARTS), at distances (N,) from it:
    (N,) or (N, PARTS).
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
    """(PARTS - 3, PARTS): second differences of weights over what is expected of them around
    `weights` (PARTS,).
    """
    padded = np.pad(weights[:-1], 2, mode="edge")
    size = np.maximum(np.convolve(padded, SMOOTHING, mode="valid"), LEAST_WEIGHT)[1:-1] * bend
    size[0] = max(size[0], FIRST_BEND)
    return np.asarray(SECOND_DIFFERENCES / size[:, None])


def solve(
    gram: np.ndarray,
    moment: np.ndarray,
    near: np.ndarray,
    bend: float,
    bends: np.ndarray | None = None,
) -> np.ndarray:
    """The weights that fit best, none negative and of sum 1.

    Args:
        gram: (PARTS, PARTS) of the least-squares problem, in units of the noise.
        moment: (PARTS,) its right side.
        near: (PARTS,) weights near the solution: larger ones may bend more.
        bend: by how much, of them.
        bends: (PARTS - 3,) what the second differences are expected to be, over their deviations; 0
            without.
    """
    # Imported here: who measures no sensor need not wait for SciPy.
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
    """Which of BENDS explains the edges best: the largest marginal likelihood of normal weights.

    Args:
        gram: (PARTS, PARTS) of the least-squares problem, in units of the noise.
        moment: (PARTS,) its right side.
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
