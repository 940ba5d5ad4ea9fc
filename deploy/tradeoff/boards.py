"""The study's networks on every configuration of its boards: what another board would change.

A legal network computes the same integers on all of them, so its pictures are the study's own and only the board's
figures differ. The networks are those of the default configuration with exact seams, one row a tile.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

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


def board_rows(
    outcomes: Sequence[Outcome], dpus: Sequence[Dpu], model_of: Callable[[Variant], onnx.ModelProto]
) -> tuple[Row, ...]:
    """A row for each network, tile and DPU.

    Args:
        outcomes: of the study.
        dpus: as `every_configuration` lists them.
        model_of: the INT8 file of a variant.
    """
    shown = [each for each in outcomes if _compares(each)]
    return tuple(row for each in shown for row in _rows(each, dpus, model_of(each.point.variant)))


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


def _rows(outcome: Outcome, dpus: Sequence[Dpu], model: onnx.ModelProto) -> Iterator[Row]:
    network = network_of(model, outcome.point.tile_px)
    quality = {key: outcome.figures[key] for key in DIRECTIONS if key in outcome.figures}
    for dpu in dpus:
        point, where = outcome.point, f"{dpu.target.name} {dpu.name}"
        figures, fitted = _figures(outcome, network, dpu)
        words = {"board": dpu.target.name, "configuration": dpu.name, "tile": str(point.tile_px)}
        words |= {"fitted range": fitted, "method": point.variant.method}
        yield Row(TABLE, f"{point.variant.method}, tile {point.tile_px}, {where}", {**figures, **quality}, words)


def _figures(outcome: Outcome, network: Network, dpu: Dpu) -> tuple[Mapping[str, Figure], str]:
    """The board's figures, and whether the fitted networks speak for them."""
    assert isinstance(outcome.board, DpuRun)  # noqa: S101 - chosen so
    try:
        prediction = predict(place(network, dpu), dpu)
    except ModelError as error:
        reason = str(error).rstrip(".")
        return {f"board {name}": unavailable(UNITS[f"board {name}"], reason) for name in FIGURES}, ""
    run = DpuRun(outcome.board.network, dpu, prediction, outcome.board.swath)
    return run.figures(), fitted_range(prediction)
