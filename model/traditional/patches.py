"""Square patches of one image: where the similar ones are, and how they overlap into an image again.

A patch is named by its number on the grid of all its top-left corners, counted along rows; its k * k pixels form
one row of a matrix. So a group of similar patches is a row lookup, and giving them back is a row addition.
"""

import torch
from torch import Tensor


def patch_matrix(image: Tensor, side_px: int) -> Tensor:
    """Every patch of (H, W): ((H - k + 1) * (W - k + 1), k * k)."""
    return image.unfold(0, side_px, 1).unfold(1, side_px, 1).reshape(-1, side_px * side_px)


def overlap_add(patches: Tensor, shape: torch.Size, side_px: int) -> Tensor:
    """Add every patch of the matrix onto its place in an image of `shape` (H, W): the adjoint of `patch_matrix`."""
    height, width = shape
    stack = patches.reshape(height - side_px + 1, width - side_px + 1, side_px, side_px)
    image = patches.new_zeros(height, width)
    for dy in range(side_px):
        for dx in range(side_px):
            image[dy : dy + stack.shape[0], dx : dx + stack.shape[1]] += stack[:, :, dy, dx]
    return image


def window_distances(guide: Tensor, rows: Tensor, columns: Tensor, side_px: int, window_px: int) -> Tensor:
    """Squared L2 distance of each reference patch to the window_px^2 patches around it.

    d(p, q) = sum over k * k pixels of (P - Q)^2, as box sums of shifted differences: exact where the expansion
    |P|^2 - 2 P.Q + |Q|^2 would cancel in float32.

    Args:
        guide: (H, W), wide enough to hold every window.
        rows: (R,) top row of each reference's window, ascending from 0.
        columns: (C,) leftmost column of it, ascending from 0.
        side_px: k, the side of a patch.
        window_px: number of candidates along each axis, odd; the reference is the middle one.

    Returns:
        (R * C, window_px^2). The reference's distance to itself is -1: it wins every tie.
    """
    half = window_px // 2
    box_rows, box_columns = _boxes(rows, side_px, guide.dtype), _boxes(columns, side_px, guide.dtype)
    height, width = box_rows.shape[1], box_columns.shape[1]
    centre = guide[half : half + height, None, half : half + width]
    distances = guide.new_empty(len(rows), len(columns), window_px, window_px)
    for dy in range(window_px):
        shifted = guide[dy : dy + height].unfold(1, width, 1)[:, :window_px]  # (height, window, width)
        squares = (shifted - centre).square_().reshape(height, -1)
        sums = (box_rows @ squares).reshape(-1, width) @ box_columns.T
        distances[:, :, dy] = sums.reshape(len(rows), window_px, -1).mT
    distances[:, :, half, half] = -1
    return distances.reshape(len(rows) * len(columns), -1)


def window_numbers(rows: Tensor, columns: Tensor, grid_columns: int, window_px: int) -> tuple[Tensor, Tensor]:
    """Patch number of each window's first candidate (R * C, 1), and what to add for the others (window_px^2,)."""
    first = (rows[:, None] * grid_columns + columns).reshape(-1, 1)
    steps = torch.arange(window_px, device=rows.device)
    return first, (steps[:, None] * grid_columns + steps).reshape(-1)


def _boxes(starts: Tensor, side_px: int, dtype: torch.dtype) -> Tensor:
    """(R, E) of ones where pixel e lies in the patch of reference r: a box sum at chosen places is a product."""
    offset = torch.arange(int(starts[-1]) + side_px, device=starts.device) - starts[:, None]
    return ((offset >= 0) & (offset < side_px)).to(dtype)
