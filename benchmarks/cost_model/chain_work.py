"""What the denoise-first chain computes, counted by kind from the image's size and the settings.

A kind is work that one resource of a processor bounds, done by one family of library calls. The
counts follow the shapes in `nl_bayes` and `compensate`; they suppose no flat group, no missing
pixel, and groups of the usual number: on drawn scenes and photographs at the working noise this
holds for all but a few groups in a hundred (measured).
"""

import math
from collections import Counter
from dataclasses import dataclass
from itertools import product

from scipy.fft import next_fast_len

from beers_deploy.model.traditional.compensate import BLOCK_PX, RADIUS_PX
from beers_deploy.model.traditional.nl_bayes import (
    PassSettings,
    Quality,
    first_pass,
    reference_runs,
    second_pass,
)
from beers_deploy.model.traditional.pipeline import WORKING_SIGMA

UNITS = {
    "box sums": "FLOP",
    "group products": "FLOP",
    "factorisations": "FLOP",
    "selection": "element",
    "transforms": "FLOP",
    "passes": "B",
    "strided": "B",
    "gathers": "B",
    "calls": "call",
}
"""The kinds and what each is counted in.

- box sums: two matrix products for each row of a search window, which add up squared differences at
  the references.
- group products: batched products of a group's patches: covariances, estimates, the noise's
  covariance.
- factorisations: Cholesky factor and inverse of a covariance, n^3 operations (n^3 / 3 and 2 n^3 /
  3).
- selection: distances among which the nearest are found (numpy's argpartition).
- transforms: FFTs of real images, 2.5 n log2 n operations for n pixels.
- passes: bytes read and written by operations that go through arrays in order.
- strided: bytes read and written by cutting an image into patches and adding patches onto an image.
- gathers: bytes read and written by picking patches by number, and adding them back.
- calls: operations of the library, each of which costs something before it computes.
"""

Work = Counter[str]
"""Amount of each kind."""

FLOAT_BYTES = 4
CALLS_A_TILE = 150
CALLS_A_WINDOW_ROW = 12
CALLS_A_PATCH_PIXEL = 10
"""Operations of `nl_bayes._tile`, of a turn of `window_distances`, and of two turns of
`overlap_add`.
"""
MATRIX_PASSES = 8
MATRIX_GATHERS = 4
IMAGE_PASSES = 30
"""Readings and writings of a group's covariance outside its factorisation, in order and where it
was chosen by a mask, and of the image outside NL-Bayes.
"""


@dataclass(frozen=True)
class Tile:
    """A tile of references: so many along each axis, and the pixels from one to the next."""

    rows: int
    columns: int
    stride_px: int

    @property
    def groups(self) -> int:
        """One for each reference."""
        return self.rows * self.columns

    def covered_px(self, side_px: int) -> tuple[int, int]:
        """Rows and columns of pixels that squares of `side_px` at every reference cover."""
        return (self.rows - 1) * self.stride_px + side_px, (
            self.columns - 1
        ) * self.stride_px + side_px


def chain_work(height: int, width: int, quality: Quality) -> Work:
    """Work of `restore_traditional` on (H, W), all of it."""
    passes = first_pass(WORKING_SIGMA), second_pass(WORKING_SIGMA, quality)
    total = compensation_work(height, width)
    for settings in passes:
        for tile, count in _tiles(height, width, quality.stride_px).items():
            work = tile_work(tile, settings)
            total.update({kind: count * amount for kind, amount in work.items()})
    total["passes"] += IMAGE_PASSES * FLOAT_BYTES * height * width
    return total


def _tiles(height: int, width: int, stride_px: int) -> Counter[Tile]:
    """The tiles of a pass, by their size: at most four sizes, however large the image."""
    # An image has at most two lengths of tiles along each axis, so at most four sizes, however
    # large it is.
    rows, columns = (Counter(map(len, reference_runs(size, stride_px))) for size in (height, width))
    tiles = Counter[Tile]()
    for (height_px, count), (width_px, times) in product(rows.items(), columns.items()):
        tiles[Tile(height_px, width_px, stride_px)] = count * times
    return tiles


def tile_work(tile: Tile, settings: PassSettings) -> Work:
    """Work of `nl_bayes._tile`."""
    return _search(tile, settings) + _estimates(tile, settings) + _stack(tile, settings)


def _search(tile: Tile, settings: PassSettings) -> Work:
    """`window_distances` and `nearest_first`."""
    window = settings.window_px
    height, width = tile.covered_px(settings.side_px)
    sums = tile.rows * height * window * width + tile.rows * window * width * tile.columns
    squares = height * window * width
    distances = tile.groups * window
    return Work(
        {
            "box sums": 2 * window * sums,
            "passes": 5
            * FLOAT_BYTES
            * window
            # Two maps are read and one is written, which is then squared in place.
            * squares,
            "strided": 2 * FLOAT_BYTES * window * distances,
            "selection": tile.groups * window**2 if settings.similar < window**2 else 0,
            "calls": CALLS_A_WINDOW_ROW * window,
        }
    )


def _estimates(tile: Tile, settings: PassSettings) -> Work:
    """`estimate_groups`: of the group, and in pass 2 also of the guide's."""
    n = settings.side_px**2
    images = 2 if settings.clean_guide else 1
    members = tile.groups * settings.similar
    return Work(
        {
            "group products": 2 * (images + 1) * members * n**2 + 2 * tile.groups * n**3,
            "factorisations": tile.groups * n**3,
            # Picked; read, added and written; and the covariances of the groups that are not flat.
            "gathers": FLOAT_BYTES
            * (members * n * (2 * images + 3) + MATRIX_GATHERS * tile.groups * n**2),
            "passes": FLOAT_BYTES * (4 * images * members * n + MATRIX_PASSES * tile.groups * n**2),
        }
    )


def _stack(tile: Tile, settings: PassSettings) -> Work:
    """`patch_matrix` of both images and `overlap_add` of sums and counts."""
    side = settings.side_px
    reach = tile.stride_px + 2 * settings.margin_px
    patches = math.prod(length - side + 1 for length in tile.covered_px(reach))
    return Work(
        {
            "strided": FLOAT_BYTES * patches * side**2 * (2 * 2 + 2 * 3),
            "calls": CALLS_A_TILE + CALLS_A_PATCH_PIXEL * side**2,
        }
    )


def compensation_work(height: int, width: int) -> Work:
    """Work of `compensate`: three transforms a block, and the filter's own."""
    work = Work({"transforms": _transform(8 * RADIUS_PX, 8 * RADIUS_PX)})
    for rows, count in _blocks(height).items():
        for columns, times in _blocks(width).items():
            work["transforms"] += 3 * count * times * _transform(rows, columns)
            work["passes"] += 10 * FLOAT_BYTES * count * times * rows * columns
    return work


def _blocks(size_px: int) -> Counter[int]:
    """Sides of the transforms along one axis, and how many of each."""
    count, rest = divmod(size_px, BLOCK_PX)
    sides = Counter({next_fast_len(BLOCK_PX + 2 * RADIUS_PX, real=True): count})
    return sides + Counter({next_fast_len(rest + 2 * RADIUS_PX, real=True): 1 if rest else 0})


def _transform(rows: int, columns: int) -> int:
    pixels = rows * columns
    return round(2.5 * pixels * math.log2(pixels))
