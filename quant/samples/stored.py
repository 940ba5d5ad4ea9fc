"""Read stored samples: from a .npy or .npz file, from a folder of images, or from arrays."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from beers_deploy.model.io.files import IMAGE_SUFFIXES
from beers_deploy.model.raster.images import read_pixels
from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.profiles.user_files.arrays import array_of, load_arrays
from beers_deploy.quant.input_range import Ranges, from_shares
from beers_deploy.quant.samples.patches import Pair
from beers_deploy.quant.untrusted import times

ARRAY_SUFFIX = ".npy"
IN_MEMORY = "samples"
"""The name in messages and files of samples that are not from a file."""
NO_REFERENCE = np.empty(0, np.float32)
FULL_SCALE_8 = 255
REMEDY = "See docs/reference/any-network.md for how to give samples."


def samples_in(samples: object) -> list[Pair]:
    """Return the samples that a user passes in memory, as pairs of image and reference.

    Args:
        samples: a batch (N, C, H, W) or one image (C, H, W), of NumPy or torch; a tuple of images
            and references, both such arrays; a simulated pair, which has its full scale; or an
            iterable of any of these, such as a DataLoader.

    Returns:
        An image (C, H, W) and its reference for each sample. The reference is empty if there is
        none.

    Raises:
        ImageError: arrays of other shapes, or references of another number than the images.
    """
    # A simulated pair holds digital numbers, and alone knows its full scale.
    if hasattr(samples, "degraded") and hasattr(samples, "reference"):
        pair: Any = samples
        largest = np.float32(pair.sensor.max_dn)
        degraded = np.asarray(pair.degraded, np.float32)[None] / largest
        reference = np.asarray(pair.reference, np.float32)[None] / largest
        return [(degraded, reference)]
    if hasattr(samples, "ndim"):
        return [(image, NO_REFERENCE) for image in _batch(samples)]
    if isinstance(samples, tuple) and [hasattr(array, "ndim") for array in samples] == [True, True]:
        # A reference may have another size than its image.
        images = _batch(samples[0])
        references = _plain(samples[1])
        references = references[None] if np.ndim(samples[0]) == 3 else references
        return _paired(f"`{IN_MEMORY}`", images, references)
    if not isinstance(samples, Iterable) or isinstance(samples, str | bytes | Mapping):
        raise ImageError(
            f"`{IN_MEMORY}` must be arrays (N, C, H, W) or a path, got {type(samples).__name__}. "
            f"{REMEDY}"
        )
    pairs = []
    for item in samples:
        # A DataLoader returns a batch as a list: of images and references, or of images alone.
        batch = tuple(item) if isinstance(item, list) and len(item) == 2 else item
        alone = isinstance(batch, list | tuple) and len(batch) == 1
        pairs += samples_in(batch[0] if alone else batch)
    return pairs


def _batch(array: Any) -> np.ndarray:
    """Return one image or a batch of NumPy or torch as (N, C, H, W)."""
    batch = _plain(array)
    if batch.ndim not in (3, 4):
        raise ImageError(
            f"`{IN_MEMORY}` must be a batch of (N, C, H, W), got {times(batch.shape)}. {REMEDY}"
        )
    return batch if batch.ndim == 4 else batch[None]


def _plain(array: Any) -> np.ndarray:
    return array_of(array, IN_MEMORY) if hasattr(array, "detach") else np.asarray(array)


def sample_files(path: Path) -> list[Path]:
    """Return the files that samples are read from: the arrays and images of a folder, sorted by
    name, or the file itself.
    """
    if not path.is_dir():
        return [path]
    return sorted(
        file for file in path.iterdir() if file.suffix.lower() in {ARRAY_SUFFIX, *IMAGE_SUFFIXES}
    )


def stored_samples(
    source: Path | Sequence[Pair], ranges: Ranges
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Read stored samples one after the other.

    Args:
        source: a file of a batch, a folder of files of one image each, or pairs in memory.
        ranges: the ranges of the network's channels, onto which pixels from 0 to full scale of
            image files are mapped; empty for [0, 1].

    Yields:
        The sample's name for messages, its image (C, H, W), and its reference, empty if there is
        none.

    Raises:
        ImageError: a file cannot be read as samples.
    """
    if not isinstance(source, Path):
        for number, pair in enumerate(source):
            yield f"{IN_MEMORY}[{number}]", *pair
    elif source.is_dir():
        for file in sample_files(source):
            if file.suffix.lower() != ARRAY_SUFFIX:
                image = from_shares(_bands_first(file, read_pixels(file)), ranges)
            else:
                image = _arrays(file, 3, "one image (C, H, W)")[0]
            yield file.name, image, NO_REFERENCE
    else:
        images, references = _arrays(source, 4, "a batch of (N, C, H, W)")
        if references is NO_REFERENCE:
            references = np.empty((len(images), 0), np.float32)
        for number, pair in enumerate(_paired(str(source), images, references)):
            yield f"{source.name}[{number}]", *pair


def _paired(label: str, images: np.ndarray, references: np.ndarray) -> list[Pair]:
    """Return images with their references; raise ImageError if their numbers differ."""
    if references.ndim == 0 or len(references) != len(images):
        raise ImageError(
            f"{label} must have a reference for each image ({len(images)}), got references "
            f"of {format_shape(references)}. {REMEDY}"
        )
    return list(zip(images, references, strict=True))


def _arrays(path: Path, ndim: int, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the memory-mapped array of a .npy file, or `image` and `reference` or the only array
    of a .npz file.

    Nothing is unpickled. An array with another number of dimensions raises ImageError, whose
    message names the expected `kind`.
    """
    try:
        arrays = load_arrays(path)
    except ValueError as error:
        raise ImageError(
            f"{path} cannot be read as samples: {printable(str(error))}. Give a .npy or .npz file "
            f"of numbers, or a folder of images. {REMEDY}"
        ) from error
    # One array alone may have any name: `np.savez(file, images)` calls it `arr_0`.
    image = next(iter(arrays)) if len(arrays) == 1 else "image"
    if image not in arrays:
        names = printable(", ".join(arrays)) or "no array"
        raise ImageError(
            f"{path} must have arrays named 'image' and 'reference', got {names}. {REMEDY}"
        )
    if arrays[image].ndim != ndim:
        raise ImageError(f"{path} must be {kind}, got {format_shape(arrays[image])}. {REMEDY}")
    return arrays[image], arrays.get("reference", NO_REFERENCE)


def _bands_first(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Return pixels (H, W) or (H, W, bands) as stored as (C, H, W) of full scale; floats are of
    full scale already.
    """
    bands = pixels[None] if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0)
    if bands.dtype.kind == "f":
        return bands
    if bands.dtype.kind not in "ui":
        raise ImageError(f"The pixels of {path} must be numbers, got {bands.dtype}. {REMEDY}")
    # Files state no full scale: pixels of 8 bits use all of them, others are taken for 12 bits.
    full_scale = FULL_SCALE_8 if bands.dtype.itemsize == 1 else MAX_DN
    low = int(bands.min())
    high = int(bands.max())
    # Otherwise such values would count as those of a network that reads another range than [0, 1].
    if low < 0 or high > full_scale:
        raise ImageError(
            f"The pixels of {path} must be from 0 to {full_scale}, which is full scale, got {low} "
            f"to {high}. Divide them by their full scale, and save them as .npy (C, H, W)."
        )
    return bands / np.float32(full_scale)


def format_shape(array: np.ndarray) -> str:
    """Return the shape of an array as text for a message, such as "3 x 64 x 64"."""
    return times(array.shape) or "no dimension"
