"""Which points a study looks at: those of `points`, for the networks at hand and the tiles that suit the board."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace

import onnx

from deploy.bench import PAPER_TILE_PX, Swath, swath_latency
from deploy.dpu.board import Dpu, load_dpu
from deploy.tradeoff.board import kept_tiles_px, predict_model
from deploy.tradeoff.networks import Network, conv_weights
from deploy.tradeoff.points import LEGAL, PRECISIONS, STEP_PX, Board, Point, network_points, other_points, tiles_px
from deploy.tradeoff.shelf import Shelf
from model.traditional.peers import PEERS
from model.traditional.settings import QUALITIES
from profiles.errors import ModelError
from quant.onnx_file import load_onnx
from quant.radius import receptive_radius_px


def select_points(shelf: Shelf, swath: Swath) -> list[Point]:
    """Networks in the order given, then chains, then library peers."""
    points = [
        point
        for network in shelf.networks.values()
        for point in network_points(network.name, precisions_of(network), board_of(network, swath))
    ]
    return points + other_points([f"traditional-{quality}" for quality in QUALITIES], PEERS)


def precisions_of(network: Network) -> Sequence[str]:
    """Those that a network can be had in: a file that is INT8 already is taken as it is."""
    return PRECISIONS if network.float_file else (network.given,)


def board_of(network: Network, swath: Swath) -> Board:
    """Its tiles and configurations worth a look, from the cost model."""
    model = load_onnx(network.int8_file) if network.int8_file and network.given == LEGAL else network.model()
    dpu, radius_px = load_dpu(), receptive_radius_px(model)

    def seconds(side_px: int) -> float:
        return latency_s(model, dpu, replace(swath, tile_px=side_px, halo_px=radius_px))

    try:
        found = kept_tiles_px(model, dpu, STEP_PX, PAPER_TILE_PX)
    except ModelError:
        return Board(radius_px, None, PAPER_TILE_PX, (dpu.name,))
    kept_px = min((side for side in found if side > 2 * radius_px), key=seconds, default=None)
    fastest_px = min(tiles_px(kept_px, radius_px), key=seconds)
    return Board(radius_px, kept_px, fastest_px, configurations_for(model, dpu))


def latency_s(model: onnx.ModelProto, dpu: Dpu, swath: Swath) -> float:
    """Predicted time of a swath."""
    prediction = predict_model(model, dpu, swath.tile_px)
    return swath_latency(prediction, math.ceil(swath.tiles / prediction.batch)).value or math.inf


def configurations_for(model: onnx.ModelProto, default: Dpu) -> list[str]:
    """The default one; of each width of engine the smallest and the largest, the wide only where most layers are."""
    names = list(default.target.configurations)
    boards = [load_dpu(default.target.name, name) for name in names]
    usual = statistics.median(shape[0] for shape in conv_weights(model))
    fitting = [dpu for dpu in boards if dpu.output_parallel <= max(usual, default.output_parallel)]
    ends = []
    for width in sorted({dpu.output_parallel for dpu in fitting}):
        alike = sorted((dpu for dpu in fitting if dpu.output_parallel == width), key=lambda dpu: dpu.batch)
        ends += [alike[0].name, alike[-1].name]
    return list(dict.fromkeys([default.name, *ends]))
