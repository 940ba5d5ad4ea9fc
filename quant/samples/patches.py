"""Define patches: images with their references, in memory or simulated each time they are read."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from beers_deploy.quant.input_range import Ranges

if TYPE_CHECKING:
    from beers_deploy.quant.samples.views import View

PATCH_PX = 128
Pair = tuple[np.ndarray, np.ndarray]
"""(degraded, reference) of a patch; the reference of a user's own sample that has none is empty."""
T = TypeVar("T")


class Regenerated(Sequence[T]):
    """A sequence whose items are computed each time they are read: none is stored."""

    def __init__(self, item: Callable[[int], T], count: int) -> None:
        """Compute item k, of `count` items, as `item(k)`."""
        self._item = item
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[T]:
        # Without it a loop would end at the first IndexError, also one within an item.
        return map(self._item, range(self._count))

    def __getitem__(self, number: int) -> T:  # type: ignore[override]  # nobody reads slices
        if not 0 <= number < self._count:
            raise IndexError(number)
        return self._item(number)


@dataclass(frozen=True)
class Patches:
    """Images (1, C, h, w) float32 as the network reads them, and their references.

    Attributes:
        pairs: (degraded, reference) of each patch.
        degraded: the same degraded patches without references, which takes half the time to
            simulate.
        names: the names of a user's own samples, for messages; empty for simulated patches.
        views: the ground of each simulated patch, and its sensors; empty for a user's own samples.
        ranges: the ranges of the channels of the images; empty if all are in [0, 1].
    """

    pairs: Sequence[Pair]
    degraded: Sequence[np.ndarray]
    names: Sequence[str] = ()
    views: "Sequence[View]" = ()
    ranges: Ranges = ()

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the bytes of all pairs."""
        digest = hashlib.sha256()
        for pair in self.pairs:
            for image in pair:
                digest.update(image.tobytes())
        return digest.hexdigest()
