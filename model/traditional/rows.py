"""Process images as strips of rows, so that no step needs the whole image."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad


class Rows:
    """An image that arrives in strips of rows; rows are held only until a window below them is
    requested.
    """

    def __init__(self, strips: Iterable[Tensor]) -> None:
        self._strips: Iterator[Tensor] = iter(strips)
        self._in_memory: list[Tensor] = []
        self._top = 0

    def window(self, rows: Tensor) -> Tensor:
        """Return some rows of the image as (R, W), reading strips until all are there.

        Args:
            rows: (R,) row numbers, in any order and repeated if needed. The smallest may not lie
                above that of an earlier call.
        """
        top = int(rows.min())
        bottom = int(rows.max()) + 1
        while self._top + sum(map(len, self._in_memory)) < bottom:
            self._in_memory.append(next(self._strips))
        # Strips above the window are never asked for again: forgetting them bounds the memory.
        while self._top + len(self._in_memory[0]) <= top:
            self._top += len(self._in_memory.pop(0))
        rows_here = self._in_memory[0] if len(self._in_memory) == 1 else torch.cat(self._in_memory)
        return rows_here[rows - self._top]


def mirrored(start: int, stop: int, size: int) -> Tensor:
    """Return the numbers of the pixels start..stop - 1 of an axis that is mirrored at its borders,
    the edge repeated: c b a | a b c | c b a.

    They are folded back into 0..size - 1, because the mirror has the period 2 * size.

    Args:
        start: the first position; it may be negative.
        stop: the position after the last one; it may exceed `size`.
        size: the number of pixels along the axis.

    Returns:
        Pixel numbers (stop - start,).
    """
    number = torch.arange(start, stop) % (2 * size)
    return torch.minimum(number, 2 * size - 1 - number)


Item = TypeVar("Item")
Result = TypeVar("Result")


def map_tiles(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Run `map(work, items)` on as many threads as torch has, with the results in the order of the
    items.

    A tile is thousands of operations on small tensors. If each of them were split across threads,
    these would wait for one another: on a busy machine two threads are five times slower than one
    (measured).
    """
    with one_thread_per_operation() as threads, ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, items)


@contextmanager
def one_thread_per_operation() -> Iterator[int]:
    """Limit torch to one thread per operation within the block, and yield the number of threads it
    had before.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)


def fill_with_local_means(image: Tensor, valid: Tensor) -> Tensor:
    """Fill missing pixels with the mean of the nearest valid ones around.

    It uses a pyramid: each level fills its missing pixels from the next, of half the resolution.
    The value is 0 if no pixel is valid. scikit-image's biharmonic inpainting gives other values, by
    up to 117 of 255 in a striped photograph (measured).

    Args:
        image: (H, W); the values of missing pixels do not matter.
        valid: (H, W) bool, False for the pixels to fill.
    """
    filled = image.where(valid, 0.0)
    if bool(valid.all()) or max(image.shape) == 1:
        return filled
    # Odd sides get a row or column that counts as missing, so that every 2 x 2 is whole.
    to_even = (0, image.shape[1] % 2, 0, image.shape[0] % 2)
    count = _sum_2x2(pad(valid.to(image.dtype), to_even))
    mean = _sum_2x2(pad(filled, to_even)) / count.clamp(min=1)
    coarse = fill_with_local_means(mean, count > 0).repeat_interleave(2, 0).repeat_interleave(2, 1)
    return filled.where(valid, coarse[: image.shape[0], : image.shape[1]])


def _sum_2x2(image: Tensor) -> Tensor:
    return image.unfold(0, 2, 2).unfold(1, 2, 2).sum((2, 3))
