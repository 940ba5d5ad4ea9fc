"""Plausible values for missing pixels, so that a filter can pass over them."""

from torch import Tensor
from torch.nn.functional import pad


def fill_missing(image: Tensor, known: Tensor) -> Tensor:
    """Fill the pixels of (H, W) that are not `known` with the mean of the nearest known ones around.

    A pyramid: each level takes its missing pixels from the next, of half the resolution. 0 where nothing is known.
    """
    filled = image.where(known, 0.0)
    if bool(known.all()) or max(image.shape) == 1:
        return filled
    odd = (0, image.shape[1] % 2, 0, image.shape[0] % 2)
    count = _sum_2x2(pad(known.to(image.dtype), odd))
    mean = _sum_2x2(pad(filled, odd)) / count.clamp(min=1)
    coarse = fill_missing(mean, count > 0).repeat_interleave(2, 0).repeat_interleave(2, 1)
    return filled.where(known, coarse[: image.shape[0], : image.shape[1]])


def _sum_2x2(image: Tensor) -> Tensor:
    return image.unfold(0, 2, 2).unfold(1, 2, 2).sum((2, 3))
