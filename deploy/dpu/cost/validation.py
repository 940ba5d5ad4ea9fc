"""How wrong the cost model is about networks that its fit has not seen: published ones, and an owner's own runs.

`bench --measured board.json` refits the model to the latter.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.fit import FIRM_PRIOR, Case, Cases, fit
from deploy.dpu.cost.latency import Profile, crossing_bytes
from deploy.dpu.cost.layers import Array, Constants, Layers, count_work
from deploy.dpu.reading import read_network
from deploy.dpu.zoo.networks import NETWORKS, family, network, published_rates, read_bytes
from profiles.constant import Constant
from profiles.errors import ModelError, OptionError
from profiles.figures import Row, predicted, published
from profiles.toml import read_json


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


def published_cases(*, sorting: bool = False) -> Cases:
    """The published rates.

    Args:
        sorting: those whose host sorts boxes or key points, which the model cannot know and the fit leaves out.
    """
    chosen = [r for r in published_rates() if r.board == "vck190" and (family(r.network) in SORTING) is sorting]
    rows = tuple(network_case(rate.network, _dpu(rate.configuration), rate.fps) for rate in chosen)
    return Cases(rows, load_dpu("vck190").value("cost", "serial"))


SORTING = ("ssd", "superpoint")
"""Families whose hosts sort most of what they read."""


def network_case(name: str, dpu: Dpu, fps: float) -> Case:
    """One of NETWORKS on a configuration, with its rate."""
    net = network(name)
    works = count_work(net.operations, dpu)
    taken = sum(math.prod(shape) for shape in net.inputs.values())
    profile = Profile.of(net.operations, works)
    crossing = (taken, read_bytes(name))
    return Case(name, family(name), dpu.name, Layers.of(works, dpu), dpu.batch, crossing, fps, profile)


@cache
def _dpu(configuration: str) -> Dpu:
    return load_dpu("vck190", configuration)


UNITS = {
    "efficiency": "1",
    "map_bytes_per_s": "B/s",
    "batch_s": "s",
    "layer_s": "s",
    "host_in_bytes_per_s": "B/s",
    "host_out_bytes_per_s": "B/s",
}


@dataclass(frozen=True)
class Refit:
    """What the runs changed."""

    source: str
    cases: Cases
    old: Constants
    new: Constants

    def applied(self, dpu: Dpu) -> Dpu:
        """The board with the new constants; its interval stays that of the published networks."""
        cost = dict(dpu.target.tables["cost"])
        for field in fields(Constants):
            cost[field.name] = Constant(getattr(self.new, field.name), "inferred", self.source)
        return replace(dpu, target=replace(dpu.target, tables={**dpu.target.tables, "cost": cost}))

    def constant_rows(self) -> list[Row]:
        """The constants before and after."""
        return [self._constant_row(field.name) for field in fields(Constants)]

    def run_rows(self) -> list[Row]:
        """What each run was predicted to be, before and after."""
        before, after = (self.cases.errors(constants).tolist() for constants in (self.old, self.new))
        return [self._run_row(*row) for row in zip(self.cases.rows, before, after, strict=True)]

    def _constant_row(self, name: str) -> Row:
        values = {"shipped": getattr(self.old, name), "refitted": getattr(self.new, name)}
        figures = {key: predicted(value, UNITS[name], (value, value), self.source) for key, value in values.items()}
        return Row("constants", name, figures)

    def _run_row(self, case: Case, before: float, after: float) -> Row:
        ratios = {"shipped": math.exp(before), "refitted": math.exp(after)}
        figures = {"given": published(case.fps, "frame/s", self.source)}
        for key, ratio in ratios.items():
            rate = ratio * case.fps
            figures[key] = predicted(rate, "frame/s", (rate, rate), f"cost model, {key} constants")
            figures[f"{key} is off by"] = predicted(100 * (ratio - 1), "%", (100 * (ratio - 1),) * 2, "arithmetic")
        return Row("runs", f"{case.network}, {case.configuration}", figures)


def refit(path: Path, dpu: Dpu) -> Refit:
    """Refit the constants of `dpu`'s target to the runs in a file.

    Raises:
        OptionError: not such a file, or a run that cannot be understood.
        ModelError: a model that does not run whole on the DPU.
    """
    runs = _read(path)
    cases = Cases(tuple(_case(run, path, index) for index, run in enumerate(runs)), dpu.value("cost", "serial"))
    old = Constants.of(dpu)
    new = fit(cases, old, FIRM_PRIOR).rounded()
    return Refit(f"refitted to {len(runs)} runs in {path.name}", cases, old, new)


def _read(path: Path) -> Sequence[Mapping[str, object]]:
    try:
        runs = read_json(path)
    except OSError as error:
        got = error.strerror or str(error)
        raise OptionError(str(path), expected="a readable file", got=got, remedy="check the path") from error
    except ValueError as error:
        raise OptionError(str(path), expected="JSON", got=str(error), remedy="correct the file") from error
    if not isinstance(runs, list) or not 0 < len(runs) <= RUNS or not all(isinstance(run, dict) for run in runs):
        expected, got = f"a list of 1 to {RUNS} runs", type(runs).__name__
        raise OptionError(str(path), expected=expected, got=got, remedy=EXAMPLE)
    return runs


EXAMPLE = 'write [{"model": "core.onnx", "configuration": "C32B3", "tile_px": 640, "fps": 9.5}]'
RUNS, TILE_MAX_PX, FPS = 1000, 1 << 16, (1e-9, 1e9)
"""A board has seen far fewer runs; beyond these sizes and rates the fit has no digits left."""
KEYS = {"model", "network", "configuration", "tile_px", "fps", "power_w"}


def _case(run: Mapping[str, object], path: Path, index: int) -> Case:
    where = f"{path.name}, run {index + 1}"
    unknown = set(run) - KEYS
    fps, tile = run.get("fps"), run.get("tile_px", 640)
    if unknown or ("model" in run) == ("network" in run):
        raise OptionError(
            where, expected="model or network, configuration, tile_px, fps", got=str(sorted(run)), remedy=EXAMPLE
        )
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not FPS[0] < fps < FPS[1]:
        raise OptionError(where, expected="frames a second above zero", got=repr(fps), remedy=EXAMPLE)
    if isinstance(tile, bool) or not isinstance(tile, int) or not 16 <= tile <= TILE_MAX_PX:
        raise OptionError(
            where, expected=f"a tile side of 16 to {TILE_MAX_PX} pixels", got=repr(tile), remedy=EXAMPLE
        )
    dpu = load_dpu("vck190", str(run.get("configuration", "")) or None)
    if "network" in run:
        name = str(run["network"])
        if name not in NETWORKS:
            raise OptionError(
                where, expected=f"one of {', '.join(NETWORKS)}", got=repr(name), remedy="or give a model"
            )
        return network_case(name, dpu, float(fps))
    return _model_case(path.parent / str(run["model"]), dpu, tile, float(fps))


def _model_case(model: Path, dpu: Dpu, tile_px: int, fps: float) -> Case:
    placement = place(read_network(model, tile_px), dpu)
    if placement.failed:
        remedy = "run 'beers-deploy check' for the reasons"
        raise ModelError(str(model), expected="a core that runs whole on the DPU", got="refused nodes", remedy=remedy)
    works = count_work(placement.core, dpu)
    profile = Profile.of(placement.core, works)
    name, layers = f"{model.stem}, tiles of {tile_px}", Layers.of(works, dpu)
    return Case(name, model.stem, dpu.name, layers, dpu.batch, crossing_bytes(placement), fps, profile)
