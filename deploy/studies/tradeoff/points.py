"""Operating points: which networks are compared, and in which tiles, halos and configurations.

A variant is a method in one precision, measured once. A point is a variant where it runs: an INT8 network on one
configuration of a board's DPU, in tiles with a halo; a traditional pipeline on a board's processor; or anything on
this machine alone.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import onnx

from beers_deploy.bench.tables import PAPER_TILE_PX, Swath, swath_latency
from beers_deploy.dpu.board import Dpu, dpu_of
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.latency import Prediction, predict
from beers_deploy.dpu.graph import Network
from beers_deploy.dpu.reading import network_of
from beers_deploy.export import float_model
from beers_deploy.model.shipped import shipped_names
from beers_deploy.network import float_file, int8_file
from beers_deploy.profiles import TargetProfile
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, board_names
from beers_deploy.quant.onnx_file import is_quantised, load_onnx
from beers_deploy.quant.tiling.walk import Tiling, tiling_of

FLOAT, INT8 = "float32", "INT8"
FLOAT_ON_DPU = "the DPU takes INT8 alone"

TILE_STEP_PX, HALO_STEP_PX = 16, 8
"""Tiles and halos that are tried are multiples of these."""
HALOS_PX = (0, HALO_STEP_PX, 2 * HALO_STEP_PX)
"""Halos below the exact one that are tried."""


@dataclass(frozen=True)
class Variant:
    """A method in one precision.

    Attributes:
        method: its name without the precision.
        precision: float32 or INT8.
        source: what `deploy.studies.evaluation.methods.method_named` takes: a name, or the file of a network.
        file: the network's file; None of a method without a network.
    """

    method: str
    precision: str
    source: str
    file: Path | None = None

    @property
    def name(self) -> str:
        """The name in tables."""
        return f"{self.method} {self.precision}" if self.file else self.method


@dataclass(frozen=True)
class Point:
    """A variant where it runs.

    Attributes:
        variant: what restores.
        board: the target, None for this machine alone.
        dpu: the configuration of the board's DPU; None for its processor.
        tile_px: side of a tile.
        halo_px: context around a tile; None for the receptive radius, whose seams are exact.
        reason: why there are no figures of a board.
    """

    variant: Variant
    board: TargetProfile | None = None
    dpu: Dpu | None = None
    tile_px: int = PAPER_TILE_PX
    halo_px: int | None = None
    reason: str = ""

    @property
    def name(self) -> str:
        """The name in tables: the variant, and where it runs."""
        if self.board is None:
            return self.variant.name
        if self.dpu is None:
            return f"{self.variant.name}, processor of {self.board.name}"
        halo = "exact" if self.halo_px is None else self.halo_px
        return f"{self.variant.name}, {self.board.name} {self.dpu.name}, tile {self.tile_px}, halo {halo}"

    def swath(self, whole: Swath) -> Swath:
        """The swath as this point cuts it."""
        halo_px = radius_px(self.variant) if self.halo_px is None else self.halo_px
        return replace(whole, tile_px=self.tile_px, halo_px=halo_px)


def parse_targets(text: str) -> tuple[str, ...]:
    """The boards of `--target`: one, several with commas, or all of the shipped ones, the default first."""
    if text == "all":
        return DEFAULT_TARGET, *(name for name in board_names() if name != DEFAULT_TARGET)
    names = tuple(name.strip() for name in text.split(","))
    if not all(names) or len(set(names)) < len(names):
        remedy = "write vck190, or vck190,zcu102, or all"
        raise OptionError("target", expected="boards, each once", got=repr(text), remedy=remedy)
    return names


def network_variants(
    names: Iterable[str], sensor: Sensor, make_int8: Callable[[Path], Path], log: Callable[[str], None]
) -> list[Variant]:
    """Networks in float32 and INT8; shipped ones with the sensor's profile, INT8 files as they are.

    Args:
        names: shipped names, ONNX and safetensors files.
        sensor: that acquires the images.
        make_int8: quantises a float network's file, and says where it wrote the result.
        log: is told which network has no INT8, and what of the sensor lies outside the range that was trained.
    """
    different = dict.fromkeys(each.strip() for each in names)
    found = [variant for name in different for variant in _variants(name, sensor, make_int8, log)]
    shown = [variant.name for variant in found]
    if len(set(shown)) < len(shown):
        twice = max(shown, key=shown.count)
        raise OptionError("network", expected="names that differ", got=f"two {twice!r}", remedy="rename one file")
    return found


def _variants(
    name: str, sensor: Sensor, make_int8: Callable[[Path], Path], log: Callable[[str], None]
) -> Iterator[Variant]:
    path = Path(name)
    if name not in shipped_names() and path.suffix not in (".onnx", ".safetensors"):
        expected = f"a shipped network ({', '.join(shipped_names())}), or an ONNX or safetensors file"
        raise OptionError("network", expected=expected, got=repr(name), remedy="correct that name")
    given = float_file(path, sensor, log)
    model, method = float_model(given), name if name in shipped_names() else path.stem
    _require_tiles(name, tiling_of(model))
    if is_quantised(model):
        yield Variant(method, INT8, str(given), given)
        return
    yield Variant(method, FLOAT, str(given), given)
    try:
        made = int8_file(path, sensor) if name in shipped_names() else make_int8(given)
    except ModelError as error:
        log(f"{name} is compared in float32 alone: {error}")
        return
    yield Variant(method, INT8, str(made), made)


def _require_tiles(name: str, tiling: Tiling) -> None:
    """Refuse a network that does not take one band in tiles of any multiple of the steps."""
    plain = replace(tiling, lattice_px=1, least_px=1, fixed_px=None) == Tiling(tiling.halo_px)
    if tiling.fixed_px is not None or not plain or HALO_STEP_PX % tiling.lattice_px:
        fixed = ", fixed to one tile size" if tiling.fixed_px is not None else ""
        expected = f"a network of one band in tiles of any multiple of {HALO_STEP_PX} px"
        remedy = "export it with free sizes, or bench it by itself"
        raise OptionError("network", expected=expected, got=f"{name}, {tiling.words}{fixed}", remedy=remedy)


def network_points(variant: Variant, boards: Sequence[TargetProfile], whole: Swath) -> list[Point]:
    """Where a network is looked at: in INT8 on each configuration of the boards, on the first in more tiles too.

    Args:
        variant: the network.
        boards: targets with a DPU.
        whole: the swath.
    """
    if variant.precision == FLOAT:
        return [Point(variant, reason=FLOAT_ON_DPU)]
    found = []
    for board in boards:
        try:
            found += _on_board(variant, board, whole, more=board is boards[0])
        except ModelError as error:
            found.append(Point(variant, reason=f"{board.name}: {str(error).rstrip('.')}"))
    return found


def _on_board(variant: Variant, board: TargetProfile, whole: Swath, *, more: bool) -> list[Point]:
    """The fastest tile on each configuration; on the default one the paper's tile and smaller halos too."""
    default, *others = configurations(board)
    fastest_px = fastest_tile_px(variant, default, whole)
    points = [Point(variant, board, dpu, fastest_px) for dpu in (default, *others)]
    if more:
        points.append(Point(variant, board, default, PAPER_TILE_PX))
        smaller = (halo for halo in HALOS_PX if halo < radius_px(variant))
        points += [Point(variant, board, default, fastest_px, halo) for halo in smaller]
    return list({point.name: point for point in points}.values())


