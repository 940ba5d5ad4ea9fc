"""Estimate the error of the cost model on networks outside its fit, and the intervals that follow.

Networks of one family resemble one another, so a family is left out as a whole. The validation is
nested, so that no family judges its own choices. For each family left out, `contention_exponent`
and the width of the interval follow from the other families, each of which is left out in turn.
Boards of one processor share `contention_exponent`. The errors in the documents and the widths in
[cost] come from `nested`.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain, combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import binom, spearmanr

from beers_deploy.dpu.board import Levels, load_dpu
from beers_deploy.dpu.cost.kinship import correction, levels_of
from beers_deploy.dpu.cost.model import PARTS, Array, Constants, Structure
from beers_deploy.profiles.target import TargetProfile
from benchmarks.cost_model.fit import Cases, fit
from benchmarks.cost_model.published import boards, host_cores, published_cases, written

CONTENTION_EXPONENTS = (2.0, 4.0)
"""The values among which the cross-validation chooses."""
OVERLAP = {"DPUCZDX8G": 1.0, "DPUCVDX8G": 0.5, "DPUCV2DX8G": 0.5}
"""The overlap of computation and memory transfers, by DPU.

The first reaches 94 % of its array's peak on a network of large maps (SESR, KV260), so its memory
time is hidden. The rates of the others do not determine it: from 0 to 1, the error of families left
out changes by 0.1 points.
"""
FOLDS = 5
SHARE = 0.9
"""The share of left-out families that the intervals contain."""
CONFIDENCE = 0.75
"""The probability that they do.

There are some thirty families, so chance would move a plain quantile by several of them.
"""
SHRINKAGE = 1
"""A part's typical error is shrunk towards the mean error.

