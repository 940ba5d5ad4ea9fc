"""Runs of an owner's own board: `bench --measured board.json` refits the cost model to them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from deploy.dpu.board import Dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.constants import NAMES, UNITS, Constants, Structure
from deploy.dpu.cost.fit import FIRM_PRIOR, Case, Cases, fit
from deploy.dpu.cost.host import placed_work, task_of
from deploy.dpu.cost.layers import Layers
from deploy.dpu.cost.published import network_case
from deploy.dpu.cost.work import count_work, largest_map_bytes
from deploy.dpu.reading import read_network
from deploy.dpu.zoo.networks import NETWORKS
from profiles.constant import Constant
from profiles.errors import ModelError, OptionError
from profiles.figures import Row, predicted, published
from profiles.toml import read_json


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
        for name in NAMES:
            cost[name] = Constant(getattr(self.new, name), "inferred", self.source)
        return replace(dpu, target=replace(dpu.target, tables={**dpu.target.tables, "cost": cost}))

    def constant_rows(self) -> list[Row]:
        """The constants before and after."""
        return [self._constant_row(name) for name in NAMES]

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
        figures = {"given": published(case.fps[0], "frame/s", self.source)}
        for key, ratio in ratios.items():
            rate = ratio * case.fps[0]
            figures[key] = predicted(rate, "frame/s", (rate, rate), f"cost model, {key} constants")
            figures[f"{key} is off by"] = predicted(100 * (ratio - 1), "%", (100 * (ratio - 1),) * 2, "arithmetic")
        return Row("runs", f"{case.network}, {case.configuration}", figures)


def refit(path: Path, dpu: Dpu) -> Refit:
    """Refit the constants of `dpu`'s target to the runs in a file.

    Raises:
        OptionError: not such a file, or a run that cannot be understood.
        ModelError: a model that does not run whole on the DPU.
        ProfileError: a configuration that the target does not have, or a target without cost constants.
    """
    runs = _read(path)
    cases = Cases(tuple(_case(run, path, index, dpu) for index, run in enumerate(runs)), Structure.of(dpu))
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


def _case(run: Mapping[str, object], path: Path, index: int, board: Dpu) -> Case:
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
    dpu = Dpu(board.target, *board.target.configuration(str(run.get("configuration", "")) or None))
    if "network" in run:
        name = str(run["network"])
        if name not in NETWORKS:
            raise OptionError(
                where, expected=f"one of {', '.join(NETWORKS)}", got=repr(name), remedy="or give a model"
            )
        return network_case(name, dpu, (float(fps),))
    return _model_case(path.parent / str(run["model"]), dpu, tile, float(fps))


def _model_case(model: Path, dpu: Dpu, tile_px: int, fps: float) -> Case:
    placement = place(read_network(model, tile_px), dpu)
    if placement.failed:
        remedy = "run 'beers-deploy check' for the reasons"
        raise ModelError(str(model), expected="a core that runs whole on the DPU", got="refused nodes", remedy=remedy)
    layers = Layers.of(count_work(placement.core, dpu), dpu)
    name, cores, largest = (
        f"{model.stem}, tiles of {tile_px}",
        dpu.whole("cpu", "cores"),
        largest_map_bytes(placement.core),
    )
    return Case(
        name, model.stem, dpu.name, layers, placed_work(placement, task_of(placement)), cores, (fps,), (), largest
    )