def configurations(board: TargetProfile) -> list[Dpu]:
    """Those of a board, the default one first."""
    default = dpu_of(board)
    return [default, *(dpu_of(board, name) for name in board.configurations if name != default.name)]


def fastest_tile_px(variant: Variant, dpu: Dpu, whole: Swath) -> int:
    """The tile with exact seams, no larger than the paper's, in which the swath is predicted to take least time."""
    radius = radius_px(variant)
    sides = range(TILE_STEP_PX * (2 * radius // TILE_STEP_PX + 1), PAPER_TILE_PX + 1, TILE_STEP_PX)

    def latency_s(side_px: int) -> float:
        swath, prediction = replace(whole, tile_px=side_px, halo_px=radius), predict_tile(variant, side_px, dpu)
        return swath_latency(prediction, math.ceil(swath.tiles / prediction.batch)).value or math.inf

    return min(sides, key=latency_s, default=PAPER_TILE_PX)


def predict_tile(variant: Variant, tile_px: int, dpu: Dpu) -> Prediction:
    """What the cost model says of an INT8 network in such tiles."""
    return predict(place(_graph(variant.file or Path(), tile_px), dpu), dpu)


def radius_px(variant: Variant) -> int:
    """The halo that makes the seams of a network exact."""
    return tiling_of_file(variant.file or Path()).halo_px


@cache
def tiling_of_file(file: Path) -> Tiling:
    """How an image may be cut into tiles for the network of an ONNX file."""
    return tiling_of(model_of(file))


@cache
def model_of(file: Path) -> onnx.ModelProto:
    """The network of an ONNX file."""
    return load_onnx(file)


@cache
def _graph(file: Path, tile_px: int) -> Network:
    return network_of(model_of(file), tile_px)
