"""What a halo below the exact one costs: measured on images cut in four, weighed by the seams of a swath.

The photographs are smaller than a tile, so tiles of 640 would show no seam. But every seam is alike: pixels within
radius - halo of it are off. So each image is restored in four windows, each reading `halo` beyond the cut, and what
that adds to its error, for each pixel of cut, is what a pixel of seam costs; a swath in tiles has so many seam pixels
for each of its own. Mean squared error, SSIM and LPIPS are means over pixels, so the weighing is linear in them. It
holds while seams lie farther apart than twice the radius, and it is a prediction: no swath was cut.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from deploy.bench import Swath
from deploy.evaluation.methods import Restore
from deploy.restore import MAX_DN, Infer, restore_tiles
from deploy.tiling import Span, Tile, plan_side
from deploy.tradeoff.accuracy import Scores, Values

LEAST_SQUARED_ERROR = 1e-12


def cut_in_four(infer: Infer, halo_px: int, max_dn: int = MAX_DN) -> Restore:
    """Restores (H, W) digital numbers in four windows, each with so much of the others around it."""
    return partial(_restore, infer=infer, halo_px=halo_px, max_dn=max_dn)


def _restore(dn: np.ndarray, infer: Infer, halo_px: int, max_dn: int) -> np.ndarray:
    rows, columns = (halves(size_px, halo_px) for size_px in dn.shape)
    tiles = [Tile(row, column) for row in rows for column in columns]
    return restore_tiles(dn, infer, tiles, max_dn=max_dn).astype(np.float32)


def halves(size_px: int, halo_px: int) -> list[Span]:
    """Both halves of a side, each reading `halo_px` of the other."""
    cut = size_px // 2
    return [Span(0, min(cut + halo_px, size_px), 0, cut), Span(max(cut - halo_px, 0), size_px, cut, size_px)]


def seam_density(swath: Swath) -> float:
    """Pixels of seam for each pixel of a swath in tiles."""
    sides = (swath.width_px, swath.height_px)
    return sum((len(plan_side(side, swath.tile_px, swath.halo_px)) - 1) / side for side in sides)


def with_seams(exact: Scores, cut: Scores, shapes: Sequence[tuple[int, ...]], density: float) -> Scores:
    """Scores of each image as if it had so many seam pixels for each of its own; targets show none."""
    shares = [density / sum(1 / side for side in shape) for shape in shapes]
    images = [_weighed(*each) for each in zip(exact.images, cut.images, shares, strict=True)]
    return Scores(tuple(images), exact.targets)


def _weighed(exact: Values, cut: Values, share: float) -> Values:
    return {key: _between(key, exact[key], cut[key], share) for key in exact}


def _between(key: str, exact: float | None, cut: float | None, share: float) -> float | None:
    if exact is None or cut is None:
        return None
    if key != "PSNR":
        return exact + share * (cut - exact)
    errors = [MAX_DN**2 * 10 ** (-psnr / 10) for psnr in (exact, cut)]
    error = max(errors[0] + share * (errors[1] - errors[0]), LEAST_SQUARED_ERROR)
    return float(10 * np.log10(MAX_DN**2 / error))
