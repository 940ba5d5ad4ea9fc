"""Fit the blur across short straight edges, each in a few pixels around it, by the curve that a
profile states.

MTF(f) = exp(-gamma f) sinc(f) (`simulator.mtf`) has one number, for which 17 x 17 pixels are
enough. Gauss-Newton finds it together with the edge's place, its slope and the levels of both
sides. Many squares are fitted at once, because fitting one at a time takes ten times as long
(measured): each step is only a few hundred multiplications.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from beers_deploy.model.metrics.mtf_basis import HIGHEST_CPX, REACH_PX, SAMPLES_PER_PX

HALF_PX = 8
"""Half the side of the square around a found edge, and how far from an edge pixels are fitted."""

GAMMAS = np.linspace(0.0, 10.0, 101)
"""Values of gamma for which the edge is tabulated: MTF at Nyquist from 64 to 0.4 %."""
STEEPER = (4.0, 8.0)
"""Gaussian parts that are tried on an edge that the profile's curve does not fit."""

PERIOD_PX = 250
"""The tabulated edge repeats after this number of pixels, with the opposite sign."""
START_GAMMA = 4.0
LEAST_GAMMA = 0.05
LARGEST_GAMMA = 9.9
MAX_PLACE_PX = 3.0
MAX_SLOPE = math.tan(math.radians(35))
MAX_STEP = np.array([0.7, 0.1, 1.5])
"""The largest change of place, slope and gamma in one pass."""
PASSES = 15
CONVERGED = 1e-3

Noise = Callable[[np.ndarray], np.ndarray]
"""A function that returns the variance of the noise of pixels with these values, of any shape, in
the square of their unit.
"""


@dataclass(frozen=True)
class EdgeBlur:
    """The blur that was fitted across one edge.

    Attributes:
        gamma: the gamma of MTF(f) = exp(-gamma f) sinc(f), f in cycles per pixel along the edge's
            normal.
        error: the standard error of gamma.
        slope: the number of columns by which the edge moves from one row to the next; 0 is
            vertical.
        place: the column in which the edge crosses the middle row, relative to the middle of the
            pixels.
        pixels: the fitted pixels (H, W), divided by the standard deviation of their noise.
        chi2: the sum of squares of the residuals of the pixels near the edge.
        count: the number of these pixels, less the five numbers fitted.
    """

    gamma: float
    error: float
    slope: float
    place: float
    pixels: np.ndarray
    chi2: float
    count: int


Fit = EdgeBlur | None
"""The blur across an edge, or None if there is no edge within the limits."""


@dataclass(frozen=True)
class Limits:
    """The quality that the fit of an edge must have for the edge to be used.

    Attributes:
        step_sigma: the least difference of the two sides, in standard deviations of the noise of a
            pixel. A fainter edge may be no edge at all.
        misfit: the largest root mean square residual that the noise does not explain, relative to
            the step.
        error: the largest standard error of gamma; 0.6 is a third of the MTF.
    """

    step_sigma: float
    misfit: float
    error: float = 0.6


STRICT = Limits(30, 0.012)
ANY = Limits(0, math.inf, math.inf)
"""Limits for edges found by search, among many candidates that are none, and for places that
certainly are edges.
"""


@lru_cache(maxsize=16)
def _responses(shape: float) -> np.ndarray:
    """Compute the image of a step of 1 at 0 for each of GAMMAS and each distance.

    It is the sum over f of MTF(f) sin(2 pi f d) / (pi f), by a Fourier transform over f = (k + 1/2)
    / PERIOD_PX. As a matrix product the sum would occupy every core for far longer.

    Returns:
        Responses (101, 2 * REACH_PX * SAMPLES_PER_PX + 1).
    """
    f = (np.arange(int(HIGHEST_CPX * PERIOD_PX)) + 0.5) / PERIOD_PX
    waves = np.exp(-np.outer(GAMMAS, f) - shape * f**2) * np.sinc(f) / (math.pi * f * PERIOD_PX)
    places = np.arange(REACH_PX * SAMPLES_PER_PX + 1)
    sums = np.fft.ifft(waves, PERIOD_PX * SAMPLES_PER_PX, norm="forward")[:, places]
    # The response is odd around the edge: the left half is the right one, turned around.
    half = (sums * np.exp(1j * math.pi * places / (PERIOD_PX * SAMPLES_PER_PX))).imag
    return 0.5 + np.concatenate([-half[:, :0:-1], half], axis=1)


