"""Mirrored borders, for images of any size, even smaller than the border."""

import torch
from torch import Tensor


def mirror_pad(image: Tensor, before_px: int, after_px: tuple[int, int]) -> Tensor:
    """Extend (H, W) by its mirror image, the edge pixel repeated: c b a | a b c | c b a.

    Args:
        image: (H, W), H and W at least 1.
        before_px: rows added above and columns added left.
        after_px: (rows added below, columns added right).

    Returns:
        (before_px + H + after_px[0], before_px + W + after_px[1]).
    """
    rows, columns = (
        _mirrored(size, before_px, after, image.device) for size, after in zip(image.shape, after_px, strict=True)
    )
    return image[rows][:, columns]


def _mirrored(size: int, before: int, after: int, device: torch.device) -> Tensor:
    """Indices -before to size + after - 1, folded back into 0..size - 1: the mirror has period 2 * size."""
    index = torch.arange(-before, size + after, device=device) % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)
