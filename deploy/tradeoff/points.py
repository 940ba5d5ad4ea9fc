"""Operating points: which of the many ways to restore a swath are looked at, and why these.

Not the whole product of all choices: each is varied where it can matter.

- *Precision* (float32, bf16, INT8 free, INT8 legal): every network, in large tiles with exact seams. It sets the
  picture, and on the host the time.
- *Tile size*: INT8 legal of every network at 640, at the fastest of the tiles that are just small enough for maps to
  stay in the DPU's banks (found from the cost model), and halfway between, by ratio. It sets the board's time; with
  exact seams the picture is the same.
- *Halo* (0, 8, 16, exact): at the smallest of these tiles, where it costs most of the time, and 0 at 640, which is
  how the paper counts.
- *Configuration*: the smallest and the largest of the target beside its default, C64 only where most layers are wider
  than a C32 engine; at the tile that is fastest on the default one. It sets the board's time alone.
- *Chains and library peers*: each once; they have no tiles.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from deploy.bench import PAPER_TILE_PX

Kind = Literal["network", "chain", "peer", "paper"]
PRECISIONS = ("float32", "bf16", "INT8 free", "INT8 legal")
LEGAL, EXACT = "INT8 legal", "exact"
HALOS_PX = (0, 8, 16)
STEP_PX = 16
"""Tile sides are multiples of it."""


@dataclass(frozen=True)
class Unit:
    """What is measured once and shared by several points: a method in one precision."""

    method: str
    kind: Kind
    precision: str

    def __str__(self) -> str:
        return f"{self.method} {self.precision}" if self.kind == "network" else self.method


@dataclass(frozen=True)
class Point:
    """One way to restore a swath; `halo` is 'exact' or pixels, `configuration` empty off the DPU."""

    unit: Unit
    tile_px: int = PAPER_TILE_PX
    halo: str = EXACT
    configuration: str = ""

    @property
    def name(self) -> str:
        """What it is listed under."""
        if not self.configuration:
            return str(self.unit)
        return f"{self.unit}, {self.configuration}, tile {self.tile_px}, halo {self.halo}"

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
    """The points of one network."""
    units = [Unit(method, "network", precision) for precision in precisions]
    points = [point for unit in units for point in (_on_the_dpu(unit, board) if on_dpu(unit) else [Point(unit)])]
    return list(dict.fromkeys(points))


def on_dpu(unit: Unit) -> bool:
    """Whether its numbers are the DPU's."""
    return unit.kind == "network" and unit.precision == LEGAL


def tiles_px(kept_px: int | None, radius_px: int) -> list[int]:
    """Tile sides worth a look: the paper's, the one that stays on chip, and between."""
    if kept_px is None or kept_px <= 2 * radius_px or kept_px >= PAPER_TILE_PX:
        return [PAPER_TILE_PX]
    between = STEP_PX * round((kept_px * PAPER_TILE_PX) ** 0.5 / STEP_PX)
    return sorted({PAPER_TILE_PX, between, kept_px}, reverse=True)


def _on_the_dpu(unit: Unit, board: Board) -> list[Point]:
    default, *others = board.configurations
    tiles = tiles_px(board.kept_px, board.radius_px)
    points = [Point(unit, tile, EXACT, default) for tile in tiles]
    if board.radius_px > 0:
        points.append(Point(unit, PAPER_TILE_PX, "0", default))
    halos = [str(halo) for halo in HALOS_PX if halo < board.radius_px]
    points += [Point(unit, tiles[-1], halo, default) for halo in halos]
    return points + [Point(unit, board.fastest_px, EXACT, other) for other in others]


def other_points(chains: Iterable[str], peers: Iterable[str]) -> list[Point]:
    """The points that are no networks, in float32."""
    named = [(name, "chain") for name in chains] + [(name, "peer") for name in peers]
    return [Point(Unit(name, kind, "float32")) for name, kind in named]  # type: ignore[arg-type] # of a literal
