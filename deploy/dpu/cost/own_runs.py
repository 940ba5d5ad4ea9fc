"""Runs of a user's own board: `bench --measured board.json` corrects the cost model by them.

A run corrects the prediction of the same network by nearly all of its ratio of given to predicted,
and that of other networks by less, as `kinship` tells. Runs of another board with the same DPU
count too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from beers_deploy.dpu.board import Dpu, Levels, dpu_of
from beers_deploy.dpu.checker.placement import Placement, place
from beers_deploy.dpu.cost.latency import Prediction, predict
from beers_deploy.dpu.reading import read_network
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Row, predicted, published
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.toml import read_json, unreadable

EXAMPLE = 'Write [{"model": "core.onnx", "configuration": "C32B3", "tile_px": 640, "fps": 9.5}].'
RUNS = 100
TILE_PX = (16, 1 << 16)
FAR = 10_000
"""Most runs; least and most of a tile's side; and how many times off a rate of this network may be
predicted.
"""
POWER_W = (0.01, 1000.0)
KEYS = {"model", "configuration", "tile_px", "fps", "power_w", "provider", "target"}


@dataclass(frozen=True)
class Run:
    """One entry of the file: a network placed on a configuration, the rate given for it and the one
    predicted.
    """

    name: str
    placement: Placement
    fps: float
    predicted: Prediction

    @property
    def ratio(self) -> tuple[Levels, float]:
        """What it has in common with others, and ln(given / predicted)."""
        return self.predicted.levels, math.log(self.fps / self.predicted.fps)


@dataclass(frozen=True)
class OwnRuns:
    """The runs of an owner's board."""

    source: str
    runs: Sequence[Run]

    def applied(self, dpu: Dpu) -> Dpu:
        """The configuration, whose predictions the runs correct."""
        return replace(dpu, runs=tuple(run.ratio for run in self.runs))

    def run_rows(self) -> list[Row]:
        """The rate given for each run, and what is predicted without runs and by the others."""
        rows = []
        for run in self.runs:
            before = run.predicted
            others = tuple(other.ratio for other in self.runs if other is not run)
            after = predict(run.placement, replace(before.dpu, runs=others))
            figures = {"given": published(run.fps, "frame/s", self.source)}
            for key, prediction in {"shipped": before, "by the other runs": after}.items():
                off = 100 * (prediction.fps / run.fps - 1)
                figures[key] = predicted(
                    prediction.fps, "frame/s", prediction.fps_interval, f"cost model, {key}"
                )
                figures[f"{key} is off by"] = predicted(off, "%", (off, off), "arithmetic")
            name = f"{run.name}, {before.dpu.target.name} {before.dpu.name}"
            rows.append(Row("runs", name, figures, {"bound": before.bound}))
        return rows


def read_own_runs(path: Path, dpu: Dpu) -> OwnRuns:
    """Compare the runs in a file with what is predicted of them on `dpu`'s board."""
    runs = [
        _run(entry, path, f"Run {number} in {path.name}", dpu)
        for number, entry in enumerate(_read(path), 1)
    ]
    return OwnRuns(f"{len(runs)} runs in {path.name}, weighed by kinship", runs)


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
        actual = f"a list of {len(runs)}" if isinstance(runs, list) else type(runs).__name__
        raise OptionError(f"{path} must be a list of 1 to {RUNS} runs, got {actual}. {EXAMPLE}")
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
    dpu = _dpu(entry, where, board)
    model = path.parent / str(entry["model"])
    placement = place(read_network(model, int(tile_px)), dpu)
    prediction = predict(placement, dpu)
    # A power is checked but not used: the runs correct rates alone.
    if "power_w" in entry:
        _number(entry["power_w"], "power_w", POWER_W, where)
    fps = _number(entry.get("fps"), "fps", (prediction.fps / FAR, prediction.fps * FAR), where)
    return Run(f"{model.stem}, tiles of {tile_px:g}", placement, fps, prediction)


def _dpu(entry: Mapping[str, object], where: str, board: Dpu) -> Dpu:
    """Return the configuration of a run, which may be of another board with the same DPU."""
    name = entry.get("target")
    target = TargetProfile.load(str(name)) if name else board.target
    if target.documents.get("operators") != board.target.documents["operators"]:
        raise OptionError(
            f"{where} is of {printable(target.name)}, whose DPU is not that of "
            f"{board.target.name}. Give runs of boards with the same DPU."
        )
    return dpu_of(target, str(entry.get("configuration", "")) or None)


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
