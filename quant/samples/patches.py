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
    """A sequence whose items are computed each time they are read, so that none is stored."""

    def __init__(self, item: Callable[[int], T], count: int) -> None:
        """Create the sequence.

        Args:
            item: returns an item from its place, 0 to `count` - 1.
            count: the number of items.
        """
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
    """Images on which a network is calibrated or judged, and their references.

    They are a user's own samples, or simulated patches.

    Attributes:
        pairs: (degraded, reference) of each patch: the network's input (1, C, h, w) float32, and
            the image that the result should be. A reference may be empty.
        degraded: the inputs alone. Simulating them takes half the time of simulating pairs.
        names: the name of each of a user's own samples, for messages; empty for simulated patches.
        views: the ground and the sensors of each simulated patch; empty for a user's own samples.
        ranges: the range (low, high) of each channel of the images; empty if all are in [0, 1].
    """

    pairs: Sequence[Pair]
    degraded: Sequence[np.ndarray]
    names: Sequence[str] = ()
    views: "Sequence[View]" = ()
    ranges: Ranges = ()

    @cached_property
    def digest(self) -> str:
        """The SHA-256 of the bytes of all pairs, by which files record the patches that they were
        made with.
        """
        digest = hashlib.sha256()
        for pair in self.pairs:
            for image in pair:
                digest.update(image.tobytes())
        return digest.hexdigest()
