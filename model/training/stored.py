"""Draw batches of patches from pairs on disk, as `beers-deploy simulate` writes them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beers_deploy.model.raster.images import read_acquisition
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.training.patches import Files, turn
from beers_deploy.model.training.source import Batch
from beers_deploy.profiles.errors import ImageError

RESCALE = "Rescale it to the digital numbers of the sensor that made the pairs."


@dataclass(frozen=True)
class StoredPairs:
    """Endless batches of (degraded, reference) patches, (N, 1, P, P) in [0, 1]; the same for the
    same seed.

    `max_dn` is the largest digital number of the sensor that made the pairs. Patches may be turned
    by `quarters` unless its two axes differ, and they have `mirrors` unless its blur is lopsided.
    """

    files: Sequence[Files]
    patch_px: int
    max_dn: int
    batch: int
    seed: int
    rank: int = 0
    workers: int = 1
    quarters: bool = True
    mirrors: bool = True

    def batches(self, first: int = 0) -> Iterator[Batch]:
        """Yield batch number `first` and all that follow."""
        number = first
        while True:
            # Keyed by the batch's number and not drawn in sequence: a resumed run draws the same.
            generator = Draw(self.seed, number * self.workers + self.rank).generator("stored")
            patches = torch.stack([self._patch(generator) for _ in range(self.batch)]) / self.max_dn
            yield Batch(patches[:, :1].contiguous(), patches[:, 1:].contiguous())
            number += 1

    def _patch(self, generator: np.random.Generator) -> Tensor:
        """Read one patch (2, P, P) at a random place of a random pair."""
        files = self.files[int(generator.integers(len(self.files)))]
        images = [read_acquisition(file, remedy=RESCALE, max_dn=self.max_dn) for file in files]
        height, width = images[0].shape
        if images[0].shape != images[1].shape or min(height, width) < self.patch_px:
            sizes = " and ".join(f"{image.shape[1]} x {image.shape[0]} pixels" for image in images)
            raise ImageError(
                f"{files[0]} and its reference must be mono images of one size, "
                f"{self.patch_px} pixels a side or more, but they have {sizes}. Choose a smaller "
                "`patch`, or simulate larger patches."
            )
        top, left = (int(generator.integers(size - self.patch_px + 1)) for size in (height, width))
        window = slice(top, top + self.patch_px), slice(left, left + self.patch_px)
        both = np.stack([np.float32(image[window]) for image in images])
        patches = turn(both, generator, self.quarters, self.mirrors)
        return torch.from_numpy(np.ascontiguousarray(patches))
