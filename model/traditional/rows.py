"""Images as strips of rows, so that no step needs the whole of one."""

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from profiles.errors import ImageError


class Rows:
    """Rows of an image as they come, strip by strip; what lies behind the last window is forgotten."""

    def __init__(self, strips: Iterable[Tensor]) -> None:
        self._strips: Iterator[Tensor] = iter(strips)
        self._held: list[Tensor] = []
        self._top = 0

    def window(self, rows: Tensor) -> Tensor:
        """The rows of those numbers, (len(rows), W); windows must move downwards."""
        top, bottom = int(rows.min()), int(rows.max()) + 1
        while self._top + sum(map(len, self._held)) < bottom:
            self._held.append(self._next())
        while self._top + len(self._held[0]) <= top:
            self._top += len(self._held.pop(0))
        held = self._held[0] if len(self._held) == 1 else torch.cat(self._held)
        return held[rows - self._top]

    def _next(self) -> Tensor:
        for strip in self._strips:
            return strip
        got = f"{self._top + sum(map(len, self._held))}"
        raise ImageError("strips of an image", expected="as many rows as announced", got=got, remedy="give them all")


def mirrored(start: int, stop: int, size: int) -> Tensor:
    """Pixel numbers start..stop - 1 of an image mirrored at its borders, the edge repeated: c b a | a b c | c b a.

    Folded back into 0..size - 1: the mirror has period 2 * size, whatever the size.
    """
    number = torch.arange(start, stop) % (2 * size)
    return torch.minimum(number, 2 * size - 1 - number)
