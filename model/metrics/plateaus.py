"""A model of an edge from its plateaus, its far tails and its softness."""

import math
from dataclasses import dataclass, replace

import numpy as np

from model.metrics.edges import WINDOW_PX, Edge

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
        """MTF of that model."""
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
