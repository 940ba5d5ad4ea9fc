"""Operating points, and what a user can afford and needs of them: `latency<=20s`, `psnr>=44`, several with commas."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from deploy.bench.tables import PAPER_TILE_PX
from profiles.errors import OptionError
from profiles.figures import Figure

Kind = Literal["network", "chain", "peer", "paper"]
PRECISIONS = ("float32", "bf16", "INT8 free", "INT8 legal")
LEGAL, EXACT = "INT8 legal", "exact"
HALO_STEP_PX, STEP_PX = 8, 16
"""What halos and what tile sides are multiples of: so they fit every network whose lattice divides the former."""
HALOS_PX = (0, HALO_STEP_PX, 2 * HALO_STEP_PX)


@dataclass(frozen=True)
class Variant:
    """What is measured once and shared by several points: a method in one precision."""

    method: str
    kind: Kind
    precision: str

    def __str__(self) -> str:
        return f"{self.method} {self.precision}" if self.kind == "network" else self.method


@dataclass(frozen=True)
class Point:
    """One way to restore a swath; `halo` is 'exact' or pixels, `configuration` empty off the DPU."""

    variant: Variant
    tile_px: int = PAPER_TILE_PX
    halo: str = EXACT
    configuration: str = ""

    @property
    def name(self) -> str:
        """The name under which the point is listed: its variant, and where it runs on the DPU."""
        if not self.configuration:
            return str(self.variant)
        return f"{self.variant}, {self.configuration}, tile {self.tile_px}, halo {self.halo}"

    @property
    def spoken(self) -> str:
        """The name as it stands in a sentence."""
        variant, comma, where = self.name.partition(", ")
        return f"{variant} ({where})" if comma else variant

    def halo_px(self, radius_px: int) -> int:
        """In pixels, for a network that sees so far."""
        return radius_px if self.halo == EXACT else int(self.halo)


@dataclass(frozen=True)
class Board:
    """What decides where a network's tiles and configurations are worth a look.

    Attributes:
        radius_px: how far the network sees.
        kept_px: side of the tile to look at whose maps stay on chip; None where there is none, or no DPU.
        fastest_px: of the tiles looked at, the one fastest on the default configuration with exact seams.
        configurations: the default one first.
    """

    radius_px: int
    kept_px: int | None
    fastest_px: int
    configurations: Sequence[str]


def network_points(method: str, precisions: Iterable[str], board: Board) -> list[Point]:
    """Points of one network: each precision, and INT8 legal in the tiles, halos and configurations worth a look."""
    variants = [Variant(method, "network", precision) for precision in precisions]
    points = [
        point
        for variant in variants
        for point in (_on_the_dpu(variant, board) if on_dpu(variant) else [Point(variant)])
    ]
    return list(dict.fromkeys(points))


def on_dpu(variant: Variant) -> bool:
    """Whether its numbers are the DPU's."""
    return variant.kind == "network" and variant.precision == LEGAL


def tiles_px(kept_px: int | None, radius_px: int) -> list[int]:
    """Tile sides worth a look: the paper's, the one that stays on chip, and between."""
    if kept_px is None or kept_px <= 2 * radius_px or kept_px >= PAPER_TILE_PX:
        return [PAPER_TILE_PX]
    between = STEP_PX * round((kept_px * PAPER_TILE_PX) ** 0.5 / STEP_PX)
    return sorted({PAPER_TILE_PX, between, kept_px}, reverse=True)


def _on_the_dpu(variant: Variant, board: Board) -> list[Point]:
    default, *others = board.configurations
    tiles = tiles_px(board.kept_px, board.radius_px)
    points = [Point(variant, tile, EXACT, default) for tile in tiles]
    if board.radius_px > 0:
        points.append(Point(variant, PAPER_TILE_PX, "0", default))
    halos = [str(halo) for halo in HALOS_PX if halo < board.radius_px]
    points += [Point(variant, tiles[-1], halo, default) for halo in halos]
    return points + [Point(variant, board.fastest_px, EXACT, other) for other in others]


