"""How wrong the cost model is about networks that its fit has not seen."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.fit import Cases, fit
from deploy.dpu.rates import Array, Constants


def leave_out(cases: Cases, names: Sequence[str]) -> Array:
    """ln(predicted / observed) of each row (n,), predicted without the rows that share its name."""
    groups, errors = np.asarray(names), np.zeros(len(cases.rows))
    for name in dict.fromkeys(names):
        out = groups == name
        errors[out] = cases.only(out).errors(fit(cases.only(~out)))
    return errors


def quantile(errors: Array, names: Sequence[str], share: float = 0.9) -> float:
    """The size of error that `share` of the rows do not exceed, each name counting once."""
    _, index, counts = np.unique(np.asarray(names), return_inverse=True, return_counts=True)
    sizes, weights = np.abs(errors), 1 / counts[index]
    order = np.argsort(sizes, kind="stable")
    reached = np.cumsum(weights[order]) / weights.sum()
    return float(sizes[order][np.searchsorted(reached, min(share, reached[-1]))])


def coverage(errors: Array, names: Sequence[str]) -> float:
    """Share of rows inside an interval made of the other names' errors."""
    groups = np.asarray(names)
    inside = [
        abs(error) <= quantile(errors[groups != name], groups[groups != name].tolist())
        for error, name in zip(errors, names, strict=True)
    ]
    return float(np.mean(inside))


def beyond(cases: Cases, share: float = 0.25) -> tuple[Array, list[str]]:
    """Errors of networks with large maps, predicted from networks with small ones, and the names of their rows.

    Large: above `share` of the largest map. Only rows that the DPU bounds are predicted; those that the host bounds
    say nothing of maps and stay in the fit.
    """
    bound = bound_by_dpu(cases, fit(cases))
    sizes = np.array([row.profile.map_bytes for row in cases.rows])
    large = bound & (sizes > share * sizes[bound].max())
    tested = cases.only(large)
    return tested.errors(fit(cases.only(~large))), [row.network for row in tested.rows]


def bound_by_dpu(cases: Cases, constants: Constants) -> NDArray[np.bool_]:
    """Where the DPU takes longer than the host, (n,)."""
    return np.asarray(cases.dpu_s(constants) > cases.host_s(constants))


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


def fitted_ranges(cases: Cases, constants: Constants) -> dict[str, tuple[float, float]]:
    """Ranges of the networks that the DPU bounds: the others tell nothing of it."""
    profiles = [row.profile for row in cases.only(bound_by_dpu(cases, constants)).rows]
    keys = ("map_bytes", "operations", "intensity")
    return {key: (min(getattr(p, key) for p in profiles), max(getattr(p, key) for p in profiles)) for key in keys}