The weight of the mean is that of this number of families whose rates follow that part alone.
"""


@dataclass(frozen=True)
class LeftOut:
    """The errors of a network on a configuration, with its family left out of the fit.

    Attributes:
        network: the name of the network.
        family: the family of the network.
        configuration: the configuration of the DPU.
        on_host: whether the host limits the predicted rate.
        error: ln(predicted / observed), where observed is the geometric mean of the rates.
        rates: ln(predicted / rate) of each published rate.
        width: half the width of the predicted interval, in ln(FPS).
    """

    network: str
    family: str
    configuration: str
    on_host: bool
    error: float
    rates: Array
    width: float

    @property
    def held(self) -> float:
        """The share of the published rates inside the interval."""
        return float(np.mean(np.abs(self.rates) <= self.width))


@dataclass(frozen=True)
class Nested:
    """The result for a board: each network left out once, and the width of each of PARTS."""

    rows: Sequence[LeftOut]
    cases: Cases
    widths: Array


@cache
def nested(board: str) -> Nested:
    """Predict each family with a contention exponent, constants and widths from the others."""
    trial = _trial(board, chosen(board))
    predicted = [_trial(board, chosen(board, name)).left_out(name) for name in trial.names]
    cases = trial.cases
    by_case = {(row.network, row.configuration): row for row in chain.from_iterable(predicted)}
    rows = [by_case[row.network, row.configuration] for row in cases.rows]
    errors = np.array([row.error for row in rows])
    return Nested(rows, cases, widths_of(errors, cases, cases.shares(trial.near)))


@cache
def chosen(board: str, left_out: str = "") -> float:
    """Return the contention exponent with the smallest mean error, for all boards of one processor.

    Args:
        board: the name of a board with this processor.
        left_out: a family that is not used.
    """
    similar = [other for other in boards() if host_cores(other) == host_cores(board)]
    scores = [
        np.mean([_trial(other, contention_exponent).score(left_out) for other in similar])
        for contention_exponent in CONTENTION_EXPONENTS
    ]
    return CONTENTION_EXPONENTS[int(np.argmin(scores))]


@cache
def _trial(board: str, contention_exponent: float) -> "Trial":
    documents = TargetProfile.load(board).documents["operators"]
    overlap = next(OVERLAP[name] for name in OVERLAP if name in documents)
    return Trial(Cases(published_cases(board), Structure(overlap, contention_exponent)))


class Trial:
    """A contention exponent under trial, with its cases and their families.

    Fits begin near the fit of all rows.
    """

    def __init__(self, cases: Cases) -> None:
        self.cases = cases
        self.names = sorted(set(cases.families))
        self.near = fit(cases)
        self._fits: dict[frozenset[str], Constants] = {}

    def fit_without(self, unseen: Iterable[str]) -> Constants:
        """Return the constants that are fitted to the other families."""
        key = frozenset(unseen) & frozenset(self.names)
        if key not in self._fits:
            self._fits[key] = fit(
                self.cases.only(~np.isin(self.cases.families, list(key))), near=self.near
            )
        return self._fits[key]

    def left_out(self, name: str) -> list[LeftOut]:
        """Predict a family with constants and interval widths that do not depend on it."""
        widths = widths_of(*self.inner(name))
        tested = self.cases.only(self.cases.families == name)
        constants = self.fit_without({name})
        errors = tested.errors(constants)
        shares = tested.shares(constants)
        on_host = hosts_of(shares)
        return [
            LeftOut(row.network, row.family, row.configuration, bound, float(error), rates, width)
            for row, bound, error, rates, width in zip(
                tested.rows,
                on_host.tolist(),
                errors,
                tested.rate_errors(errors),
                (shares @ widths).tolist(),
                strict=True,
            )
        ]

    def inner(self, left_out: str) -> tuple[Array, Cases, Array]:
        """Return cross-validated errors and shares of all families but one, which no fit sees."""
        training = self.cases.only(self.cases.families != left_out)
        errors = np.zeros(len(training.rows))
        shares = np.zeros((len(training.rows), len(PARTS)))
        for fold in range(FOLDS):
            tested = self.names[fold::FOLDS]
            mine = np.isin(training.families, tested)
            constants = self.fit_without({*tested, left_out})
            errors[mine] = training.only(mine).errors(constants)
            shares[mine] = training.only(mine).shares(constants)
        return errors, training, shares

    def score(self, left_out: str) -> float:
        """Return the mean over the other families of their mean error."""
        errors, training, _ = self.inner(left_out)
        return family_mean(np.abs(errors), training.families)


def widths_of(errors: Array, cases: Cases, shares: Array) -> Array:
    """Return the widths of PARTS, (6,), that contain every rate of SHARE of the families.

    1. The error of a case is that of its rate with the largest error.
    2. The typical errors of the parts, none below 0, fit these errors by least squares with their
       means, weighted by the shares.
    3. The score of a family is its largest ratio of error to typical error.
    4. The widths are the typical errors times the score that SHARE of all families do not exceed.
    """
    families = cases.families
    sizes = np.array([np.abs(rates).max() for rates in cases.rate_errors(errors)])
    overall = family_mean(sizes, families)
    # A family counts once. A part that few rates follow is shrunk towards the mean of all families.
    weights = np.array([1 / np.sum(families == name) for name in families]) ** 0.5
    shrunk = SHRINKAGE**0.5 * np.eye(len(PARTS))
    typical, _ = nnls(
        np.concatenate([shares * weights[:, None], shrunk]),
        np.concatenate([sizes * weights, overall * shrunk.sum(axis=1)]),
    )
    return np.asarray(typical * family_quantile(sizes / (shares @ typical), families))


def hosts_of(shares: Array) -> NDArray[np.bool_]:
    """Return True where the host sets the rate, (n,)."""
    return np.asarray(shares[:, PARTS.index("copies") :].sum(axis=1) > 0.5)


def family_mean(sizes: Array, families: NDArray[np.str_]) -> float:
    """Return the mean over families of their means."""
    return float(np.mean([sizes[families == name].mean() for name in dict.fromkeys(families)]))


def family_quantile(errors: Array, families: NDArray[np.str_]) -> float:
    """Return the error that SHARE of all families exceed with no network, at CONFIDENCE."""
    largest = sorted(np.abs(errors)[families == name].max() for name in set(families))
    return float(largest[tolerance_rank(len(largest)) - 1])


def tolerance_rank(count: int) -> int:
    """Return the rank of the score, of `count` sorted ones, that bounds SHARE of all families.

    The k-th of n bounds them if fewer than k of n draws are among that share, which has a binomial
    probability (S. S. Wilks, 1941, doi:10.1214/aoms/1177731788). If no rank reaches CONFIDENCE, it
    is the last one.
    """
    return min(int(binom.ppf(CONFIDENCE, count, SHARE)) + 1, count)


def pair_width(board: str) -> float:
    """Return the error of the logarithm of the ratio of two rates that SHARE of the pairs of one
    family do not exceed.

    Each network is predicted without itself. Only rates that the DPU limits are used.
    """
    trial = _trial(board, chosen(board))
    cases = trial.cases
    names = np.array([row.network for row in cases.rows])
    errors = np.zeros(len(names))
    for name in dict.fromkeys(names):
        errors[names == name] = cases.only(names == name).errors(
            fit(cases.only(names != name), near=trial.near)
        )
    on_dpu = ~hosts_of(cases.shares(trial.near))
    outcomes = [
        (row, e) for row, e, selected in zip(cases.rows, errors, on_dpu, strict=True) if selected
    ]
    distances = [
        abs(x - y)
        for (a, x), (b, y) in combinations(outcomes, 2)
        if a.family == b.family and a.network != b.network
    ]
    return float(np.quantile(distances, SHARE))


def outside_width(cases: Cases, share: float = 0.25) -> float:
    """Return the error of the networks with the largest maps, predicted from the others.

    Only networks that the DPU limits are predicted, with a map above `share` of their largest one.
    """
    bound = ~hosts_of(cases.shares(fit(cases)))
    sizes = np.array([row.map_bytes for row in cases.rows])
    large = bound & (sizes > share * sizes[bound].max())
    tested = cases.only(large)
    return family_quantile(tested.errors(fit(cases.only(~large))), tested.families)


def by_network(rows: Iterable[LeftOut]) -> Array:
    """Return the mean |predicted / published - 1| of each network over configurations and rates."""
    by_name: dict[str, list[float]] = {}
    for row in rows:
        by_name.setdefault(row.network, []).extend(np.abs(np.expm1(row.rates)).tolist())
    return np.array([np.mean(values) for values in by_name.values()])


def coverage(rows: Sequence[LeftOut]) -> tuple[float, float]:
    """Return the share of rates inside their intervals, and of families with all rates inside.

    Each network has the same weight in the first share.
    """
    counts = Counter(row.network for row in rows)
    networks = sum(row.held / counts[row.network] for row in rows) / len(counts)
    families = {row.family for row in rows}
    return networks, float(
        np.mean([all(row.held == 1 for row in rows if row.family == name) for name in families])
    )


def settled(rows: Sequence[LeftOut]) -> tuple[float, float]:
    """Return the share of questions that the intervals decide, and the share of right decisions.

    A question is whether a network reaches a rate. The rates are from half the published one to
    twice, evenly spaced in logarithms. Each network has the same weight.
    """
    counts = Counter(row.network for row in rows)
    asked = np.linspace(-np.log(2), np.log(2), 401)
    shares = []
    for row in rows:
        # In logarithms the prediction is `rates` above the published rate, the question `asked`.
        far = np.abs(asked - row.rates[:, None]) > row.width
        right = far & ((asked > row.rates[:, None]) == (asked > 0))
        shares.append((far.mean() / counts[row.network], right.mean() / counts[row.network]))
    all_far, all_right = np.sum(shares, axis=0)
    return float(all_far / len(counts)), float(all_right / all_far)


@dataclass(frozen=True)
class Corrected:
    """The correction of networks by one run of another network, for one kinship.

    Attributes:
        pairs: the number of pairs of run and network.
        before: mean |predicted / published - 1| without the run.
        after: the same with the run.
        held: share of the networks whose rates are all inside the narrowed intervals.
    """

    pairs: int
    before: float
    after: float
    held: float


def corrected(owner: str, board: str) -> dict[str, Corrected]:
    """Correct the cases of a board by each published case of the owner's board, used as a run.

    All cases are predicted without their families.
    """
    by_kin = defaultdict(list)
    theirs, ours = (
        [(row, _levels(row, name)) for row in nested(name).rows] for name in (owner, board)
    )
    for (run, levels), (row, of) in product(theirs, ours):
        if levels[-1] != of[-1]:
            factor, left = correction(of, [(levels, -run.error)])
            shift = np.log(factor)
            held = np.all(np.abs(row.rates + shift) <= left * row.width)
            by_kin[_kin(run, row, levels, of)].append((row.error, row.error + shift, held))
    kinds = {}
    for kin, outcomes in sorted(by_kin.items()):
        before, after, held = np.array(outcomes, float).T
        off_before, off_after = (float(np.abs(np.expm1(e)).mean()) for e in (before, after))
        kinds[kin] = Corrected(len(outcomes), off_before, off_after, float(held.mean()))
    return kinds


def _levels(row: LeftOut, board: str) -> Levels:
    dpu = load_dpu(board, row.configuration)
    return levels_of(written(row.network).network.operations, dpu, "host" if row.on_host else "DPU")


def _kin(run: LeftOut, row: LeftOut, levels: Levels, of: Levels) -> str:
    if run.network == row.network:
        return "same network"
    if levels[1] == of[1]:
        return "same kinds of layers"
    return "same family" if run.family == row.family else "others"


def rank_correlation(validation: Nested) -> float:
    """Return Spearman's rank correlation of predicted and published rates."""
    errors = np.array([row.error for row in validation.rows])
    return float(spearmanr(validation.cases.observed, validation.cases.observed + errors).statistic)