def other_points(chains: Iterable[str], peers: Iterable[str]) -> list[Point]:
    """The points that are no networks, in float32."""
    named = [(name, "chain") for name in chains] + [(name, "peer") for name in peers]
    return [Point(Variant(name, kind, "float32")) for name, kind in named]  # type: ignore[arg-type] # of a literal


NAMES = {
    "psnr": ("PSNR", "dB"),
    "ssim": ("SSIM", "ratio"),
    "lpips": ("LPIPS-squeeze", "distance"),
    "mtf": ("MTF at Nyquist", "%"),
    "snr": ("flat SNR", "ratio"),
    "mae": ("float-INT8 MAE", "ratio"),
    "host": ("host p50", "s/Mpx"),
    "host-p90": ("host p90", "s/Mpx"),
    "latency": ("board latency", "s"),
    "throughput": ("board throughput", "frame/s"),
    "power": ("board power", "W"),
    "energy": ("board energy", "J"),
    "efficiency": ("board efficiency", "px/s/W"),
}
"""What a user writes: the figure that it stands for, and its unit."""

MAP50 = "mAP50"
NAMES_LABELLED = {"psnr": NAMES["psnr"], "map50": (MAP50, "%"), **NAMES}
"""The same where labelled images are given."""

DEMAND = re.compile(
    r"(?P<name>[a-z0-9-]+)\s*(?P<side><=|>=)\s*(?P<limit>[+-]?\d+(\.\d+)?([eE][+-]?\d+)?)\s*(?P<unit>\S*)"
)


@dataclass(frozen=True)
class Demand:
    """One limit: the figure at most, or at least, so much."""

    key: str
    at_most: bool
    limit: float
    unit: str

    def __str__(self) -> str:
        unit = "" if self.unit in ("ratio", "distance") else f" {self.unit}"
        return f"{self.key} {'at most' if self.at_most else 'at least'} {self.limit:g}{unit}"

    def short_by(self, figure: Figure | None) -> float:
        """By what share of the limit a figure misses it; 0 where it keeps it, endless where it is unavailable."""
        if figure is None or figure.value is None:
            return math.inf
        miss = figure.value - self.limit if self.at_most else self.limit - figure.value
        return max(miss, 0.0) / (abs(self.limit) or 1.0)

    def kept_throughout(self, figure: Figure) -> bool:
        """Whether the whole interval keeps it."""
        low, high = figure.interval or (figure.value or 0.0,) * 2
        return high <= self.limit if self.at_most else low >= self.limit


def parse_demands(option: str, text: str | None) -> list[Demand]:
    """Read what a user demands, with commas between: `latency<=20s, psnr>=44`.

    Raises:
        OptionError: another text, an unknown name, or a unit that is not the figure's.
    """
    return [_parse(option, part.strip()) for part in text.split(",")] if text is not None else []


def _parse(option: str, text: str) -> Demand:
    found = DEMAND.fullmatch(text.lower())
    if found is None:
        expected, remedy = "NAME<=NUMBER or NAME>=NUMBER", "write 'latency<=20s' or 'psnr>=44'"
        raise OptionError(option, expected=expected, got=repr(text), remedy=remedy)
    if found["name"] not in NAMES_LABELLED:
        expected = f"one of {', '.join(NAMES_LABELLED)}"
        raise OptionError(option, expected=expected, got=repr(found["name"]), remedy="correct the name")
    key, unit = NAMES_LABELLED[found["name"]]
    if found["unit"] not in ("", unit.lower()):
        remedy = f"write {found['name']}{found['side']}{found['limit']}{unit}"
        raise OptionError(option, expected=f"{key} in {unit}", got=repr(found["unit"]), remedy=remedy)
    return Demand(key, found["side"] == "<=", float(found["limit"]), unit)


def shortfall(figures: Mapping[str, Figure], demands: Sequence[Demand]) -> float:
    """By what share of its limit a point misses the demand that it misses most; 0 where it keeps all."""
    return max((demand.short_by(figures.get(demand.key)) for demand in demands), default=0.0)
