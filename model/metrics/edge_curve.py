"""Measure the MTF along one axis, as a table with its interval, from all edges across it jointly.

1. Fit each edge's line and planes to a first curve (`uneven_edge`), then the curve to all edges, a
   few times.
2. Among edges found by search, use those as sharp as the sharpest within chance: in nature an edge
   is a step or softer. Edges that a person confirms are all used; those that contradict the others
   are named.
3. Draw edges, and strips along them, with replacement: the spread is the interval.

ISO 12233 averages pixels in bins of a quarter pixel first. Here each pixel has its own distance
from the edge, its noise and its texture. Nothing is lost to bins, and short edges along the grid do
not leave bins empty.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from beers_deploy.model.metrics.edge_search import FIRST_PASSES, MOST_EDGES, START, Edge
from beers_deploy.model.metrics.mtf_basis import (
    BENDS,
    PARTS,
    likeliest_bend,
    mtf_at,
    softened,
    solve,
)
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.statistics import robust_deviation
from beers_deploy.model.metrics.uneven_edge import (
    FittedEdge,
    fit_edge,
    normal_equations,
    softness,
    strips_of,
)
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.response import NYQUIST

FREQUENCIES = np.round(np.arange(0.0, 0.71, 0.05), 2)
"""Frequencies of the table, in cycles per pixel, up to the corner of the spectrum, where
restoration still uses the curve.
"""
PASSES = 2
ROUNDS = 5

TIERS = ((0.012, 3, 0.02), (0.03, 8, 0.08), (0.06, 10, 0.08))
"""Limits for edges found by search: the largest texture over step, the number of such edges that is
needed, and the least relative standard error of their curve. Among 1200 steep places of
photographs, all of the first tier were within 0.5 px of a step's softness, and two thirds of the
second (measured).
"""
MAX_ERROR_PX = 0.6
"""The largest standard error of the softness of an edge found by search."""
NATURAL_PX = 0.3
"""The error by which the interval is widened: the sharpest edges of a scene may be softer than a
step, and thin objects next to them make them appear sharper.
"""
MOST_FITTED = 600
"""If there are more edges, every n-th one is fitted, such that at least this number is."""
FEW_EDGES = 7
"""Up to this number of edges, strips along the edges are drawn; with more, whole edges."""
EVEN = 0.012
"""Texture over step up to which only noise is drawn along an edge, because there is no texture to
draw strips of.
"""
UNEVEN_PX = 20.0
"""The scatter in softness of edges found by search, per texture over step (measured)."""

SCATTER_PX = 0.15
SOFT_PX = 0.3
OUTLIERS = 0.05
OUTLIER_RANGE_PX = 8.0
"""Priors of the softness: the scatter of steps beyond their errors, and the mean excess of other
edges; the share of outliers, and the range of their softness.
"""
SHARP_DEVIATIONS = 2.5
CONTRADICTION_DEVIATIONS = 3.0
CONTRADICTION_PX = 0.4
"""The least difference of softness that counts as a contradiction; 0.4 px is 18 % of the contrast
at Nyquist.
"""

SHARP_CPX = 0.25
SHARPEST = 0.96
"""Contrast at SHARP_CPX relative to a perfect lens, which no blurred edge exceeds."""

DRAWS = 200
LOW_PERCENT = 5.0
HIGH_PERCENT = 95.0
NORMAL_QUANTILE = 1.645
FLOOR = 0.02
"""Least relative standard error of edges that a person confirms, because the model cannot know
everything: far tails, bows, aliasing.
"""
WIDEST = 1.5
"""The largest factor by which either end of the interval at Nyquist may differ from the figure."""
MOST_MISSING = 100
"""The largest number of missing edges that is reported; no user has more."""
LEAST_AT_NYQUIST = 1e-3
"""A lower end of the interval below this value cannot be distinguished from 0. Edges that are no
steps, such as lawn, result in such values.
"""
LEAST_CONTRAST = 1e-4


@dataclass(frozen=True)
class MtfCurve:
    """The MTF along one axis.

    Attributes:
        contrast: (F,) at FREQUENCIES, falling from 1.
        low: (F,) lower end of the 90 % interval of each.
        high: (F,) upper end of it.
        edges: the number of edges that the curve is based on.
        contradicting: labels of edges that differ from the others.
        lean: mean squared sine of the edges' angle to the axis: the share of the other axis.
        missing_edges: number of further edges that would narrow the interval at Nyquist to WIDEST.
    """

    contrast: np.ndarray
    low: np.ndarray
    high: np.ndarray
    edges: int
    contradicting: tuple[str, ...]
    lean: float
    missing_edges: int = 0

    def at(self, frequency: float) -> tuple[float, tuple[float, float]]:
        """Return the contrast at the nearest of FREQUENCIES, and its interval."""
        place = int(np.argmin(np.abs(FREQUENCIES - frequency)))
        return float(self.contrast[place]), (float(self.low[place]), float(self.high[place]))


def measure_curve(edges: Sequence[Edge], generator: np.random.Generator) -> MtfCurve | Refusal:
    """Measure the common curve of edges that a person confirms, all near the vertical.

    Args:
        edges: pixels, and the approximate line of each edge.
        generator: the random generator for the draws of the interval.
    """
    fitted = _fits(edges, START, FIRST_PASSES)
    weights = START
    for _ in range(ROUNDS):
        if not fitted:
            break
        weights = _solved(fitted, weights)
        fitted = _fits(map(edge_of, fitted), weights, PASSES)
    if not fitted:
        return Refusal("no straight edge")
    if mtf_at(SHARP_CPX, weights) > SHARPEST * np.sinc(SHARP_CPX):
        return Refusal("sharper than a detector's pixel: sharpened, or more than one edge in a box")
    values, errors = softness(fitted, weights)
    draws = _drawn(fitted, weights, generator)
    # Edges whose softness is not the others'; of two that differ, both.
    off = np.abs(values - float(np.median(values)))
    scatter = robust_deviation(off) if len(fitted) > 3 else 0.0
    contradicts = (off > CONTRADICTION_DEVIATIONS * np.hypot(errors, scatter)) & (
        off > CONTRADICTION_PX
    )
    contradicting = tuple(
        edge.pixels.label for edge, flag in zip(fitted, contradicts, strict=True) if flag
    )
    return _with_interval(weights, draws, fitted, contradicting, FLOOR)


def search_curve(edges: Sequence[Edge], generator: np.random.Generator) -> MtfCurve | Refusal:
    """Measure the curve of the sharpest among edges found by search, all near the vertical.

    A few even edges are enough; more are needed if they are uneven.

    Args:
        edges: pixels, and the approximate line of each edge.
        generator: the random generator for the draws of the interval.
    """
    sample = edges[:: max(len(edges) // MOST_FITTED, 1)]
    fitted = sorted(_fits(sample, START, FIRST_PASSES), key=lambda edge: edge.unevenness)
    result: MtfCurve | Refusal = Refusal("no straight edge")
    for unevenness, least, floor in TIERS:
        tier = [edge for edge in fitted if edge.unevenness <= unevenness][:MOST_EDGES]
        curve = _curve_of_sharpest(tier, least, floor, generator)
        # A later tier that is refused does not replace the curve of an earlier one.
        if isinstance(result, Refusal) or isinstance(curve, MtfCurve):
            result = curve
        if isinstance(result, MtfCurve) and not result.missing_edges:
            break
    return result


def _curve_of_sharpest(
    fitted: list[FittedEdge], least: int, floor: float, generator: np.random.Generator
) -> MtfCurve | Refusal:
    """Return the curve of the edges that are as sharp as the sharpest, but for chance."""
    sharp = fitted
    weights = START
    step = 0.0
    for _ in range(ROUNDS):
        if len(sharp) < least:
            break
        weights = _solved(sharp, weights)
        fitted = _fits(map(edge_of, fitted), weights, PASSES)
        values, errors = softness(fitted, weights)
        precise = errors <= MAX_ERROR_PX
        # Texture scatters the softness by more than the noise that its own error counts.
        errors = np.hypot(errors, [UNEVEN_PX * edge.unevenness for edge in fitted])
        step = sharpest(values[precise], errors[precise]) if precise.any() else 0.0
        alike = precise & (np.abs(values - step) <= SHARP_DEVIATIONS * np.hypot(errors, SCATTER_PX))
        sharp = [edge for edge, is_sharp in zip(fitted, alike, strict=True) if is_sharp]
    if len(sharp) < least:
        count = counted(len(sharp), "straight edge")
        return Refusal(f"{count} of one sharpness, {least} are needed")
    values = values[precise]
    errors = errors[precise]
    picks = (generator.integers(values.size, size=values.size) for _ in range(DRAWS))
    steps = [sharpest(values[pick], errors[pick]) for pick in picks]
    draws = [softened(*pair) for pair in zip(_drawn(sharp, weights, generator), steps, strict=True)]
    curve = _with_interval(softened(weights, step), draws, sharp, (), floor)
    # The sharpest edges of a scene may themselves be softer than a step, or look sharper.
    unknown = np.exp(NATURAL_PX * FREQUENCIES)
    return replace(
        curve, low=curve.low / unknown, high=np.minimum(curve.high * unknown, np.sinc(FREQUENCIES))
    )


edge_of = attrgetter("pixels", "line")
"""Return the pixels and the line of a fitted edge."""


def _fits(edges: Iterable[Edge], weights: np.ndarray, passes: int) -> list[FittedEdge]:
    """Return those edges whose line stays within their pixels, fitted to a curve."""
    fits = (fit_edge(pixels, line, weights, passes) for pixels, line in edges)
    return [edge for edge in fits if edge is not None]


def _solved(edges: Sequence[FittedEdge], weights: np.ndarray) -> np.ndarray:
    """Return the curve that fits all edges best."""
    gram, moment = _added(normal_equations(edge, weights) for edge in edges)
    return solve(gram, moment, weights, likeliest_bend(gram, moment, weights))


def _added(equations: Iterable[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Return the sum of the left sides of normal equations, and that of the right sides."""
    return [np.sum(sides, axis=0) for sides in zip(*equations, strict=True)]


