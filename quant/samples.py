"""Images of a user's own, as their network reads them: what any network is calibrated and judged
on.

One .npy or .npz file of a batch (N, C, H, W), or a folder of images and .npy files of one image
each, (C, H, W). Values are in [0, 1] of full scale: of pixels of 8 bits 255, of more 4095. A .npz
file may hold what the network should give beside what it reads, as `image` and `reference`.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
import onnx

from beers_deploy.model.io.files import IMAGE_SUFFIXES
from beers_deploy.model.raster.images import read_pixels
from beers_deploy.profiles.arrays import load_arrays
from beers_deploy.profiles.errors import ImageError, ModelError, OptionError, printable
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.onnx_file import fixed_tile_px
from beers_deploy.quant.tiling.walk import tiling_of
from beers_deploy.quant.untrusted import times

if TYPE_CHECKING:
    from beers_deploy.quant.calibration import View

PATCH_PX = 128
ARRAY_SUFFIX = ".npy"
T = TypeVar("T")
Pair = tuple[np.ndarray, np.ndarray]
"""(degraded, reference) of a patch; the reference of a user's own sample that has none is empty."""
Named = tuple[str, Pair]
"""A user's own sample with its name."""


@dataclass(frozen=True)
class Remade(Generic[T]):
    """A sequence whose items are made each time they are asked for: none is kept."""

    make: Callable[[int], T]
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> T:
        if not 0 <= number < self.count:
            raise IndexError(number)
        return self.make(number)

    def __iter__(self) -> Iterator[T]:
        return map(self.make, range(self.count))


