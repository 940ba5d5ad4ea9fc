"""Runs of a user's own board: `bench --measured board.json` corrects the cost model by two factors.

The DPU's factor comes from given over predicted rates of the runs that the DPU bounds, the host's
from the others. A ratio tells more of its network than of the board: the variance among networks of
one board, each left out of the fit, is SCATTER times that among boards. So n runs move a factor by
n / (n + SCATTER) of the mean of their logarithms. A part that no run is bound by keeps its
constants, and the interval stays that of the published networks: measured in
docs/explanation/cost-model.md.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.placement import Placement, place
from beers_deploy.dpu.cost.latency import Prediction, predict
from beers_deploy.dpu.cost.model import OWN_SPEEDS
from beers_deploy.dpu.reading import read_network
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Row, predicted, published
from beers_deploy.profiles.toml import read_json, unreadable

EXAMPLE = 'Write [{"model": "core.onnx", "configuration": "C32B3", "tile_px": 640, "fps": 9.5}].'
RUNS = 1000
TILE_PX = (16, 1 << 16)
FAR = 10_000
"""Most runs; least and most of a tile's side; and how many times off a rate of this network may be
predicted.
"""
POWER_W = (0.01, 1000.0)
SCATTER = 3
"""Variance of networks over that of boards, of ln(predicted / published): 0.13^2 and 0.07^2."""
KEYS = {"model", "configuration", "tile_px", "fps", "power_w", "provider"}


@dataclass(frozen=True)
class Run:
    """One entry of the file: a network placed on a configuration, the rate given for it and the one
    predicted.
    """

    name: str
    placement: Placement
    fps: float
    predicted: Prediction


@dataclass(frozen=True)
class OwnRuns:
    """How many times as fast as predicted the DPU and the host are, as far as the runs tell."""

    source: str
    runs: Sequence[Run]
    dpu_factor: float
    host_factor: float

    def applied(self, dpu: Dpu) -> Dpu:
        """The board with the corrected constants."""
        factors = zip(OWN_SPEEDS, (self.dpu_factor, self.host_factor), strict=True)
        cost = {name: Constant(factor, "inferred", self.source) for name, factor in factors}
        tables = {**dpu.target.tables, "cost": {**dpu.target.tables["cost"], **cost}}
        return replace(dpu, target=replace(dpu.target, tables=tables))

    def factor_rows(self) -> list[Row]:
        """The two factors."""
        factors = (("DPU", self.dpu_factor), ("host", self.host_factor))
        rows = []
        for name, value in factors:
            figure = predicted(value, "x", (value, value), self.source)
            rows.append(Row("correction", name, {"given / predicted": figure}))
        return rows

    def run_rows(self) -> list[Row]:
        """The rate given for each run, and what was predicted before and after the correction."""
        rows = []
        for run in self.runs:
            before = run.predicted
            after = predict(run.placement, self.applied(before.dpu))
            figures = {"given": published(run.fps, "frame/s", self.source)}
            for key, prediction in {"shipped": before, "corrected": after}.items():
                off = 100 * (prediction.fps / run.fps - 1)
                figures[key] = predicted(
                    prediction.fps, "frame/s", prediction.fps_interval, f"cost model, {key}"
                )
                figures[f"{key} is off by"] = predicted(off, "%", (off, off), "arithmetic")
            rows.append(
                Row("runs", f"{run.name}, {before.dpu.name}", figures, {"bound": before.bound})
            )
        return rows


def read_own_runs(path: Path, dpu: Dpu) -> OwnRuns:
    """Compare the runs in a file with what is predicted of them on `dpu`'s board."""
    runs = [
        _run(entry, path, f"Run {number} in {path.name}", dpu)
        for number, entry in enumerate(_read(path), 1)
    ]
    ratios = [
        (run.predicted.bound == "host", math.log(run.fps / run.predicted.fps)) for run in runs
    ]
    on_dpu, host = (
        _factor([ratio for bound, ratio in ratios if bound is on_host]) for on_host in (False, True)
    )
    return OwnRuns(f"{len(runs)} runs in {path.name}, drawn to 1", runs, on_dpu, host)


def _factor(ratios: Sequence[float]) -> float:
    """From ln(given / predicted) of runs."""
    # Few runs tell more of their networks than of the board: n of them count n / (n + SCATTER).
    return math.exp(len(ratios) / (len(ratios) + SCATTER) * mean(ratios)) if ratios else 1.0


def _read(path: Path) -> Sequence[Mapping[str, object]]:
    try:
        runs = read_json(path)
    except (OSError, ValueError) as error:
        if fault := unreadable(path):
            message = f"{path} cannot be read: {fault}. Check the path."
        else:
            message = f"{path} is not a valid JSON file: {printable(str(error))}. {EXAMPLE}"
        raise OptionError(message) from error
    if (
        not isinstance(runs, list)
        or not 0 < len(runs) <= RUNS
        or not all(isinstance(run, dict) for run in runs)
    ):
        found = f"a list of {len(runs)}" if isinstance(runs, list) else type(runs).__name__
        raise OptionError(f"{path} must be a list of 1 to {RUNS} runs, got {found}. {EXAMPLE}")
    return runs


def _run(entry: Mapping[str, object], path: Path, where: str, board: Dpu) -> Run:
    if "model" not in entry or set(entry) - KEYS:
        given = printable(", ".join(sorted(entry)) or "none")
        others = ", ".join(sorted(KEYS - {"model"}))
        raise OptionError(
            f"{where} must have the key model, and may have {others}, got {given}. {EXAMPLE}"
        )
    # onnxruntime's CPU provider runs the file on a processor: its rate says nothing of the DPU.
    if entry.get("provider") == "CPUExecutionProvider":
        raise OptionError(
            f"{where} is a run of onnxruntime's CPU provider, not of the board. Measure it with "
            "the board's provider."
        )
    tile_px = _number(entry.get("tile_px", 640), "tile_px", TILE_PX, where)
    if tile_px != int(tile_px):
        raise OptionError(f"{where} must have tile_px in whole pixels, got {tile_px}. {EXAMPLE}")
    dpu = Dpu(
        board.target, *board.target.configuration(str(entry.get("configuration", "")) or None)
    )
    model = path.parent / str(entry["model"])
    placement = place(read_network(model, int(tile_px)), dpu)
    prediction = predict(placement, dpu)
    # A power is checked but not used: the runs correct rates alone.
    if "power_w" in entry:
        _number(entry["power_w"], "power_w", POWER_W, where)
    fps = _number(entry.get("fps"), "fps", (prediction.fps / FAR, prediction.fps * FAR), where)
    return Run(f"{model.stem}, tiles of {tile_px:g}", placement, fps, prediction)


def _number(value: object, key: str, ends: tuple[float, float], where: str) -> float:
    # A bool is an int in Python, and true is no number of a run.
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not ends[0] <= value <= ends[1]
    ):
        raise OptionError(
            f"{where} must have {key} of {ends[0]:g} to {ends[1]:g}, got "
            f"{printable(repr(value))}. {EXAMPLE}"
        )
    return float(value)
