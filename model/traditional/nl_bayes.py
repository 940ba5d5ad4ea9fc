"""Non-local Bayes denoising of Gaussian noise (Lebrun, Buades, Morel, IPOL 2013).

Two passes over a regular grid of reference patches. In each, similar patches form a group, the group a Gaussian
model, and the model an estimate of every patch of the group; overlapping estimates are averaged. The second pass
searches, and takes its model, in the result of the first.
"""

from collections.abc import Iterable, Iterator
from itertools import tee

import torch
from torch import Tensor

from model.traditional.noise import Noise
from model.traditional.passes import denoise_pass
from model.traditional.rows import Rows
from model.traditional.settings import QUALITIES, Quality, first_pass, second_pass
from profiles.errors import ImageError


def nl_bayes(image: Tensor, noise: Noise, quality: Quality = QUALITIES["standard"]) -> Tensor:
    """Remove Gaussian noise from (H, W) float32. NaN marks missing pixels; they stay so, and no other sees them.

    The settings were published for 8-bit images: bring the data to a scale where sigma lies within some 5 to 40.
    Limits: sigma = 0 returns a copy; a constant image returns itself, up to rounding; a pixel too near missing ones
    to lie in any whole patch keeps its value. Any H and W from 1 on.

    Raises:
        ImageError: not one plane, or infinite values.
    """
    if image.ndim != 2 or 0 in image.shape:
        raise ImageError(
            "image to denoise",
            expected="one plane (H, W)",
            got=f"shape {tuple(image.shape)}",
            remedy="select one band",
        )
    return torch.cat(list(nl_bayes_strips([image], image.shape[0], noise, quality)))


def nl_bayes_strips(strips: Iterable[Tensor], height: int, noise: Noise, quality: Quality) -> Iterator[Tensor]:
    """As `nl_bayes`, bit for bit, on an image that comes and goes in strips of rows (any rows each, W).

    Holds some 150 rows of it, and the tallest strip.
    """
    if noise.sigma == 0:
        yield from (strip.clone() for strip in strips)
        return
    as_guide, for_first, for_second = tee(finite_or_missing(strips), 3)
    basic = denoise_pass(Rows(for_first), Rows(as_guide), height, noise, first_pass(noise.sigma), quality.stride_px)
    settings = second_pass(noise.sigma, quality)
    yield from denoise_pass(Rows(for_second), Rows(basic), height, noise, settings, quality.stride_px)


def finite_or_missing(strips: Iterable[Tensor]) -> Iterator[Tensor]:
    """The strips as they come.

    Raises:
        ImageError: one holds infinite values.
    """
    for strip in strips:
        if bool(torch.isinf(strip).any()):
            remedy = "mark missing pixels as NaN"
            raise ImageError("image to denoise", expected="finite values or NaN", got="infinity", remedy=remedy)
        yield strip