@dataclass(frozen=True)
class Patches:
    """Simulated patches, each (1, 1, P, P) float32 in [0, 1].

    Attributes:
        views: what each shows, and the sensors that saw it.
        pairs: (degraded, reference) of each.
        degraded: the same degraded patches alone, for half the work.
        names: of a user's own samples, for messages; empty of simulated ones.
    """

    views: "list[View]"
    pairs: Remade[Pair]
    degraded: Remade[np.ndarray]
    names: tuple[str, ...] = ()

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the bytes of all pairs."""
        digest = hashlib.sha256()
        for pair in self.pairs:
            for image in pair:
                digest.update(image.tobytes())
        return digest.hexdigest()


HELD_OUT_EVERY = 4
"""One sample of so many is kept from calibration, to look at what INT8 changes."""
LARGEST = 1 + 1e-6
LEAST_CONTRAST = 1 / MAX_DN
FULL_SCALE_8 = 255
REMEDY = "See docs/reference/any-network.md for how to give samples."


def read_samples(
    given: Path | Sequence[Pair], channels: int, fixed_px: int | None, multiple_px: int = 1
) -> Patches:
    """The samples of a file, a folder or arrays, cut to what the network takes: each (1, C, h, w)
    float32 in [0, 1].

    Args:
        given: the file or folder, or the samples (C, H, W) with their references.
        channels: that the network reads.
        fixed_px: side of the image that the network is fixed to; None cuts large samples to
            patches.
        multiple_px: what sides must be multiples of; the rest is cut off.
    """
    # Messages name a sample by its file or, in memory, by its place.
    sources = (
        _samples(given)
        if isinstance(given, Path)
        else ((f"{IN_MEMORY}[{k}]", *p) for k, p in enumerate(given))
    )
    samples = list[Named]()
    for name, image, reference in sources:
        pixels = _sound(name, image, channels)
        target = _sound_reference(name, reference)
        pairs = _cut(pixels, target, name, fixed_px, multiple_px)
        samples += [(name, pair) for pair in pairs]
    if not samples:
        source = str(given) if isinstance(given, Path) else f"`{IN_MEMORY}`"
        raise ImageError(f"{source} contains no sample, but at least one is needed. {REMEDY}")
    return _patches(samples)


IN_MEMORY = "samples"


def samples_in(given: object) -> list[Pair]:
    """The samples in an array, in a pair of arrays (images, references), or in what gives such one
    after the other.

    Args:
        given: a batch (N, C, H, W), or one image (C, H, W), of NumPy or torch and in [0, 1]; a
            tuple of two; a simulated pair, which knows its full scale; or an iterable of any of
            these, such as a DataLoader.
    """
    # A simulated pair holds digital numbers, and alone knows its full scale.
    if hasattr(given, "degraded") and hasattr(given, "reference"):
        pair: Any = given
        largest = np.float32(pair.sensor.max_dn)
        degraded = np.asarray(pair.degraded, np.float32)[None] / largest
        reference = np.asarray(pair.reference, np.float32)[None] / largest
        return [(degraded, reference)]
    if hasattr(given, "ndim"):
        return [(image, NO_REFERENCE) for image in _batch(given)]
    if (
        isinstance(given, tuple)
        and len(given) == 2
        and all(hasattr(array, "ndim") for array in given)
    ):
        # A reference may have another size than its image.
        images = _batch(given[0])
        references = _plain(given[1])
        references = references[None] if np.ndim(given[0]) == 3 else references
        if references.ndim == 0 or len(images) != len(references):
            raise ImageError(
                f"`{IN_MEMORY}` must have a reference for each image, got images of "
                f"{times(images.shape)} and references of {_shape(references)}. {REMEDY}"
            )
        return list(zip(images, references, strict=True))
    if not isinstance(given, Iterable) or isinstance(given, str | bytes | Mapping):
        raise ImageError(
            f"`{IN_MEMORY}` must be arrays (N, C, H, W) or a path, got {type(given).__name__}. "
            f"{REMEDY}"
        )
    # A DataLoader gives a batch as a list: of images and references, or of images alone.
    items = (tuple(item) if isinstance(item, list) and len(item) == 2 else item for item in given)
    items = (
        item[0] if isinstance(item, list | tuple) and len(item) == 1 else item for item in items
    )
    return list(chain.from_iterable(map(samples_in, items)))


def _batch(array: Any) -> np.ndarray:
    """One image or a batch of NumPy or torch as (N, C, H, W)."""
    batch = _plain(array)
    if batch.ndim not in (3, 4):
        raise ImageError(
            f"`{IN_MEMORY}` must be a batch of (N, C, H, W), got {times(batch.shape)}. {REMEDY}"
        )
    return batch if batch.ndim == 4 else batch[None]


def _plain(array: Any) -> np.ndarray:
    # NumPy refuses a tensor of torch that still has a gradient.
    return np.asarray(array.detach() if hasattr(array, "detach") else array)


NO_REFERENCE = np.empty(0, np.float32)


def _patches(samples: Sequence[Named]) -> Patches:
    names = tuple(name for name, _ in samples)
    pairs = [pair for _, pair in samples]
    count = len(pairs)
    images = Remade(lambda k: pairs[k][0], count)
    return Patches([], Remade(lambda k: pairs[k], count), images, names)


def _named(samples: Patches) -> list[Named]:
    return list(zip(samples.names, samples.pairs, strict=True))


CALIBRATED_ON = "calibration_samples"
"""What an INT8 file calls the digests of the samples that it was calibrated on."""
DIGEST_DIGITS = 16


def digest_of(sample: np.ndarray) -> str:
    """A sample (1, C, h, w), told from any other."""
    content = np.ascontiguousarray(sample, np.float32).tobytes()
    return hashlib.sha256(content).hexdigest()[:DIGEST_DIGITS]


def split_samples(samples: Patches) -> tuple[Patches, Patches]:
    """What to calibrate on, and every fourth sample to look at what INT8 changes; of fewer both are
    all.
    """
    pairs = _named(samples)
    held_out = pairs[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY]
    # Fewer than four samples are too few to leave one out of calibration.
    if not held_out:
        return samples, samples
    calibration = [pair for k, pair in enumerate(pairs) if (k + 1) % HELD_OUT_EVERY]
    return _patches(calibration), _patches(held_out)


def sample_files(path: Path) -> list[Path]:
    """Return the files that samples are read from: those of a folder in their order, or the file
    itself.
    """
    if not path.is_dir():
        return [path]
    return sorted(
        file for file in path.iterdir() if file.suffix.lower() in {ARRAY_SUFFIX, *IMAGE_SUFFIXES}
    )


def _samples(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, image (C, H, W) and reference of each sample."""
    if not path.is_dir():
        yield from _batch_in(path)
        return
    for file in sample_files(path):
        if file.suffix.lower() != ARRAY_SUFFIX:
            yield file.name, _bands_first(file, read_pixels(file)), NO_REFERENCE
            continue
        image, _ = _stored(file)
        if image.ndim != 3:
            raise ImageError(f"{file} must be one image (C, H, W), got {_shape(image)}. {REMEDY}")
        yield file.name, image, NO_REFERENCE


