"""The study's networks on every configuration of its boards: what another board would change.

A legal network computes the same integers on all of them, so its pictures are the study's own and only the board's
figures differ. The networks are those of the default configuration with exact seams, one row a tile.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import onnx

from deploy.bench.tables import fitted_range
from deploy.dpu.board import Dpu, dpu_of
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.constants import Constants
from deploy.dpu.cost.latency import predict
from deploy.dpu.graph import Network
from deploy.dpu.reading import network_of
from deploy.tradeoff.board import FIGURES, DpuRun
from deploy.tradeoff.outcome import DIRECTIONS, UNITS, Outcome
from deploy.tradeoff.points import EXACT, Variant
from profiles import TargetProfile, load_target
from profiles.errors import ModelError, OptionError
from profiles.figures import Figure, Row, unavailable
from profiles.target import DEFAULT_TARGET, board_names

ALL = "all"
TABLE = "boards"


def parse_targets(text: str) -> tuple[str, ...]:
    """The boards of `--target`: one, several with commas, or all; the study itself is about the first.

    Raises:
        OptionError: an empty name, or the same board twice.
    """
    if text == ALL:
        return DEFAULT_TARGET, *(name for name in board_names() if name != DEFAULT_TARGET)
    names = tuple(name.strip() for name in text.split(","))
    if not all(names) or len(set(names)) < len(names):
        remedy = "write vck190, or vck190,zcu102, or all"
        raise OptionError("--target", expected="boards, each once", got=repr(text), remedy=remedy)
    return names


@dataclass(frozen=True)
class OnBoard:
    """A network of the study on another DPU; `fitted` says whether the fitted networks speak for its figures."""

    outcome: Outcome
    dpu: Dpu
    fitted: str

    @property
    def row(self) -> Row:
        """Its figures of the board, and the pictures' own beside them."""
        found, point = self.outcome.figures, self.outcome.point
        keys = [*(f"board {name}" for name in FIGURES), *(key for key in DIRECTIONS if key in found)]
        words = {"board": self.dpu.target.name, "configuration": self.dpu.name, "tile": str(point.tile_px)}
        words |= {"fitted range": self.fitted, "method": point.variant.method}
        name = f"{point.variant.method}, tile {point.tile_px}, {self.dpu.target.name} {self.dpu.name}"
        return Row(TABLE, name, {key: found[key] for key in keys}, words)


def on_boards(
    outcomes: Sequence[Outcome], dpus: Sequence[Dpu], model_of: Callable[[Variant], onnx.ModelProto]
) -> list[OnBoard]:
    """Each network and tile on each DPU.

    Args:
        outcomes: of the study.
        dpus: as `every_configuration` lists them.
        model_of: the INT8 file of a variant.
    """
    shown = [each for each in outcomes if _compares(each)]
    return [found for each in shown for found in _on_boards(each, dpus, model_of(each.point.variant))]


def every_configuration(boards: Sequence[str]) -> list[Dpu]:
    """Those of several boards, by name or file.

    Raises:
        ProfileError: an unknown board, or one without cost constants.
        OptionError: a target without a DPU.
    """
    dpus = [dpu for target in map(load_target, boards) for dpu in configurations(target)]
    for dpu in dpus:
        Constants.of(dpu)
    return dpus


def configurations(target: TargetProfile) -> list[Dpu]:
    """Those of a board, its default one first."""
    default = dpu_of(target)
    return [default, *(dpu_of(target, name) for name in target.configurations if name != default.name)]


def _compares(outcome: Outcome) -> bool:
    run, point = outcome.board, outcome.point
    return isinstance(run, DpuRun) and run.dpu.name == dpu_of(run.dpu.target).name and point.halo == EXACT


def _on_boards(outcome: Outcome, dpus: Sequence[Dpu], model: onnx.ModelProto) -> Iterator[OnBoard]:
    network = network_of(model, outcome.point.tile_px)
    for dpu in dpus:
        run, fitted = _run(outcome, network, dpu)
        figures = (
            run.figures() if isinstance(run, DpuRun) else {f"board {name}": _lacking(name, run) for name in FIGURES}
        )
        moved = replace(
            outcome,
            point=replace(outcome.point, configuration=dpu.name),
            figures={**outcome.figures, **figures},
            board=run if isinstance(run, DpuRun) else None,
        )
        yield OnBoard(moved, dpu, fitted)


def _run(outcome: Outcome, network: Network, dpu: Dpu) -> tuple[DpuRun | str, str]:
    """Its run there, or why there is none; and whether the fitted networks speak for it."""
    assert isinstance(outcome.board, DpuRun)  # noqa: S101 - chosen so
    try:
        prediction = predict(place(network, dpu), dpu)
    except ModelError as error:
        return str(error).rstrip("."), ""
    return DpuRun(outcome.board.network, dpu, prediction, outcome.board.swath), fitted_range(prediction)


def _lacking(name: str, reason: str) -> Figure:
    return unavailable(UNITS[f"board {name}"], reason)
