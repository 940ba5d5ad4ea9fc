"""A swath on the DPU, predicted, beside the traditional pipeline measured here and the paper's figures.

One configuration and one tile size show every layer; several are swept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.bench.host import Sensors, drawn_acquisition, traditional_rows
from deploy.bench.tables import (
    PAPER_SIZE,
    Swath,
    layer_rows,
    parse_size,
    predict_file,
    predicted_rows,
    published_rows,
    sweep_rows,
)
from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.cost.runs import refit
from deploy.restoration.options import parse_halo
from model.io.images import read_acquisition
from model.shipped import SENSOR
from profiles import load_target
from profiles.figures import Row
from profiles.sensor_file import REFERENCE, load_sensor
from quant.onnx_file import load_onnx
from quant.tiling.walk import receptive_radius_px

TRAFFIC = "LdFM, StFM: feature maps loaded and stored, an image; LdWB: weights and biases loaded, a batch."


@dataclass(frozen=True)
class BoardRequest:
    """What a user wants to know of the board.

    Attributes:
        image: the swath; None for a drawn one of `size`.
        full_scale: the image's pixel value that is full scale; None lets its type and values decide.
        size: WIDTHxHEIGHT in pixels; None for the paper's.
        tiles_px: tile sides.
        halo: "exact" or a number of pixels.
        config: the DPU's configuration, "all", or None for the target's own.
        measured: runs of the user's board, to which the cost model is refitted.
    """

    image: Path | None
    full_scale: float | None
    size: str | None
    tiles_px: Sequence[int]
    halo: str
    config: str | None
    measured: Path | None


@dataclass(frozen=True)
class BoardBench:
    """What was found: all rows, the tables to show in their order, and sentences to say with them."""

    rows: list[Row]
    shown: list[tuple[str, list[Row]]]
    notes: list[str]


def bench_board(model: Path, request: BoardRequest, budget_s: float) -> BoardBench:
    """Predict a network's swath on the DPU, and measure the traditional pipeline on this processor.

    Args:
        model: ONNX file.
        request: the swath and the configurations.
        budget_s: seconds that the pipeline may take to be run on the whole image rather than on parts of it.

    Raises:
        BeersError: a file or an option that is not what it should be.
    """
    sensors = Sensors(load_sensor(SENSOR), load_sensor(REFERENCE))
    dn = read_acquisition(request.image, request.full_scale, None) if request.image else None
    swath = _swath(model, dn.shape if dn is not None else None, request)
    boards, refitted = _boards(request)
    single = len(boards) == len(request.tiles_px) == 1
    found = _single(model, boards[0], swath) if single else _sweep(model, boards, request.tiles_px, swath)
    scene = dn if dn is not None else drawn_acquisition(swath, sensors)
    traditional, by_kind = traditional_rows(scene, swath, sensors, boards[0].target, budget_s)
    # of one configuration the swath's rows stand beside the rivals', and its layers apart
    size = f"{swath.width_px} x {swath.height_px} pixels in tiles of {swath.tile_px}"
    rows = [*(found.rows if single else []), *traditional, *published_rows()]
    kinds = (f"traditional pipeline by kind of work, one core here and of {boards[0].target.name}", by_kind)
    apart = [row for _, part in (*found.shown, kinds, *refitted) for row in part]
    return BoardBench([*rows, *apart], [*refitted, *found.shown, kinds, (size, rows)], found.notes)


def _single(model: Path, dpu: Dpu, swath: Swath) -> BoardBench:
    """The rows of the swath, and those of the layers to show."""
    prediction = predict_file(model, dpu, swath.tile_px)
    notes = [TRAFFIC, *([prediction.note] if prediction.note else [])]
    layers = (f"{model.name}, one batch on {dpu.name}", layer_rows(prediction, dpu))
    return BoardBench(predicted_rows(model.stem, prediction, swath, dpu), [layers], notes)


def _sweep(model: Path, boards: Sequence[Dpu], tiles_px: Sequence[int], swath: Swath) -> BoardBench:
    """A row for each configuration and tile size."""
    rows = sweep_rows(model, swath, boards, tiles_px)
    size = f"{swath.width_px} x {swath.height_px} pixels"
    return BoardBench(rows, [(f"{model.name}, {size} in whole tiles, halo {swath.halo_px} px", rows)], [])


def _boards(request: BoardRequest) -> tuple[list[Dpu], list[tuple[str, list[Row]]]]:
    """The configurations asked for; their constants refitted where runs are given, and the tables that say so."""
    names = list(load_target("vck190").configurations) if request.config == "all" else [request.config]
    boards = [load_dpu("vck190", name) for name in names]
    if request.measured is None:
        return boards, []
    found = refit(request.measured, boards[0])
    shown = [(found.source, found.constant_rows()), ("your runs", found.run_rows())]
    return [found.applied(dpu) for dpu in boards], shown


def _swath(model: Path, shape: tuple[int, ...] | None, request: BoardRequest) -> Swath:
    width_px, height_px = (shape[1], shape[0]) if shape else parse_size(request.size or PAPER_SIZE)
    radius_px = receptive_radius_px(load_onnx(model)) if request.halo == "exact" else 0
    return Swath(width_px, height_px, request.tiles_px[0], parse_halo(request.halo, radius_px))
