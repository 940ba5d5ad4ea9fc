"""Training patches from pairs on disk, as `simulate` writes them: read as they are needed, cut and turned anew."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from model.images import list_images, read_pixels
from model.scale import remedy_outside, settled_scale
from model.simulator.draws import Draw
from model.training.patches import turn
from model.training.workers import Worker
from profiles.errors import ImageError

RESCALE = "rescale it to the digital numbers of the sensor that made the pairs"

Files = tuple[Path, Path]
"""A degraded and a reference image."""


def pair_files(folder: Path) -> list[Files]:
    """The pairs FOLDER/degraded/NAME and FOLDER/reference/NAME, by name.

    Raises:
        ImageError: a folder is missing or empty, or a name has no partner.
    """
    degraded, reference = ({p.stem: p for p in list_images(folder / role)} for role in ("degraded", "reference"))
    alone = sorted(degraded.keys() ^ reference.keys())
    if alone:
        raise ImageError(
            str(folder),
            expected="each name in degraded/ and in reference/",
            got=f"{alone[0]!r} in one of them only",
            remedy="complete the pairs; 'beers-deploy simulate' writes such folders",
        )
    return [(path, reference[name]) for name, path in degraded.items()]


class StoredPairs:
    """Endless batches of (degraded, reference) patches, (N, 1, P, P) in [0, 1]; the same for the same seed.

    Args:
        files: the pairs.
        patch_px: side of a patch.
        max_dn: the largest digital number of the sensor that made the pairs.
        batch: patches of a batch.
        seed: of what is drawn.
        worker: which of several this is.
        quarters: whether patches may be turned by quarters: not those of a sensor whose two axes differ.
    """

    def __init__(
        self,
        files: Sequence[Files],
        patch_px: int,
        max_dn: int,
        batch: int,
        seed: int,
        worker: Worker | None = None,
        quarters: bool = True,
    ) -> None:
        self.quarters = quarters
        self.files, self.patch_px, self.max_dn = files, patch_px, max_dn
        self.batch, self.seed, self.worker = batch, seed, worker or Worker()

    def batches(self, first: int = 0) -> Iterator[tuple[Tensor, Tensor]]:
        """Batch number `first` and all that follow."""
        number = first
        while True:
            own = number * self.worker.count + self.worker.rank
            generator = Draw(self.seed, own).generator("stored")
            patches = torch.stack([self._patch(generator) for _ in range(self.batch)]) / self.max_dn
            yield patches[:, :1].contiguous(), patches[:, 1:].contiguous()
            number += 1

    def _patch(self, generator: np.random.Generator) -> Tensor:
        """One patch (2, P, P) of a random pair."""
        files = self.files[int(generator.integers(len(self.files)))]
        images = [self._digital_numbers(file) for file in files]
        height, width = images[0].shape[:2]
        if images[0].shape != images[1].shape or images[0].ndim != 2 or min(height, width) < self.patch_px:
            raise ImageError(
                str(files[0]),
                expected=f"a mono pair of one size, {self.patch_px} pixels a side or more",
                got=" and ".join(map(_size, images)),
                remedy="choose a smaller --patch, or simulate larger patches",
            )
        top, left = (int(generator.integers(size - self.patch_px + 1)) for size in (height, width))
        window = slice(top, top + self.patch_px), slice(left, left + self.patch_px)
        both = torch.stack([torch.from_numpy(image[window].astype(np.float32)) for image in images])
        return turn(both[None], generator, self.quarters)[0]

    def _digital_numbers(self, file: Path) -> np.ndarray:
        """The pixels of an image, refused where they are not those of the sensor."""
        pixels = read_pixels(file)
        low, high = float(pixels.min()), float(pixels.max())
        settled_scale(str(file), pixels.dtype, [max(-low, high)], usual=self.max_dn, remedy=RESCALE)
        if low < 0 or high > self.max_dn:
            expected, got = f"digital numbers of 0 to {self.max_dn}", f"values from {low:g} to {high:g}"
            raise ImageError(str(file), expected=expected, got=got, remedy=remedy_outside(low, high, RESCALE))
        return pixels


def _size(image: np.ndarray) -> str:
    """Width x height, and the bands where it is not mono."""
    height, width, *bands = image.shape
    return f"{width} x {height} pixels" + (f" of {bands[0]} bands" if bands else "")
