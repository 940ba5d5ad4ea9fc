"""Operating points: the networks that are compared, their tiles, halos and configurations, and the
time on a board.

A variant is a method in one precision, measured once. A point is a variant on one device: an INT8
network on one configuration of a board's DPU, in tiles with a halo; a traditional pipeline on a
board's processor; or any variant on this machine alone.
"""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path

from beers_deploy.conditioned_file import to_run_on
from beers_deploy.dpu.board import Dpu, dpu_of
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.latency import dpu_power, predict
from beers_deploy.dpu.graph import SizedGraph
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.model.shipped import shipped_names
from beers_deploy.network import Network, NetworkLike
from beers_deploy.performance import tables
from beers_deploy.performance.swath import (
    Swath,
    efficiency,
    energy,
    float_work,
    pipeline_rate,
    swath_latency,
)
from beers_deploy.profiles.errors import ModelError, OptionError, printable
from beers_deploy.profiles.figures import Figure, predicted, unavailable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.tiling.receptive_field import Tiling

logger = logging.getLogger(__name__)

FLOAT = "float32"
INT8 = "INT8"
FLOAT_ON_DPU = "the DPU takes INT8 alone"

TILE_STEP_PX = 16
HALO_STEP_PX = 8
"""The tiles and halos that are tried are multiples of these."""
HALOS_PX = (0, HALO_STEP_PX, 2 * HALO_STEP_PX)
"""The halos below the exact one that are tried."""


@dataclass(frozen=True)
class Variant:
    """A method in one precision, whose quality is measured once for all devices.

    Attributes:
        method: the name of the method without the precision.
        precision: "float32" or "INT8".
        network: the network in this precision; None for a method without a network.
    """

    method: str
    precision: str = FLOAT
    network: Network | None = None

    @property
    def name(self) -> str:
        """The name in tables: the method, and the precision of a network."""
        return f"{self.method} {self.precision}" if self.network else self.method


@dataclass(frozen=True)
class Point:
    """An operating point: a method in one precision on one device, in tiles of one size.

    Attributes:
        variant: the method and its precision.
        board: the board that runs the method; None if it is measured on this machine alone.
        dpu: the configuration of the board's DPU; None if the board's processor runs the method.
        tile_px: the side of a tile.
        halo_px: the context that is read around the retained part of a tile; None for the network's
            receptive radius, with which seams are exact.
        reason: the reason why there are no figures of a board; empty if there are some.
        refused_by: the name of the board whose DPU cannot run the network, as `reason` states;
            empty if no board refused it.
    """

    variant: Variant
    board: TargetProfile | None = None
    dpu: Dpu | None = None
    tile_px: int = TILE_PX
    halo_px: int | None = None
    reason: str = ""
    refused_by: str = ""

    @property
    def name(self) -> str:
        """The name in tables: the variant and its device."""
        if self.board is None:
            return self.variant.name
        if self.dpu is None:
            return f"{self.variant.name}, processor of {self.board.name}"
        halo = "exact" if self.halo_px is None else self.halo_px
        return (
            f"{self.variant.name}, {self.board.name} {self.dpu.name}, tile {self.tile_px}, "
            f"halo {halo}"
        )


def network_variants(
    networks: Iterable[NetworkLike],
    sensor: Sensor,
    make_int8: Callable[[Network], Network],
) -> list[Variant]:
    """Load the networks that a study compares, each in float32 and in INT8.

    Shipped networks are conditioned on the sensor. A file in INT8 is compared in INT8 alone, and a
    float network that cannot be quantised in float32 alone.

    Args:
        networks: shipped names, ONNX and safetensors files, or networks in memory.
        sensor: the sensor that acquires the images.
        make_int8: returns the INT8 network of a float one.

    Raises:
        OptionError: two networks have one name, a name is unknown, or a network does not restore
            one band in tiles of any size.
    """
    each = (_variants(network, sensor, make_int8) for network in networks)
    variants = list(chain.from_iterable(each))
    names = [variant.name for variant in variants]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise OptionError(
            f"The names of the networks in `network` must differ, but two are named {twice!r}. "
            "Rename one file."
        )
    return variants


def _variants(
    source: NetworkLike, sensor: Sensor, make_int8: Callable[[Network], Network]
) -> Iterator[Variant]:
    is_shipped = source in shipped_names()
    is_file = not isinstance(source, str) or Path(source).suffix in (".onnx", ".safetensors")
    if not is_shipped and not is_file:
        raise OptionError(
            f"`network` must be a shipped network ({', '.join(shipped_names())}), or an ONNX or "
            f"safetensors file, but it is {printable(repr(source))}."
        )
    network = to_run_on(Network.load(source, sensor=sensor), sensor)
    tiling = network.tiling
    plain = replace(tiling, alignment_px=1, min_side_px=1, fixed_px=None) == Tiling(tiling.halo_px)
    if tiling.fixed_px is not None or not plain or HALO_STEP_PX % tiling.alignment_px:
        fixed = ", fixed to one tile size" if tiling.fixed_px is not None else ""
        raise OptionError(
            f"`network` must restore one band in tiles of any multiple of {HALO_STEP_PX} px, but "
            f"{network.label} is a network {tiling.words}{fixed}. Export it with free sizes, or "
            "bench it by itself."
        )
    if network.precision == "int8":
        yield Variant(network.name, INT8, network)
        return
    yield Variant(network.name, FLOAT, network)
    if is_shipped:
        yield Variant(network.name, INT8, Network.load(source, sensor=sensor, int8=True))
        return
    try:
        int8 = make_int8(network)
    except ModelError as error:
        logger.warning("%s is compared in float32 alone: %s", network.label, error)
        return
    yield Variant(network.name, INT8, int8)