def _at_gammas(gammas: np.ndarray, shape: float) -> np.ndarray:
    """Return the tabulated edge of each gamma (N,): (N, 2 * REACH_PX * SAMPLES_PER_PX + 1)."""
    table = _responses(shape)
    row = np.minimum((gammas / GAMMAS[1]).astype(int), GAMMAS.size - 2)
    part = (gammas / GAMMAS[1] - row)[:, None]
    return np.asarray(table[row] * (1 - part) + table[row + 1] * part)


def _at_distances(lines: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return tabulated edges (N, T) at the distances (N, P) from each."""
    count, length = lines.shape
    # The last sample has no neighbour on its right.
    place = np.clip((distance + REACH_PX) * SAMPLES_PER_PX, 0, length - 1.001)
    column = place.astype(int)
    share = place - column
    column += np.arange(count)[:, None] * length
    samples = lines.ravel()
    return np.asarray(samples[column] * (1 - share) + samples[column + 1] * share)


def fit_blurs(regions: np.ndarray, noise: Noise, limits: Limits) -> list[Fit]:
    """Fit the blur of the one near-vertical edge that crosses each region from top to bottom.

    Args:
        regions: (N, H, W) finite values of any linear unit, rising or falling from left to right.
        noise: returns the variance of the noise of pixels of given values.
        limits: the quality that a fit must have.

    Returns:
        For each region the blur by the curve exp(-gamma f) sinc(f); None where no shape of the
        curve fits.
    """
    # Over their noise: residuals are then in its standard deviations.
    pixels = regions / np.sqrt(noise(regions).mean((1, 2)))[:, None, None]
    results = fit_shape(pixels, limits)
    refused = [k for k, fit in enumerate(results) if fit is None]
    steeper = set[int]()
    for shape in STEEPER:
        remaining = [k for k in refused if k not in steeper]
        fits = fit_shape(pixels[remaining], limits, shape)
        steeper |= {k for k, fit in zip(remaining, fits, strict=True) if fit is not None}
    # A square that a steeper curve fits is an edge, but its blur is that of the profile's curve.
    steep = sorted(steeper)
    for k, fit in zip(steep, fit_shape(pixels[steep], ANY), strict=True):
        results[k] = fit
    return results


class _Lines(NamedTuple):
    """The assumed lines of edges, (N,) each, relative to the middle of a region, and their
    softness.
    """

    place: np.ndarray
    slope: np.ndarray
    gamma: np.ndarray

    def only(self, index: np.ndarray) -> "_Lines":
        """Return the lines that `index`, bool or numbers, picks."""
        return _Lines(*(column[index] for column in self))


def fit_shape(pixels: np.ndarray, limits: Limits, shape: float = 0.0) -> list[Fit]:
    """Fit the blur of edges as `fit_blurs` does, for one shape of the curve only: exp(-gamma f -
    shape f^2) sinc(f).

    Args:
        pixels: (N, H, W), scaled such that their noise has a standard deviation of 1.
        limits: the quality that a fit must have.
        shape: the coefficient of the Gaussian part; 0 is the curve of a sensor's profile.

    Returns:
        The blur of each edge; None where the fit fails or is not good enough.
    """
    count, height, width = pixels.shape
    fits: list[Fit] = [None] * count
    if not count:
        return fits
    y, x = (np.arange(size) - (size - 1) / 2 for size in (height, width))
    lines = centroids(pixels, y, x)
    across = np.tile(x, height)
    down = np.repeat(y, width)
    start = lines.place
    values = pixels.reshape(count, -1)
    active = np.arange(count)
    for _ in range(PASSES):
        mask = np.abs(across - lines.place[:, None] - lines.slope[:, None] * down) <= HALF_PX
        enough = mask.sum(1) >= 10 * HALF_PX
        lines = lines.only(enough)
        active = active[enough]
        mask = mask[enough]
        change, variance, steps, chi2s = _solve(lines, across, down, values[active], mask, shape)
        place, slope, softer = np.clip(change, -MAX_STEP, MAX_STEP).T
        gamma = np.clip(lines.gamma + softer, 0.0, float(GAMMAS[-1]))
        gamma_change = np.abs(gamma - lines.gamma)
        lines = _Lines(lines.place + place, lines.slope + slope, gamma)
        astray = (np.abs(lines.place - start[active]) > MAX_PLACE_PX) | (
            np.abs(lines.slope) > MAX_SLOPE
        )
        converged = ~astray & (gamma_change < CONVERGED)
        # Each edge has its own number of passes: converged edges leave the batch.
        done = np.flatnonzero(converged)
        counts = mask[done].sum(1) - 5
        scatter = chi2s[done] / counts
        misfits = np.sqrt(np.maximum(scatter - 1, 0)) / np.maximum(steps[done], 1e-9)
        # The rest may be smaller than the noise by chance, which makes no error smaller.
        errors = np.sqrt(variance[done] * np.maximum(scatter, 1))
        refused = (misfits > limits.misfit) | (errors > limits.error)
        refused |= steps[done] < limits.step_sigma
        if limits is not ANY:
            # Sharper than a detector's pixel, or softer than any profile: no plain edge.
            least = 0.0 if shape else LEAST_GAMMA
            refused |= (lines.gamma[done] < least) | (lines.gamma[done] >= LARGEST_GAMMA)
        for n in np.flatnonzero(~refused):
            k = done[n]
            at = active[k]
            fits[at] = EdgeBlur(
                gamma=float(lines.gamma[k]),
                error=float(errors[n]),
                slope=float(lines.slope[k]),
                place=float(lines.place[k]),
                pixels=pixels[at],
                chi2=float(chi2s[k]),
                count=int(counts[n]),
            )
        lines = lines.only(~astray & ~converged)
        active = active[~astray & ~converged]
        if not active.size:
            break
    return fits


def centroids(regions: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> _Lines:
    """Fit a line to the position of an edge in each row, as a start for the exact fit.

    The position in a row is the centroid of the pixel differences across the edge.

    Args:
        regions: (N, H, W) pixel values, each with one nearly vertical edge.
        rows: (H,) coordinate of each row, 0 in the middle.
        columns: (W,) coordinate of each column, likewise.

    Returns:
        Position in pixels, slope in pixels per row, and initial gamma of each edge, (N,).
    """
    rise = np.diff(regions, axis=2)
    rise = np.maximum(rise * np.sign(rise.sum((1, 2)))[:, None, None], 0) * np.hamming(
        rise.shape[2]
    )
    centre = (rise * (columns[1:] - 0.5)).sum(2) / np.maximum(rise.sum(2), 1e-9)
    slope = (centre * rows).sum(1) / max((rows**2).sum(), 1.0)
    return _Lines(np.median(centre, axis=1), slope, np.full(len(regions), START_GAMMA))


def _solve(
    lines: _Lines, x: np.ndarray, y: np.ndarray, values: np.ndarray, mask: np.ndarray, shape: float
) -> tuple[np.ndarray, ...]:
    """Solve for the levels of both sides, then for small changes of all five numbers, of each edge.

    Args:
        lines: N edges.
        x: (P,) columns of a region's pixels.
        y: (P,) their rows.
        values: (N, P) pixels.
        mask: (N, P) bool, True for the pixels near each edge, which are fitted.
        shape: the coefficient of the curve's Gaussian part.

    Returns:
        The changes of place, slope and gamma, (N, 3); and the variance of gamma, the range of the
        fitted pixels near the edge, and the sum of squares that is left of them, (N,) each.
    """
    lean = np.sqrt(1 + lines.slope**2)[:, None]
    distance = (x - lines.place[:, None] - lines.slope[:, None] * y) / lean
    tables = _at_gammas(lines.gamma, shape)
    plateaus = np.stack([mask.astype(np.float64), _at_distances(tables, distance) * mask], axis=1)
    # Where a square holds no step the matrix is singular.
    normal = np.linalg.pinv(plateaus @ plateaus.swapaxes(1, 2), hermitian=True)
    values = values * mask
    levels = (normal @ (plateaus @ values[:, :, None]))[:, :, 0]
    fitted = (levels[:, None] @ plateaus)[:, 0]
    step = levels[:, 1, None] * mask
    rise = _at_distances(tables, distance + 0.1) - _at_distances(tables, distance - 0.1)
    rise *= step / 0.2 / lean
    low = np.maximum(lines.gamma - 0.15, 0.0)
    high = np.minimum(lines.gamma + 0.15, float(GAMMAS[-1]))
    softer = (_at_gammas(high, shape) - _at_gammas(low, shape)) / (high - low)[:, None]
    terms = np.stack(
        [plateaus[:, 0], plateaus[:, 1], -rise, -rise * y, _at_distances(softer, distance) * step],
        axis=1,
    )
    covariance = np.linalg.pinv(terms @ terms.swapaxes(1, 2), hermitian=True)
    residuals = values - fitted
    change = (covariance @ (terms @ residuals[:, :, None]))[:, 2:, 0]
    span = np.where(mask, fitted, -np.inf).max(1) - np.where(mask, fitted, np.inf).min(1)
    return change, covariance[:, 4, 4], span, (residuals**2).sum(1)
