"""How wrong the cost model is about networks that its fit has not seen, and the intervals that follow.

Networks of one family resemble one another, so a family is left out as a whole. What is chosen and what is judged
are kept apart by two rounds (nested cross-validation): for each family left out, the structure is chosen, and the
width of the interval made, from errors on others of the families that remain. The structure is one for all boards.
`nested` is what the errors of the documents and the widths of [cost] come from.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.cost.constants import REGIMES, STRUCTURES, Array, Constants, Regime, Structure, regime_of
from deploy.dpu.cost.fit import Cases, fit
from deploy.dpu.cost.published import boards, published_cases

FOLDS = 5
SHARE = 0.9
"""Of left-out families that the intervals hold."""
CONFIDENCE = 0.75
"""That they do: of some thirty families the luck of who is among them moves a mere quantile by several."""
SHRINK = 3
"""A regime's typical error counts this many families of all regimes' typical error besides its own."""


@dataclass(frozen=True)
class Widths:
    """Half the width of an interval, in ln(FPS), by regime."""

    by_regime: dict[Regime, float]

    @classmethod
    def of(cls, errors: Array, cases: Cases, regimes: Sequence[Regime]) -> "Widths":
        """So wide that SHARE of the families lie inside with every rate of all their networks.

        What counts of a case is its rate that lies farthest off. A regime's scale is the mean over families of its
        mean (drawn to that of all regimes); a family's score is its largest error over scale; the widths are the
        scales times the score that SHARE of all families keep to.
        """
        families = np.array([row.family for row in cases.rows])
        kinds = np.array(regimes)
        sizes = np.array([np.abs(rates).max() for rates in cases.rate_errors(errors)])
        overall = _family_mean(sizes, families)
        scales = {}
        for kind in REGIMES:
            mine = kinds == kind
            count = len(set(families[mine]))
            own = count * _family_mean(sizes[mine], families[mine]) if count else 0.0
            scales[kind] = (own + SHRINK * overall) / (count + SHRINK)
        score = family_quantile(sizes / np.array([scales[kind] for kind in regimes]), families.tolist())
        return cls({kind: float(scale * score) for kind, scale in scales.items()})


def _family_mean(sizes: Array, families: NDArray[np.str_]) -> float:
    """Mean over families of the mean."""
    return float(np.mean([sizes[families == name].mean() for name in dict.fromkeys(families)]))


@dataclass(frozen=True)
class LeftOut:
    """What was found of a network on a configuration, its family left out.

    Attributes:
        network: its name.
        family: its family.
        configuration: of the DPU.
        regime: by the prediction.
        error: ln(predicted / observed), the observed rate being the geometric mean.
        rates: ln(predicted / rate) of each published rate.
        width: half that of the interval that was predicted, in ln(FPS).
    """

    network: str
    family: str
    configuration: str
    regime: Regime
    error: float
    rates: tuple[float, ...]
    width: float

    @property
    def held(self) -> float:
        """Share of the published rates inside the interval."""
        return float(np.mean([abs(error) <= self.width for error in self.rates]))


@dataclass(frozen=True)
class Nested:
    """The outcome for a board: all networks left out in turn, the structure of all boards, the widths that follow."""

    board: str
    rows: tuple[LeftOut, ...]
    structure: Structure
    widths: Widths


@cache
def nested(board: str) -> Nested:
    """Leave each family out; choose a structure and make widths from the others alone; predict what was left out."""
    names = _trial(board, STRUCTURES[0]).names
    rows = [row for name in names for row in left_out_rows(_trial(board, chosen(name)), name)]
    structure = chosen()
    order = {(row.network, row.configuration): row for row in rows}
    cases = published_cases(board, structure)
    rows = [order[row.network, row.configuration] for row in cases.rows]
    widths = Widths.of(np.array([row.error for row in rows]), cases, [row.regime for row in rows])
    return Nested(board, tuple(rows), structure, widths)


@cache
def chosen(left_out: str = "", unseen_board: str = "") -> Structure:
    """The structure of least error on families left out, one for all boards; no fit sees `left_out`.

    Args:
        left_out: a family that has no say.
        unseen_board: a board that has none.
    """
    known = [board for board in boards() if board != unseen_board]
    return best([[_trial(board, structure) for board in known] for structure in STRUCTURES], left_out)


@cache
def _trial(board: str, structure: Structure) -> "Trial":
    return Trial(published_cases(board, structure))


def best(trials: Sequence[Sequence["Trial"]], left_out: str) -> Structure:
    """Of structures, each tried on several boards, that of the least mean error of families but the one left out."""
    scores = [float(np.mean([trial.score(left_out) for trial in tried])) for tried in trials]
    return trials[int(np.argmin(scores))][0].cases.structure


class Trial:
    """A structure under trial: its cases and their families; fits begin near that of all rows."""

    def __init__(self, cases: Cases) -> None:
        self.cases = cases
        self.families = np.array([row.family for row in cases.rows])
        self.names = sorted(set(self.families))
        self.near = fit(cases)
        self._fits: dict[frozenset[str], Constants] = {}

    def fit_without(self, unseen: frozenset[str]) -> Constants:
        """The constants that the other families give."""
        unseen &= frozenset(self.names)
        if unseen not in self._fits:
            out = np.isin(self.families, list(unseen))
            self._fits[unseen] = fit(self.cases.only(~out), near=self.near)
        return self._fits[unseen]

    def inner(self, left_out: str) -> tuple[Array, Cases, list[Regime]]:
        """Errors and regimes of all families but one, which no fit sees, by folds of the others."""
        kept = self.cases.only(self.families != left_out)
        families = self.families[self.families != left_out]
        errors, regimes = np.zeros(len(kept.rows)), np.zeros(len(kept.rows), dtype=object)
        for fold in range(FOLDS):
            tested = set(self.names[fold::FOLDS])
            mine, constants = np.isin(families, list(tested)), self.fit_without(frozenset(tested | {left_out}))
            errors[mine] = kept.only(mine).errors(constants)
            regimes[mine] = regimes_of(kept.only(mine), constants)
        return errors, kept, list(regimes)

    def score(self, left_out: str) -> float:
        """Mean over families of the mean error, all but one."""
        errors, kept, _ = self.inner(left_out)
        return _family_mean(np.abs(errors), np.array([row.family for row in kept.rows]))


def left_out_rows(trial: Trial, name: str) -> list[LeftOut]:
    """A family, predicted without it, in intervals whose widths were made without it."""
    widths = Widths.of(*trial.inner(name))
    tested, constants = trial.cases.only(trial.families == name), trial.fit_without(frozenset({name}))
    errors = tested.errors(constants)
    return [
        LeftOut(
            case.network,
            case.family,
            case.configuration,
            regime,
            float(error),
            tuple(rates.tolist()),
            widths.by_regime[regime],
        )
        for case, regime, error, rates in zip(
            tested.rows, regimes_of(tested, constants), errors, tested.rate_errors(errors), strict=True
        )
    ]


def regimes_of(cases: Cases, constants: Constants) -> list[Regime]:
    """What sets each case's rate, by prediction."""
    times = cases.times(constants)
    bound = times.host_s / cases.host_cores > times.dpu_s
    return [regime_of(bool(b), row.map_bytes) for b, row in zip(bound, cases.rows, strict=True)]


