"""Which points a study looks at: those of `points`, for the networks at hand and the tiles that suit the board."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import onnx

from deploy.bench.tables import PAPER_TILE_PX, Swath, swath_latency
from deploy.dpu.board import Dpu, dpu_of
from deploy.tradeoff.board import CHAIN, kept_tiles_px, predict_model
from deploy.tradeoff.detection import Request as DetectionRequest
from deploy.tradeoff.methods import OWN, MethodStore, Network, conv_weights
from deploy.tradeoff.outcome import DPU_ONLY
from deploy.tradeoff.points import (
    LEGAL,
    PRECISIONS,
    STEP_PX,
    Board,
    Demand,
    Point,
    Variant,
    network_points,
    other_points,
    tiles_px,
)
from model.io.images import list_images
from model.metrics.backbones import find_backbone
from model.traditional.peers import PEERS
from model.traditional.settings import QUALITIES
from profiles import TargetProfile
from profiles.errors import ModelError, OptionError
from profiles.sensor import SensorProfile
from profiles.sensor_file import load_sensor, reference_for
from profiles.target import DEFAULT_TARGET
from quant.onnx_file import load_onnx
from quant.tiling.walk import receptive_radius_px


def select_points(store: MethodStore, swath: Swath, target: TargetProfile) -> list[Point]:
    """Networks in the order given, then chains, then library peers."""
    points = [
        point
        for network in store.networks.values()
        for point in network_points(network.name, precisions_of(network), board_of(network, swath, target))
    ]
    return points + other_points([CHAIN + quality for quality in QUALITIES], PEERS)


def require_on_dpu(store: MethodStore, names: Sequence[str], target: TargetProfile) -> None:
    """Refuse a user's network that the board's DPU does not run whole in INT8 with scales that are powers of two.

    Raises:
        OptionError: such a network, with the reason.
    """
    for path in map(Path, names):
        network = store.networks[path.stem]
        lacks = store.lack(Variant(network.name, "network", LEGAL)) if network.float_file else _not_legal(network)
        try:
            if not lacks:
                predict_model(network.model(), dpu_of(target), PAPER_TILE_PX)
        except ModelError as error:
            lacks = str(error).rstrip(".")
        if lacks:
            expected, got = f"a network that the DPU of {target.name} runs", f"{path.name}: {lacks}"
            remedy = "change it as 'check' says, or leave it out"
            raise OptionError(OWN, expected=expected, got=got, remedy=remedy)


def _not_legal(network: Network) -> str:
    return "" if network.given == LEGAL else f"{network.given}, and {DPU_ONLY}"


def require_method(points: Sequence[Point], name: str | None) -> None:
    """Refuse to hold points against a method that the study does not have.

    Raises:
        OptionError: with the methods that it has.
    """
    known = list(dict.fromkeys(point.variant.method for point in points))
    if name is not None and name not in known:
        expected = f"a method of this study ({', '.join(known)})"
        raise OptionError("--against", expected=expected, got=repr(name), remedy="correct that name")


def precisions_of(network: Network) -> Sequence[str]:
    """Those that a network can be had in: a file that is INT8 already is taken as it is."""
    return PRECISIONS if network.float_file else (network.given,)


def board_of(network: Network, swath: Swath, target: TargetProfile) -> Board:
    """Its tiles and configurations worth a look, from the cost model."""
    model = load_onnx(network.int8_file) if network.int8_file and network.given == LEGAL else network.model()
    dpu, radius_px = dpu_of(target), receptive_radius_px(model)

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
    """Predicted time of a swath on the DPU, in s."""
    prediction = predict_model(model, dpu, swath.tile_px)
    return swath_latency(prediction, math.ceil(swath.tiles / prediction.batch)).value or math.inf


def configurations_for(model: onnx.ModelProto, default: Dpu) -> list[str]:
    """The default one; of each width of engine the smallest and the largest, the wide only where most layers are."""
    names = list(default.target.configurations)
    boards = [dpu_of(default.target, name) for name in names]
    usual = statistics.median(shape[0] for shape in conv_weights(model))
    fitting = [dpu for dpu in boards if dpu.output_parallel <= max(usual, default.output_parallel)]
    ends = []
    for width in sorted({dpu.output_parallel for dpu in fitting}):
        alike = sorted((dpu for dpu in fitting if dpu.output_parallel == width), key=lambda dpu: dpu.batch)
        ends += [alike[0].name, alike[-1].name]
    return list(dict.fromkeys([default.name, *ends]))


@dataclass(frozen=True)
class Request:
    """The options of `tradeoff`.

    Attributes:
        networks: shipped names and files, the user's own among them.
        images: folder of held-out scenes; drawn ones if None.
        calibration: folder of scenes that INT8 files are made on; drawn ones if None.
        sensor: profile of the degraded images.
        reference: profile of the reference images.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones.
        size_px: width and height of the swath.
        budget: limits within which the best picture is wanted.
        need: limits that are to be kept at the least cost.
        seed: of every random draw.
        target: the board.
        boards: all that the networks are to be compared on; empty for the board alone.
        detection: labelled images that a detector is to look at; None for none.
        own: those of the networks that must run on the board.
        against: the method that all are held against; the best chain if None.
    """

    networks: tuple[str, ...]
    images: Path | None
    calibration: Path | None
    sensor: str
    reference: str
    lpips: Path | None
    size_px: tuple[int, int]
    budget: tuple[Demand, ...] = ()
    need: tuple[Demand, ...] = ()
    seed: int = 0
    target: str = DEFAULT_TARGET
    boards: tuple[str, ...] = ()
    detection: DetectionRequest | None = None
    own: tuple[str, ...] = ()
    against: str | None = None

    @property
    def profiles(self) -> tuple[SensorProfile, SensorProfile]:
        """Of the degraded images and of the reference, this one in the digital numbers of the first."""
        degraded = load_sensor(self.sensor)
        return degraded, reference_for(degraded, self.reference)

    @property
    def backbone(self) -> Path | None:
        """The file of SqueezeNet's weights, where there is one."""
        return find_backbone("squeeze", self.lpips)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the figures rest on, besides shipped ones."""
        named = [path for path in map(Path, self.networks) if path.is_file()]
        folders = [folder for folder in (self.images, self.calibration) if folder]
        weights = [self.backbone] if self.backbone else []
        return (*named, *(path for folder in folders for path in list_images(folder)), *weights)