def sharpest(values: np.ndarray, errors: np.ndarray) -> float:
    """Estimate the softness of the steps among edges that are steps or softer, never sharper.

    The model is: softness = that of a step + an edge's own softness, 0 or more + an error. The two
    terms have an exponential and a normal distribution, and few edges are outliers. The maximum of
    the posterior is returned, with weak priors for both widths.

    Args:
        values: (N,) softness of each edge, in pixels, as `uneven_edge.softness` returns it.
        errors: (N,) its standard error.
    """
    from scipy.optimize import minimize
    from scipy.special import log_ndtr

    def unlikeliness(parameters: np.ndarray) -> float:
        step, log_scatter, log_soft = parameters
        scatter = SCATTER_PX * math.exp(log_scatter)
        soft = SOFT_PX * math.exp(log_soft)
        sigma = np.hypot(errors, scatter)
        off = values - step
        # The logarithm of an exponential distribution convolved with a normal one.
        density = (
            sigma**2 / (2 * soft**2)
            - off / soft
            - math.log(soft)
            + log_ndtr(off / sigma - sigma / soft)
        )
        some = np.logaddexp(math.log(1 - OUTLIERS) + density, math.log(OUTLIERS / OUTLIER_RANGE_PX))
        return float(-some.sum() + (log_scatter**2 + log_soft**2) / 2)

    start = np.array([float(np.percentile(values, 40)), 0.0, 0.0])
    simplex = start + np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4}
    return float(minimize(unlikeliness, start, method="Nelder-Mead", options=options).x[0])