def leave_out(cases: Cases, names: Sequence[str]) -> Array:
    """ln(predicted / observed) of each case (n,), predicted without those that share its name."""
    groups, errors, near = np.asarray(names), np.zeros(len(cases.rows)), fit(cases)
    for name in dict.fromkeys(names):
        out = groups == name
        errors[out] = cases.only(out).errors(fit(cases.only(~out), near=near))
    return errors


def rank_correlation(cases: Cases, errors: Array) -> float:
    """Spearman's: does the model put networks in the right order."""
    ranks = [_ranks(values) for values in (cases.observed, cases.observed + errors)]
    return float(np.asarray(np.corrcoef(np.stack(ranks)))[0, 1])


def _ranks(values: Array) -> Array:
    """Ranks, equal values sharing their mean."""
    _, index, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    means: Array = ends - (counts - 1) / 2
    return means[index]


def relative(errors: Array) -> Array:
    """|predicted / observed - 1| of errors in ln(FPS)."""
    return np.asarray(np.abs(np.expm1(errors)))


def by_network(rows: Sequence[LeftOut]) -> dict[str, float]:
    """Mean |predicted / published - 1| of each network, over its configurations and rates."""
    found: dict[str, list[float]] = {}
    for row in rows:
        found.setdefault(row.network, []).extend(relative(np.array(row.rates)).tolist())
    return {name: float(np.mean(values)) for name, values in found.items()}


def coverage(rows: Sequence[LeftOut]) -> tuple[float, float]:
    """Share of published rates inside their intervals, each network weighing the same; share of families whole."""
    counts = Counter(row.network for row in rows)
    networks = sum(row.held / counts[row.network] for row in rows) / len(counts)
    families = {row.family for row in rows}
    whole = [all(row.held == 1 for row in rows if row.family == name) for name in families]
    return networks, float(np.mean(whole))


def transferred(source: str, target: str) -> Array:
    """Errors of a board's cases (n,) with another's constants, fitted to that one's rates without their family."""
    structure = chosen(unseen_board=target)
    known, wanted = published_cases(source, structure), published_cases(target, structure)
    families, errors = np.array([row.family for row in wanted.rows]), np.zeros(len(wanted.rows))
    trial = Trial(known)
    for name in dict.fromkeys(families.tolist()):
        mine = families == name
        errors[mine] = wanted.only(mine).errors(trial.fit_without(frozenset({name})))
    return errors


def beyond(cases: Cases, share: float = 0.25) -> tuple[Array, list[str]]:
    """Errors of networks with the largest maps, predicted from the others, and the families of their rows.

    The largest: above `share` of the largest map of a network that the DPU bounds. Only such are predicted.
    """
    bound = np.array([kind != "host" for kind in regimes_of(cases, fit(cases))])
    sizes = np.array([row.map_bytes for row in cases.rows])
    large = bound & (sizes > share * sizes[bound].max())
    tested = cases.only(large)
    return tested.errors(fit(cases.only(~large))), [row.family for row in tested.rows]


def family_quantile(errors: Array, families: Sequence[str]) -> float:
    """The size of error that SHARE of all families keep to with every one of theirs, at CONFIDENCE."""
    largest = sorted(np.abs(errors)[np.array(families) == name].max() for name in set(families))
    return float(largest[tolerance_rank(len(largest)) - 1])


def tolerance_rank(count: int) -> int:
    """Which of `count` scores, sorted, SHARE of all families stay below, at CONFIDENCE; or the last.

    The k-th of n does if fewer than k of n draws fall among that share: at a binomial probability (S. S. Wilks, 1941,
    doi:10.1214/aoms/1177731788).
    """
    below = 0.0
    for rank in range(1, count):
        below += math.comb(count, rank - 1) * SHARE ** (rank - 1) * (1 - SHARE) ** (count - rank + 1)
        if below >= CONFIDENCE:
            return rank
    return count