def network_points(variant: Variant, boards: Sequence[TargetProfile], whole: Swath) -> list[Point]:
    """Return the operating points of one network.

    In INT8 there is a point for each configuration of every board's DPU, with the fastest tile. The
    default configuration also has points with another tile and with smaller halos. In float32
    there is one point on this machine. A board that refuses the network has one point with the
    reason.

    Args:
        variant: the network in one precision.
        boards: the boards, all of which are treated in the same way.
        whole: the swath (the large image) whose time is predicted.
    """
    if variant.precision == FLOAT:
        return [Point(variant, reason=FLOAT_ON_DPU)]
    points = list[Point]()
    for board in boards:
        default = dpu_of(board)
        others = [dpu_of(board, name) for name in board.configurations if name != default.name]
        try:
            fastest_px = fastest_tile_px(variant, default, whole)
            smaller = [halo for halo in HALOS_PX if halo < exact_halo_px(variant)]
            here = [
                *(Point(variant, board, dpu, fastest_px) for dpu in (default, *others)),
                Point(variant, board, default, TILE_PX),
                *(Point(variant, board, default, fastest_px, halo) for halo in smaller),
            ]
            # The fastest tile may be the paper's: a point is listed once.
            points += {point.name: point for point in here}.values()
        except ModelError as error:
            # A board that refuses the network stays in the study, with the reason.
            reason = f"{board.name}: {str(error).rstrip('.')}"
            points.append(Point(variant, reason=reason, refused_by=board.name))
    return points


def fastest_tile_px(variant: Variant, dpu: Dpu, whole: Swath) -> int:
    """Return the side in pixels of the tile with the shortest predicted time for a swath.

    Tiles have the halo with which seams are exact, and are at most as large as the paper's.

    Args:
        variant: an INT8 network.
        dpu: the configuration of the DPU that runs the network.
        whole: the swath (the large image).
    """
    radius = exact_halo_px(variant)
    # A tile has to be wider than its two halos.
    sides = range(TILE_STEP_PX * (2 * radius // TILE_STEP_PX + 1), TILE_PX + 1, TILE_STEP_PX)
    swaths = [
        replace(whole, tile_px=side_px, halo_px=radius, consistency=True) for side_px in sides
    ]
    times = {swath.tile_px: dpu_latency(variant, dpu, swath).value or math.inf for swath in swaths}
    return min(times, key=lambda side_px: times[side_px], default=TILE_PX)


def dpu_latency(variant: Variant, dpu: Dpu, swath: Swath) -> Figure:
    """Predict the seconds that a board needs for a swath, by the DPU's cost model.

    Args:
        variant: an INT8 network.
        dpu: the configuration of the DPU that runs the network.
        swath: the large image, with the size and halo of its tiles. Whole tiles are counted.
    """
    network = network_of_variant(variant)
    placement = place(_graph(network, swath.tile_px), dpu)
    floats = float_work(network)
    prediction = predict(placement, dpu, step_px=swath.step_px, float_work=floats)
    return swath_latency(prediction, math.ceil(swath.tiles * swath.runs / prediction.batch))


def exact_halo_px(variant: Variant) -> int:
    """Return the smallest halo in pixels with which the tiles of a variant's network have exact
    seams: the network's receptive radius.
    """
    return network_of_variant(variant).tiling.halo_px


def network_of_variant(variant: Variant) -> Network:
    """Return the network of a variant. Call this only for a variant that has one."""
    return Network.load(variant.network)


@cache
def _graph(network: Network, tile_px: int) -> SizedGraph:
    return sized_graph(network.model, tile_px, network.label)


UNITS: dict[str, str] = {
    "board latency": "s",
    "board throughput": "frame/s",
    "board power": "W",
    "board energy": "J",
    "board efficiency": "px/s/W",
}
"""The figures of a point on its board, with their units."""
STANDARD = "traditional-standard"
"""The pipeline whose time on a board's processor a target states."""


def board_figures(
    point: Point, whole: Swath, slower: float | None = None, runs: float = 1.0
) -> dict[str, Figure]:
    """Predict the figures of an operating point on its board for a swath.

    Args:
        point: the operating point: a network on a DPU, a traditional pipeline on the board's
            processor, or a method on this machine alone.
        whole: the swath (the large image).
        slower: the time of a traditional pipeline over that of `STANDARD`, measured on this
            machine; None if it is not known.
        runs: the mean number of runs of the network on a tile of the measured images, one for each
            exposure.

    Returns:
        The figures of `UNITS` by name. They are unavailable, with the reason, for a point without a
        board or a stated time.
    """
    if point.dpu is not None:
        halo_px = exact_halo_px(point.variant) if point.halo_px is None else point.halo_px
        swath = replace(whole, tile_px=point.tile_px, halo_px=halo_px, runs=runs, consistency=True)
        latency = dpu_latency(point.variant, point.dpu, swath)
        power = dpu_power(point.dpu)
    elif point.board is not None and slower is not None:
        row = tables.processor_row(whole, point.board)
        latency = row.figures["latency"]
        power = row.figures["power"]
        if latency.value is not None and latency.interval is not None:
            # A board's file states the standard quality alone; times here scale the others.
            low_s, high_s = (end * slower for end in latency.interval)
            source = f"{latency.source}; times of the pipelines here: {slower:.2f} of {STANDARD}"
            latency = predicted(latency.value * slower, "s", (low_s, high_s), source)
    else:
        latency = unavailable(
            "s", point.reason or "no time of this method on the board's processor is stated"
        )
    if latency.value is None:
        return {key: unavailable(unit, latency.reason) for key, unit in UNITS.items()}
    work = energy(latency, power), efficiency(whole.pixels, latency, power)
    return dict(zip(UNITS, (latency, pipeline_rate(whole, latency), power, *work), strict=True))