def _drawn(
    edges: Sequence[FittedEdge], weights: np.ndarray, generator: np.random.Generator
) -> list[np.ndarray]:
    """Return the curve of each draw of edges, strips and expected bends."""
    count = len(edges)
    equations = [normal_equations(edge, weights) for edge in edges]
    draws = []
    for _ in range(DRAWS):
        if count <= FEW_EDGES:
            sample = []
            # An edge's noise is drawn again, or its strips are drawn with replacement.
            for edge, (gram, moment) in zip(edges, equations, strict=True):
                if edge.unevenness > EVEN:
                    strips = strips_of(edge)
                    drawn = generator.integers(strips, size=strips)
                    counts = np.bincount(drawn, minlength=strips)
                    sample.append(normal_equations(edge, weights, counts))
                    continue
                # With noise of 1 in the pixels the moments have the covariance `gram`.
                sizes, axes = np.linalg.eigh(gram)
                deviations = np.sqrt(np.maximum(sizes, 0.0)) * generator.standard_normal(PARTS)
                sample.append((gram, moment + axes @ deviations))
        else:
            sample = [equations[number] for number in generator.integers(count, size=count)]
        gram, moment = _added(sample)
        # Where pixels determine little, the expected smoothness decides. It is drawn too, and is
        # the loosest possible, so that the interval includes what a smooth curve hides.
        draws.append(solve(gram, moment, weights, BENDS[-1], generator.standard_normal(PARTS - 3)))
    return draws