def _batch_in(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield the samples of one file, as `_samples` does."""
    images, references = _stored(path)
    if images.ndim != 4:
        raise ImageError(f"{path} must be a batch of (N, C, H, W), got {_shape(images)}. {REMEDY}")
    if references.ndim == 0 or (references is not NO_REFERENCE and len(references) != len(images)):
        raise ImageError(
            f"{path} must have a reference for each of its {len(images)} images, got references "
            f"of {_shape(references)}. {REMEDY}"
        )
    for number, image in enumerate(images):
        yield (
            f"{path.name}[{number}]",
            image,
            references[number] if references.size else NO_REFERENCE,
        )


def _stored(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The array of a .npy file, mapped rather than read; of a .npz file `image` and `reference`, or
    its only array.

    Nothing is unpickled.
    """
    try:
        arrays = load_arrays(path)
    except ValueError as error:
        raise ImageError(
            f"Samples are a .npy or .npz file of numbers, or a folder of images, but {path} cannot "
            f"be read as such: {printable(str(error))}. {REMEDY}"
        ) from error
    # One array alone may have any name: `np.savez(file, images)` calls it `arr_0`.
    image = next(iter(arrays)) if len(arrays) == 1 else "image"
    if image not in arrays:
        names = printable(", ".join(arrays)) or "no array"
        raise ImageError(
            f"{path} must have arrays named 'image' and 'reference', got {names}. {REMEDY}"
        )
    return arrays[image], arrays.get("reference", NO_REFERENCE)


def _bands_first(path: Path, pixels: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, bands) as stored to (C, H, W) of full scale; floats are of full scale
    already.
    """
    bands = pixels[None] if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0)
    if bands.dtype.kind == "f":
        return bands
    if bands.dtype.kind not in "ui":
        raise ImageError(f"The pixels of {path} must be numbers, got {bands.dtype}. {REMEDY}")
    # Files state no full scale: pixels of 8 bits use all of them, others are taken for 12 bits.
    return bands / np.float32(FULL_SCALE_8 if bands.dtype.itemsize == 1 else MAX_DN)


def _shape(array: np.ndarray) -> str:
    return times(array.shape) or "no dimension"


def _sound_reference(name: str, reference: np.ndarray) -> np.ndarray:
    """Return a reference as float32; raise ImageError if it is not made of real, finite numbers.

    Whether it must be an image in [0, 1] of the result's size depends on what is measured:
    `quant.gate.compare`.
    """
    if reference.dtype.kind not in "fuib":
        raise ImageError(
            f"The reference of {name} must be of real numbers, got {reference.dtype}. {REMEDY}"
        )
    values = np.asarray(reference, np.float32)
    lost = np.count_nonzero(~np.isfinite(values))
    if lost:
        raise ImageError(
            f"The reference of {name} has {lost} values that are NaN or infinite. Leave out "
            "samples whose references lack pixels."
        )
    return values


def _sound(name: str, image: np.ndarray, channels: int) -> np.ndarray:
    if image.dtype.kind not in "fui" or len(image) != channels:
        raise ImageError(
            f"{name} must have {channels} channels of numbers, as the network reads, got "
            f"{len(image)} channels of {image.dtype}. {REMEDY}"
        )
    if not image.size:
        raise ImageError(f"{name} has no pixels: its shape is {_shape(image)}. {REMEDY}")
    values = np.asarray(image, np.float32)
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    # NaN fails every comparison, so it is refused as well.
    if not (low >= 0 and high <= LARGEST):
        remedy = (
            "Divide them by full scale."
            if np.isfinite(high)
            else "Leave out samples with missing pixels."
        )
        raise ImageError(
            f"The values of {name} must be in [0, 1], but they are {low:.4g} to {high:.4g}. "
            f"{remedy}"
        )
    # What rounding has left above 1, within the tolerance of LARGEST.
    return np.minimum(values, 1)


def _cut(
    image: np.ndarray, reference: np.ndarray, name: str, fixed_px: int | None, multiple_px: int
) -> Iterator[Pair]:
    """Patches of an image (C, H, W), or the whole where a reference belongs to it."""
    height, width = image.shape[1:]
    if fixed_px is not None and (height, width) != (fixed_px, fixed_px) and reference.size:
        raise ImageError(
            f"{name} must have {fixed_px} x {fixed_px} pixels, to which the network is fixed, got "
            f"{times((height, width))}. {REMEDY}"
        )
    if reference.size and (height % multiple_px or width % multiple_px):
        raise ImageError(
            f"{name} has a reference, so its sides must be multiples of {multiple_px} pixels, got "
            f"{times((height, width))}. Cut both."
        )
    # A reference may be of another size, such as an enlarged image: it cannot be cut.
    if reference.size:
        yield image[None], reference[None]
        return
    side = fixed_px or PATCH_PX // multiple_px * multiple_px
    # An image smaller than a patch is one patch, cut to the sides that the network takes.
    sizes = [side if n >= side else n // multiple_px * multiple_px for n in (height, width)]
    if 0 in sizes or (fixed_px is not None and sizes != [side, side]):
        raise ImageError(
            f"{name} must have at least {fixed_px or multiple_px} pixels a side, got "
            f"{times((height, width))}. Give larger images."
        )
    for top in range(0, height - sizes[0] + 1, sizes[0]):
        for left in range(0, width - sizes[1] + 1, sizes[1]):
            patch = image[None, :, top : top + sizes[0], left : left + sizes[1]]
            yield np.ascontiguousarray(patch), NO_REFERENCE


@dataclass(frozen=True)
class OwnSamples:
    """Where a run's samples come from, in the place of `quant.calibration.Calibration`."""

    given: Path | Sequence[Pair]
    channels: int
    fixed_px: int | None
    multiple_px: int

    @cached_property
    def all(self) -> Patches:
        """Every sample with contrast: any network keeps what is constant, and a mean over such
        hides errors.
        """
        # Any network keeps what is constant, so a mean over such samples would hide errors.
        samples = read_samples(self.given, self.channels, self.fixed_px, self.multiple_px)
        textured = [
            (name, pair) for name, pair in _named(samples) if np.ptp(pair[0]) >= LEAST_CONTRAST
        ]
        if not textured:
            source = str(self.given) if isinstance(self.given, Path) else f"`{IN_MEMORY}`"
            raise ImageError(
                f"All samples of {source} are constant, but samples need contrast. Give real "
                "images."
            )
        return _patches(textured)

    @property
    def drawn(self) -> Patches:
        """What the network is calibrated on."""
        return split_samples(self.all)[0]

    @property
    def for_tuning(self) -> Patches:
        """The same, for the training of whole numbers."""
        return self.drawn

    @property
    def unseen(self) -> Patches:
        """What calibration does not see."""
        return split_samples(self.all)[1]

    @property
    def about(self) -> dict[str, str]:
        """What the file says of it."""
        name = self.given.name if isinstance(self.given, Path) else IN_MEMORY
        return {
            "calibration_data": name,
            CALIBRATED_ON: " ".join(map(digest_of, self.drawn.degraded)),
        }


def samples_of(model: onnx.ModelProto, given: object) -> OwnSamples | None:
    """A user's samples for a network, None where none are given and it takes simulated ones."""
    channels = int(model.graph.input[0].type.tensor_type.shape.dim[1].dim_value) or 1
    fixed_px = fixed_tile_px(model)
    multiple_px = _multiple_px(model)
    if given is not None:
        source = Path(given) if isinstance(given, str | os.PathLike) else samples_in(given)
        return OwnSamples(source, channels, fixed_px, multiple_px or 1)
    # Simulated patches have one channel and PATCH_PX a side.
    if channels != 1 or multiple_px is None or PATCH_PX % multiple_px:
        what = f"only images of {fixed_px} x {fixed_px} pixels"
        if multiple_px is not None:
            what = (
                f"{channels} channels"
                if channels != 1
                else f"images of multiples of {multiple_px} pixels"
            )
        raise OptionError(
            f"`samples` must be given, because the network reads {what}, and simulated patches "
            f"are {PATCH_PX} x {PATCH_PX} pixels of one channel. Give a .npy or .npz file of "
            "(N, C, H, W) in [0, 1], or a folder of images."
        )
    return None


def _multiple_px(model: onnx.ModelProto) -> int | None:
    """What the sides of an image must be multiples of; None of a network that has one size."""
    try:
        return tiling_of(model).lattice_px
    except ModelError:
        return None
