"""Runs of a user's own board: `bench --measured board.json` corrects the cost model by them.

A run corrects the prediction of the same network by nearly the whole ratio of the measured to the
predicted rate, and that of other networks by less (`kinship`). Runs of another board with the same
DPU count too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass

from beers_deploy.dpu.board import Dpu, Levels, dpu_of
from beers_deploy.dpu.checker.placement import Placement, place
from beers_deploy.dpu.cost.latency import Prediction, predict
from beers_deploy.dpu.reading import read_sized_graph
from beers_deploy.profiles.errors import OptionError, counted, printable
from beers_deploy.profiles.figures import Row, measured, predicted
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.profiles.user_files.whole import unreadable
from beers_deploy.profiles.validation import CONFIG

EXAMPLE = 'Write [{"model": "core.onnx", "configuration": "C32B3", "tile_px": 640, "fps": 9.5}].'
FAR = 10_000
"""The largest factor by which the rate of a run may differ from the prediction of its network."""


@pydantic_dataclass(frozen=True, config=CONFIG)
class Entry:
    """One measurement in a JSON file of a user's own board, such as `measure.py` of a kit writes.

    Attributes:
        model: the path of the network, relative to the JSON file.
        fps: the measured rate in frames per second; a frame is one tile.
        tile_px: side of a tile in pixels; by default that of the shipped networks' kits.
        configuration: the name of the DPU's configuration; the board's default if None.
        target: the name of the board, if it is another one with the same DPU.
        provider: the execution provider of onnxruntime that ran the network.
        power_w: the measured power in W. It is shown next to the rate, and corrects nothing.
    """

    model: str
    fps: Annotated[float, Field(strict=True, gt=0)]
    tile_px: Annotated[int, Field(strict=True, ge=16, le=1 << 16)] = TILE_PX
    configuration: str | None = None
    target: str | None = None
    provider: str | None = None
    power_w: Annotated[float, Field(strict=True, ge=0)] | None = None


ENTRIES = TypeAdapter(Annotated[list[Entry], Field(min_length=1, max_length=100)])


@dataclass(frozen=True)
class Run:
    """One measurement on a user's own board, together with its prediction.

    Attributes:
        name: the name of the network and its tile size, for tables.
        placement: where each operation of the network runs.
        fps: the measured rate in frames per second.
        predicted: the prediction without any correction by measurements.
        power_w: the measured power in W, if it is known.
    """

    name: str
    placement: Placement
    fps: float
    predicted: Prediction
    power_w: float | None

    @property
    def ratio(self) -> tuple[Levels, float]:
        """The keys that other runs may share (`kinship.levels_of`), and ln(measured / predicted
        rate).
        """
        return self.predicted.levels, math.log(self.fps / self.predicted.fps)


@dataclass(frozen=True)
class OwnRuns:
    """Rates that a user measured on their own board, which correct predictions.

    Attributes:
        source: the number of runs and the name of their file, which figures state as their source.
        runs: the measurements, each with the prediction of the same network and configuration.
    """

    source: str
    runs: Sequence[Run]

    def applied(self, dpu: Dpu) -> Dpu:
        """Return a copy of a configuration whose predictions these runs correct."""
        return replace(dpu, runs=tuple(run.ratio for run in self.runs))

    def run_rows(self) -> list[Row]:
        """Compare each measured rate with its prediction, to show what the runs improve.

        Returns:
            A row for each run with the measured rate and power, the prediction without any run,
            the prediction corrected by all other runs, and the error of both in percent.
        """
        rows = []
        for run in self.runs:
            before = run.predicted
            others = tuple(other.ratio for other in self.runs if other is not run)
            after = predict(run.placement, replace(before.dpu, runs=others))
            figures = {"given": measured(run.fps, "frame/s", self.source)}
            for key, prediction in {"shipped": before, "by the other runs": after}.items():
                off = 100 * (prediction.fps / run.fps - 1)
                figures[key] = predicted(
                    prediction.fps, "frame/s", prediction.fps_interval, f"cost model, {key}"
                )
                figures[f"{key} is off by"] = predicted(off, "%", (off, off), "arithmetic")
            if run.power_w is not None:
                figures["power"] = measured(run.power_w, "W", self.source)
            name = f"{run.name}, {before.dpu.target.name} {before.dpu.name}"
            rows.append(Row("runs", name, figures, {"bound": before.bound}))
        return rows


def read_own_runs(path: Path, dpu: Dpu) -> OwnRuns:
    """Read the measurements of a user's own board, and predict each of them.

    Args:
        path: the JSON file, a list of `Entry`.
        dpu: a configuration of the board that is to be predicted. Measurements may be of its other
            configurations, and of other boards with the same DPU.

    Raises:
        OptionError: the file is not a list of measurements; or one is of another DPU, of
            onnxruntime's CPU provider, or too far from its prediction to be of the same network.
        ModelError: a network cannot be read, or does not run on the DPU.
        ProfileError: there is no such board or configuration.
    """
    try:
        entries = ENTRIES.validate_python(read_json(path))
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        where = f"{path} must be a list of runs"
        if fault["loc"]:
            number, *keys = fault["loc"]
            where = " ".join([f"Run {int(number) + 1} in {path.name}", *map(str, keys)])
        raise OptionError(f"{printable(where)}: {fault['msg']}. {EXAMPLE}") from None
    except (OSError, ValueError) as error:
        reason = unreadable(path) or f"it is not valid JSON ({printable(str(error))})"
        raise OptionError(f"{path} cannot be read: {reason}. {EXAMPLE}") from error
    runs = [
        _run(entry, path, f"Run {number} in {path.name}", dpu)
        for number, entry in enumerate(entries, 1)
    ]
    return OwnRuns(f"{counted(len(runs), 'run')} in {path.name}, weighed by kinship", runs)


def _run(entry: Entry, path: Path, where: str, board: Dpu) -> Run:
    # onnxruntime's CPU provider runs the file on a processor: its rate says nothing about the DPU.
    if entry.provider == "CPUExecutionProvider":
        raise OptionError(
            f"{where} is a run of onnxruntime's CPU provider, not of the board. Measure it with "
            "the board's provider."
        )
    target = TargetProfile.load(entry.target) if entry.target else board.target
    if target.documents.get("operators") != board.target.documents["operators"]:
        raise OptionError(
            f"{where} is of {printable(target.name)}, whose DPU is not that of "
            f"{board.target.name}. Give runs of boards with the same DPU."
        )
    dpu = dpu_of(target, entry.configuration)
    model = path.parent / entry.model
    placement = place(read_sized_graph(model, entry.tile_px), dpu)
    prediction = predict(placement, dpu)
    if not prediction.fps / FAR <= entry.fps <= prediction.fps * FAR:
        raise OptionError(
            f"{where} has {entry.fps:g} frames per second, but {prediction.fps:.3g} are predicted, "
            "which is too far away to be the same network. Correct fps or model."
        )
    name = f"{model.stem}, tiles of {entry.tile_px}"
    return Run(name, placement, entry.fps, prediction, entry.power_w)