def _with_interval(
    weights: np.ndarray,
    draws: Sequence[np.ndarray],
    edges: Sequence[FittedEdge],
    contradicting: tuple[str, ...],
    floor: float,
) -> MtfCurve:
    """Return the curve with the interval of the draws, which is wider for few
    independent strips.
    """
    from scipy.special import stdtrit

    detector = np.sinc(FREQUENCIES)
    contrast = np.clip(mtf_at(FREQUENCIES, weights), LEAST_CONTRAST, detector)
    curves = np.maximum([mtf_at(FREQUENCIES, draw) for draw in draws], LEAST_CONTRAST)
    looks = len(edges)
    if looks <= FEW_EDGES:
        looks = sum(
            edge.strip.size if edge.unevenness <= EVEN else strips_of(edge) for edge in edges
        )
    # With few looks, Student's quantile is needed, and the variance of a bootstrap is too small by
    # (n - 1) / n.
    wider = (
        float(stdtrit(looks - 1, HIGH_PERCENT / 100))
        / NORMAL_QUANTILE
        * math.sqrt(looks / (looks - 1))
    )
    lowest, highest = np.percentile(curves, [LOW_PERCENT, HIGH_PERCENT], axis=0)
    unknown = NORMAL_QUANTILE * floor * contrast
    low = np.maximum(
        contrast - np.hypot(wider * np.maximum(contrast - lowest, 0.0), unknown), LEAST_CONTRAST
    )
    high = contrast + np.hypot(wider * np.maximum(highest - contrast, 0.0), unknown)
    contrast[0] = low[0] = high[0] = 1.0
    slope = np.array([edge.line.slope for edge in edges])
    lean = float(np.mean(slope**2 / (1 + slope**2)))
    missing = _missing(contrast, low, high, len(edges))
    return MtfCurve(
        contrast, low, np.minimum(high, detector), len(edges), contradicting, lean, missing
    )


def _missing(contrast: np.ndarray, low: np.ndarray, high: np.ndarray, edges: int) -> int:
    """Return how many more edges would narrow the interval at Nyquist to WIDEST; 0 where it is
    narrow enough.
    """
    place = int(np.argmin(np.abs(FREQUENCIES - NYQUIST)))
    if low[place] < LEAST_AT_NYQUIST:
        return MOST_MISSING
    factor = max(high[place] / contrast[place], contrast[place] / low[place])
    # The interval narrows with the root of the number of edges.
    excess = (math.log(factor) / math.log(WIDEST)) ** 2
    return min(max(math.ceil(edges * (excess - 1)), 0), MOST_MISSING)


def apart(own: MtfCurve, other: MtfCurve) -> MtfCurve:
    """Correct the curve of one axis for the other axis, which blurs inclined edges too.

    The loss along an edge's normal is sqrt((c loss_own)^2 + (s loss_other)^2), with c and s the
    cosine and sine of its angle, as in a profile's formula (`profiles.response.MtfTable`).

    Args:
        own: the curve to correct.
        other: the curve measured along the other axis, not corrected either.
    """
    detector = np.sinc(FREQUENCIES)
    own_loss, other_loss = (np.log(detector / curve.contrast) ** 2 for curve in (own, other))
    # Squared losses add up, weighted by the squared cosine and sine of the edge's angle.
    mixture = np.array([[1 - own.lean, own.lean], [other.lean, 1 - other.lean]])
    loss = np.sqrt(np.maximum(np.linalg.solve(mixture, np.stack([own_loss, other_loss]))[0], 0.0))
    contrast = np.minimum.accumulate(np.maximum(detector * np.exp(-loss), LEAST_CONTRAST))
    ratio = contrast / own.contrast
    return replace(
        own, contrast=contrast, low=own.low * ratio, high=np.minimum(own.high * ratio, detector)
    )
