"""Non-local Bayes denoising of white Gaussian noise (Lebrun, Buades, Morel, IPOL 2013).

Two passes over a regular grid of reference patches. In each, similar patches form a group, the group a Gaussian
model, and the model an estimate of every patch of the group; overlapping estimates are averaged. The second pass
searches, and takes its model, in the result of the first.
"""

from itertools import product
from math import isfinite

import torch
from torch import Tensor

from model.traditional.estimate import estimate_groups
from model.traditional.padding import mirror_pad
from model.traditional.patches import overlap_add, patch_matrix, window_distances, window_numbers
from model.traditional.settings import QUALITIES, PassSettings, Quality, first_pass, second_pass
from model.traditional.threads import map_tiles
from profiles.errors import ImageError, OptionError

Area = tuple[slice, slice]

TILE_REFERENCES = 24
"""References along each side of a tile: bounds the memory whatever the image, and keeps a tile near the cache."""


def nl_bayes(image: Tensor, sigma: float, quality: Quality = QUALITIES["standard"]) -> Tensor:
    """Remove white Gaussian noise of standard deviation `sigma` from (H, W) float32.

    The settings were published for 8-bit images: bring the data to a scale where sigma lies within some 5 to 40.
    Limits: sigma = 0 returns a copy; a constant image returns itself, up to rounding. Any H and W from 1 on.

    Raises:
        ImageError: not one plane, or values that are not finite.
        OptionError: a sigma that is no standard deviation.
    """
    _check(image, sigma)
    if sigma == 0:
        return image.clone()
    basic = _one_pass(image, image, sigma, first_pass(sigma), quality.stride_px)
    return _one_pass(image, basic, sigma, second_pass(sigma, quality), quality.stride_px)


def _check(image: Tensor, sigma: float) -> None:
    if image.ndim != 2 or 0 in image.shape or not bool(torch.isfinite(image).all()):
        raise ImageError(
            "image to denoise",
            expected="one plane (H, W) of finite values",
            got=f"shape {tuple(image.shape)}" if image.ndim != 2 or 0 in image.shape else "NaN or infinity",
            remedy="select one band and fill its missing pixels first",
        )
    if not (sigma >= 0 and isfinite(sigma)):
        raise OptionError("sigma", expected="0 or more", got=repr(sigma), remedy="give a standard deviation")


def _one_pass(noisy: Tensor, guide: Tensor, sigma: float, settings: PassSettings, stride_px: int) -> Tensor:
    """Each pixel's mean over all the estimates of it."""
    margin = settings.margin_px
    noisy_wide, guide_wide = (mirror_pad(image, margin, (margin, margin)) for image in (noisy, guide))
    total, count = torch.zeros_like(noisy_wide), torch.zeros_like(noisy_wide)

    def estimate(references: tuple[Tensor, ...]) -> tuple[Area, Tensor, Tensor]:
        rows, columns = references
        area = _extent(rows, margin), _extent(columns, margin)
        places = rows - rows[0], columns - columns[0]
        return area, *_tile(noisy_wide[area], guide_wide[area], places, sigma, settings)

    tiles = product(*(_references(size, stride_px) for size in noisy.shape))
    for area, tile_total, tile_count in map_tiles(estimate, tiles):
        total[area] += tile_total
        count[area] += tile_count
    inside = slice(margin, margin + noisy.shape[0]), slice(margin, margin + noisy.shape[1])
    return total[inside] / count[inside]


def _references(size_px: int, stride_px: int) -> tuple[Tensor, ...]:
    """Pixels on which references are centred along one axis, tile by tile; the last pixel always has one."""
    centres = torch.arange(0, size_px + stride_px - 1, stride_px).clamp(max=size_px - 1)
    return torch.split(centres, TILE_REFERENCES)


def _extent(centres: Tensor, margin_px: int) -> slice:
    """What a run of references sees, in the coordinates of the padded image."""
    return slice(int(centres[0]), int(centres[-1]) + 2 * margin_px + 1)


def _tile(
    noisy: Tensor, guide: Tensor, places: tuple[Tensor, Tensor], sigma: float, settings: PassSettings
) -> tuple[Tensor, Tensor]:
    """Sum and number of the estimates of each pixel of a tile (h, w).

    `places` are the rows and columns of the tile's references, as the top left corners of their search windows.
    """
    numbers, taken = _similar(guide, places, settings)
    patches = patch_matrix(noisy, settings.side_px)
    members = patches[numbers]
    model = patch_matrix(guide, settings.side_px)[numbers] if settings.clean_guide else members
    estimates = estimate_groups(members, model, taken.to(noisy.dtype), sigma, settings)
    total, count = _sum_by_number(estimates[taken], numbers[taken], len(patches))
    each = count[:, None].expand_as(patches)
    return overlap_add(total, noisy.shape, settings.side_px), overlap_add(each, noisy.shape, settings.side_px)


def _similar(guide: Tensor, places: tuple[Tensor, Tensor], settings: PassSettings) -> tuple[Tensor, Tensor]:
    """Numbers (B, N) of the patches most like each reference, and which of them its group takes."""
    distances = window_distances(guide, *places, settings.side_px, settings.window_px)
    nearest, candidate = distances.topk(min(settings.most_similar, distances.shape[1]), largest=False)
    enough = nearest[:, settings.similar - 1, None].clamp(min=settings.alike_rms**2 * settings.side_px**2)
    first, steps = window_numbers(*places, guide.shape[1] - settings.side_px + 1, settings.window_px)
    return first + steps[candidate], nearest <= enough


def _sum_by_number(estimates: Tensor, numbers: Tensor, patches: int) -> tuple[Tensor, Tensor]:
    """Sum (patches, k * k) and count (patches,) of the estimates (M, k * k) that each patch number received."""
    total = estimates.new_zeros(patches, estimates.shape[1]).index_add_(0, numbers, estimates)
    return total, numbers.bincount(minlength=patches).to(estimates.dtype)
