"""A swath on a board or on all, predicted, beside the traditional pipeline measured here and the paper's figures.

One configuration and one tile size are predicted layer by layer; several are swept. Networks that cannot be tiled are
predicted by the frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import onnx

from deploy.bench.host import Sensors, drawn_acquisition, traditional_rows
from deploy.bench.tables import (
    PAPER_SIZE,
    PAPER_TARGET,
    Swath,
    frame_row,
    host_words,
    layer_rows,
    parse_size,
    predict_file,
    predicted_rows,
    published_rows,
    sweep_rows,
    within_words,
)
from deploy.dpu.board import Dpu, dpu_of
from deploy.dpu.cost.host import Task
from deploy.dpu.cost.latency import Prediction
from deploy.dpu.cost.runs import refit
from deploy.dpu.reading import own_tile_px
from deploy.restoration.options import parse_halo
from model.io.images import read_acquisition
from model.shipped import SENSOR
from profiles import TargetProfile, load_target
from profiles.errors import ModelError, OptionError
from profiles.figures import Row
from profiles.sensor_file import REFERENCE, load_sensor
from profiles.target import board_names
from quant.onnx_file import load_onnx
from quant.tiling.walk import receptive_radius_px, tiling_of

TRAFFIC = "LdFM, StFM: feature maps loaded and stored, an image; LdWB: weights and biases loaded, a batch"
ALL = "all"
"""Every board, or every configuration."""
FREE_TILE_PX = 640


@dataclass(frozen=True)
class BoardRequest:
    """What a user wants to know of a board, or of all.

    Attributes:
        target: the board, or "all".
        image: the swath; None for a drawn one of `size`.
        full_scale: the image's pixel value that is full scale; None lets its type and values decide.
        size: WIDTHxHEIGHT in pixels; None for the paper's.
        tiles_px: tile sides.
        halo: "exact" or a number of pixels.
        config: the DPU's configuration, "all", or None for the target's own.
        measured: runs of the user's board, to which the cost model is refitted.
        within_s: what the swath may take; None does not ask.
        host_task: what the host does with the results; None for what the file tells.
    """

    target: str
    image: Path | None
    full_scale: float | None
    size: str | None
    tiles_px: Sequence[int]
    halo: str
    config: str | None
    measured: Path | None
    within_s: float | None = None
    host_task: Task | None = None


@dataclass(frozen=True)
class BoardBench:
    """What was found.

    Attributes:
        rows: all of them.
        shown: tables that answer, in their order.
        notes: sentences to say with them.
        layers: tables that say where the time goes: layer by layer, and the pipeline's by kind of work.
    """

    rows: list[Row]
    shown: list[tuple[str, list[Row]]]
    notes: list[str]
    layers: list[tuple[str, list[Row]]] = field(default_factory=list)


def bench_board(model: Path, request: BoardRequest, budget_s: float) -> BoardBench:
    """Predict a network's swath on boards, and measure the traditional pipeline on this processor.

    A network that cannot be tiled is predicted by the frame, with nothing beside it.

    Args:
        model: ONNX file.
        request: the swath and the configurations.
        budget_s: seconds that the pipeline may take to be run on the whole image rather than on parts of it.

    Raises:
        BeersError: a file or an option that is not what it should be.
    """
    network, sensors = load_onnx(model), Sensors(load_sensor(SENSOR), load_sensor(REFERENCE))
    boards, refitted = _boards(request)
    whole = _untiled(network, request)
    if whole is not None:
        return _frames(model, network, boards, refitted, whole, request.host_task)
    dn = read_acquisition(request.image, request.full_scale, None) if request.image else None
    swath = _swath(network, dn.shape if dn is not None else None, request)
    single = len(boards) == len(request.tiles_px) == 1 and request.within_s is None
    found = _single(model, boards[0], swath, request.host_task) if single else _sweep(model, boards, request, swath)
    scene, targets = dn if dn is not None else drawn_acquisition(swath, sensors), _targets(boards)
    traditional, by_kind = traditional_rows(scene, swath, sensors, targets, budget_s)
    papers = published_rows() if any(target.name == PAPER_TARGET for target in targets) else []
    # of one configuration the swath's rows stand beside the rivals'
    size = f"{swath.width_px} x {swath.height_px} pixels in tiles of {swath.tile_px}"
    rows = [*(found.rows if single else []), *traditional, *papers]
    kinds = (f"traditional pipeline by kind of work, one core here and of {targets[0].name}", by_kind)
    layers = [*found.layers, kinds]
    apart = [row for _, part in (*found.shown, *layers, *refitted) for row in part]
    return BoardBench([*rows, *apart], [*refitted, *found.shown, (size, rows)], found.notes, layers)


def _single(model: Path, dpu: Dpu, swath: Swath, task: Task | None) -> BoardBench:
    """The rows of the swath, and its layers."""
    prediction = predict_file(model, dpu, swath.tile_px, task)
    rows, notes = predicted_rows(model.stem, prediction, swath, dpu), host_words(prediction, dpu)
    return BoardBench(rows, [], notes, [_layers(model, prediction, dpu)])


def _layers(model: Path, prediction: Prediction, dpu: Dpu) -> tuple[str, list[Row]]:
    return f"{model.name}, one batch on {dpu.target.name} {dpu.name}; {TRAFFIC}", layer_rows(prediction, dpu)


def _sweep(model: Path, boards: Sequence[Dpu], request: BoardRequest, swath: Swath) -> BoardBench:
    """A row for each configuration and tile size, and which of them meet the time asked for."""
    rows = sweep_rows(model, swath, boards, request.tiles_px, request.host_task)
    size = f"{swath.width_px} x {swath.height_px} pixels"
    notes = [] if request.within_s is None else [within_words(rows, boards, request.within_s)]
    return BoardBench(rows, [(f"{model.name}, {size} in whole tiles, halo {swath.halo_px} px", rows)], notes)


def _frames(
    model: Path,
    network: onnx.ModelProto,
    boards: Sequence[Dpu],
    refitted: list[tuple[str, list[Row]]],
    why: ModelError,
    task: Task | None,
) -> BoardBench:
    """The network on whole images; of one configuration each layer too."""
    tile_px = None if own_tile_px(network) else FREE_TILE_PX
    predictions = [predict_file(model, dpu, tile_px, task) for dpu in boards]
    rows = [frame_row(prediction, dpu) for prediction, dpu in zip(predictions, boards, strict=True)]
    size = " x ".join(
        str(side.dim_value or tile_px) for side in network.graph.input[0].type.tensor_type.shape.dim[2:]
    )
    shown = [*refitted, (f"{model.name}, frames of {size}", rows)]
    layers = [_layers(model, predictions[0], boards[0])] if len(boards) == 1 else []
    whole = f"not tiled, but run on whole images: expected {why.expected}, got {why.got}"
    said = [words for found, dpu in zip(predictions, boards, strict=True) for words in host_words(found, dpu)]
    notes = [whole, *dict.fromkeys(said)]
    return BoardBench([row for _, part in (*shown, *layers) for row in part], shown, notes, layers)


def _untiled(network: onnx.ModelProto, request: BoardRequest) -> ModelError | None:
    """Why a network cannot be tiled, None where it can.

    Raises:
        ModelError: it cannot, and a swath was asked for.
    """
    try:
        tiling_of(network)
    except ModelError as error:
        if request.image or request.size or request.within_s is not None:
            raise
        return error
    return None


def _boards(request: BoardRequest) -> tuple[list[Dpu], list[tuple[str, list[Row]]]]:
    """The configurations asked for; their constants refitted where runs are given, and the tables that say so."""
    if request.target == ALL:
        _require_all(request)
        names = board_names()
    else:
        names = [request.target]
    targets = map(load_target, names)
    boards = [dpu_of(target, config) for target in targets for config in _configurations(target, request.config)]
    if request.measured is None:
        return boards, []
    found = refit(request.measured, boards[0])
    shown = [(found.source, found.constant_rows()), ("your runs", found.run_rows())]
    return [found.applied(dpu) for dpu in boards], shown


def _configurations(target: TargetProfile, config: str | None) -> list[str | None]:
    return list(target.configurations) if config == ALL else [config]


def _require_all(request: BoardRequest) -> None:
    if request.config not in (None, ALL):
        expected, remedy = "'all' or none beside --target all", "leave it out, or name the board"
        raise OptionError("--config", expected=expected, got=repr(request.config), remedy=remedy)
    if request.measured is not None:
        expected, remedy = "one board beside --measured", "name the board that the runs are of"
        raise OptionError("--target", expected=expected, got=repr(request.target), remedy=remedy)


def _targets(boards: Sequence[Dpu]) -> list[TargetProfile]:
    """The boards, each once."""
    return list({dpu.target.name: dpu.target for dpu in boards}.values())


def _swath(network: onnx.ModelProto, shape: tuple[int, ...] | None, request: BoardRequest) -> Swath:
    width_px, height_px = (shape[1], shape[0]) if shape else parse_size(request.size or PAPER_SIZE)
    radius_px = receptive_radius_px(network) if request.halo == "exact" else 0
    return Swath(width_px, height_px, request.tiles_px[0], parse_halo(request.halo, radius_px))
