"""What a slanted edge looks like across, in quarter pixels, and how well that is known."""

import math
from dataclasses import dataclass

import numpy as np

from model.metrics.edges import WINDOW_PX, Edge, hamming
from model.metrics.plateaus import Plateaus

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
        weights[:, 2:] += wave / 2
        weights[:, :-2] -= wave / 2
        averaging = np.exp(-2 * (math.pi * frequencies) ** 2 * self.variance_px2)
        return np.asarray(weights / (averaging * np.sinc(2 * frequencies / BINS_PER_PX))[:, None])

    def standard_error(self, weights: np.ndarray) -> float:
        """Of weights @ values, from what each row adds to it (Newey and West 1987: near rows may be correlated)."""
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
