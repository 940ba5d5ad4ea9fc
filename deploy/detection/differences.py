"""What differs between rows, with an interval: one bootstrap over sites, the same draw for all rows.

As Everingham et al. (IJCV 111, 2015, section 3.5) test the entries of the VOC challenge: sites with replacement,
percentiles of the paired difference. A mean average precision is no mean over images, so each draw scores anew.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from deploy.detection.matching import Matched
from deploy.detection.scores import Scores, score
from model.metrics.bootstrap import LEAST_SITES, LEVEL

DRAWS = 1000
PERCENTILES = (50 * (1 - LEVEL), 50 * (1 + LEVEL))
FEW_SITES = 10
"""Below it the percentiles of a bootstrap are too narrow to be trusted, and it is said."""


@dataclass(frozen=True)
class Estimate:
    """A figure and its interval at 95 %; none of too few sites (`LEAST_SITES`), or where there is no figure (NaN)."""

    value: float
    interval: tuple[float, float] | None

    @property
    def told_from_zero(self) -> bool:
        """Whether the interval leaves 0 out; without one nothing can be said."""
        return self.interval is not None and not self.interval[0] <= 0.0 <= self.interval[1]


@dataclass(frozen=True)
class Differences:
    """Every row's figures on all images and in each draw, and what follows of them.

    Attributes:
        scores: of all images, by row.
        confidence: where precision and recall are read in every row: the best of the first one.
        sites: how many different ones.
        drawn: (draws,) by figure, by row; NaN where a draw held no object.
    """

    scores: Mapping[str, Scores]
    confidence: float
    sites: int
    drawn: Mapping[str, Mapping[str, np.ndarray]]

    @property
    def warning(self) -> str | None:
        """What a reader must know of the intervals, in a sentence; None where there is nothing to say."""
        return warning_of(self.sites)

    def value(self, row: str, figure: str) -> Estimate:
        """A figure (a key of `Scores.figures`) of a row."""
        return self._estimate(lambda one: one(row, figure))

    def difference(self, row: str, base: str, figure: str) -> Estimate:
        """A row's figure less that of another, paired by draw."""
        return self._estimate(lambda one: one(row, figure) - one(base, figure))

    def regained(self, row: str, degraded: str, reference: str, figure: str) -> Estimate | None:
        """Share of the loss from reference to degraded that a row makes good; None where no loss is told from 0."""
        if not self.difference(reference, degraded, figure).told_from_zero:
            return None

        def share(one: Callable[[str, str], np.ndarray]) -> np.ndarray:
            gain, loss = one(row, figure) - one(degraded, figure), one(reference, figure) - one(degraded, figure)
            return np.asarray(np.divide(gain, loss, out=np.full(gain.shape, np.nan), where=loss != 0))

        return self._estimate(share)

    def _estimate(self, combine: Callable[[Callable[[str, str], np.ndarray]], np.ndarray]) -> Estimate:
        """A combination of figures, on all images and in every draw."""
        value = float(combine(lambda row, figure: np.array(self.scores[row].figures()[figure])))
        return estimate(value, combine(lambda row, figure: self.drawn[row][figure]), self.sites)


def warning_of(sites: int) -> str | None:
    """What a reader must know of intervals over so many sites, in a sentence; None where there is nothing to say."""
    if sites < LEAST_SITES:
        return f"No interval: of {sites} sites, fewer than {LEAST_SITES}, none could be trusted."
    if sites < FEW_SITES:
        return f"Only {sites} sites: the intervals are too narrow to be trusted."
    return None


def estimate(value: float, draws: np.ndarray, sites: int) -> Estimate:
    """A figure with its interval at 95 %.

    Args:
        value: on all images.
        draws: (draws,) the same in each draw of the sites, NaN where a draw has none.
        sites: how many different ones.
    """
    known = draws[~np.isnan(draws)]
    if np.isnan(value) or sites < LEAST_SITES or not len(known):
        return Estimate(value, None)
    low, high = np.percentile(known, PERCENTILES)
    return Estimate(value, (float(low), float(high)))


def site_draws(sites: Sequence[str], generator: np.random.Generator, draws: int = DRAWS) -> Iterator[np.ndarray]:
    """How often each image counts, (I,), in each of so many draws of the sites with replacement.

    Args:
        sites: of the images, in their order.
        generator: of the draws; one of the same seed gives the same to all rows of the same sites.
        draws: how many.
    """
    names, site = np.unique(np.array(sites), return_inverse=True)
    for counts in generator.multinomial(len(names), np.full(len(names), 1 / len(names)), size=draws):
        yield counts[site]


def differences(rows: Mapping[str, Matched], generator: np.random.Generator, draws: int = DRAWS) -> Differences:
    """Score all rows on all images and on `draws` draws of the sites.

    A class that no site of a draw holds drops out of every row's mean in that draw.

    Args:
        rows: of the same images in the same order; the first sets the confidence.
        generator: of the draws.
        draws: how many.

    Raises:
        ValueError: rows of other images, or no row.
    """
    first = next(iter(rows.values()), None)
    if first is None or any(row.sites != first.sites for row in rows.values()):
        raise ValueError("rows of the same images are compared, one at least")
    confidence = score(first).confidence
    known = {name: score(row, confidence=confidence) for name, row in rows.items()}
    collected: dict[str, list[dict[str, float]]] = {name: [] for name in rows}
    for weights in site_draws(first.sites, generator, draws):
        for name, row in rows.items():
            collected[name].append(score(row, weights, confidence).figures())
    drawn = {
        name: {figure: np.array([one[figure] for one in each]) for figure in known[name].figures()}
        for name, each in collected.items()
    }
    return Differences(known, confidence, len(set(first.sites)), drawn)
