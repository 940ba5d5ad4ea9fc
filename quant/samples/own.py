"""Read a user's own samples in the units of their network, for calibration and evaluation.

They are one .npy or .npz file of a batch (N, C, H, W), or a folder of images and .npy files of one
image each, (C, H, W). Values are as the network reads them: in [0, 1] of full scale, unless another
range is stated or found. Full scale of 8-bit pixels in image files is 255, of larger types 4095;
0 to full scale are mapped onto a stated range, as in `restore`. A .npz file may contain the input
and the target of the network, as `image` and `reference`.
"""

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from onnx import ModelProto

from beers_deploy.profiles.errors import ImageError, ModelError, OptionError, counted
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.input_range import (
    FROM_SAMPLES,
    KEY,
    LARGEST,
    UNIT,
    Ranges,
    in_words,
    ranges_of,
    read_ranges,
    require_ranges,
    to_shares,
)
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.samples.patches import PATCH_PX, Pair, Patches
from beers_deploy.quant.samples.stored import (
    IN_MEMORY,
    NO_REFERENCE,
    REMEDY,
    format_shape,
    samples_in,
    stored_samples,
)
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.quant.untrusted import times

Named = tuple[str, Pair]
"""A sample with its name, for messages."""

HELD_OUT_EVERY = 4
"""One of this number of samples is held out from calibration, to measure the effect of INT8."""
CALIBRATED_ON = "calibration_samples"
"""The metadata key of the digests of the calibration samples in an INT8 file."""
DIGEST_DIGITS = 16
LEAST_CONTRAST = 1 / MAX_DN


@dataclass(frozen=True)
class OwnSamples:
    """A user's own samples, on which a network is calibrated and judged instead of simulated
    patches.

    They have the same properties as `quant.samples.simulated.Calibration`.

    Attributes:
        name: the name of the file or folder that they were read from.
        samples: the images and references, each pair with its name.
        ranges: the range (low, high) of each channel; empty if all are in [0, 1].
        stated: True if the user stated the ranges, False if they were found from the samples.
    """

    name: str
    samples: Sequence[Named]
    ranges: Ranges = ()
    stated: bool = False

    @property
    def all(self) -> Patches:
        """All samples."""
        return self._patches(self.samples)

    @property
    def drawn(self) -> Patches:
        """The samples that the network is calibrated on: three of four."""
        return self._patches([s for k, s in enumerate(self.samples) if (k + 1) % HELD_OUT_EVERY])

    @property
    def for_tuning(self) -> Patches:
        """The samples that the integers are fine-tuned on: those of calibration, because there are
        no others.
        """
        return self.drawn

    @property
    def unseen(self) -> Patches:
        """The samples that are held out from calibration: every fourth one, or all if there are
        fewer.
        """
        # Fewer than four samples are too few to leave one out of calibration.
        return self._patches(self.samples[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY] or self.samples)

    @property
    def about(self) -> dict[str, str]:
        """The metadata by which an INT8 file describes its calibration: the samples' name, digests
        and ranges.
        """
        digests = " ".join(map(digest_of, self.drawn.degraded))
        about = {"calibration_data": self.name, CALIBRATED_ON: digests}
        if self.ranges:
            source = "" if self.stated else f", {FROM_SAMPLES}"
            about[KEY] = f"{in_words(self.ranges)}{source}"
        return about

    def _patches(self, samples: Sequence[Named]) -> Patches:
        pairs = [pair for _, pair in samples]
        images = [image for image, _ in pairs]
        return Patches(pairs, images, [name for name, _ in samples], ranges=self.ranges)


def digest_of(sample: np.ndarray) -> str:
    """Return a SHA-256, cut to DIGEST_DIGITS hexadecimal digits, by which a sample is recognised.

    Args:
        sample: (1, C, h, w) as the network reads it.
    """
    content = np.ascontiguousarray(sample, np.float32).tobytes()
    return hashlib.sha256(content).hexdigest()[:DIGEST_DIGITS]


def samples_of(model: ModelProto, samples: object, input_range: object = None) -> OwnSamples | None:
    """Read a user's own samples for a network.

    Args:
        model: the network.
        samples: the path of a file or folder, or arrays as `samples_in` accepts them; None for
            none.
        input_range: the ranges of the channels that the user states, as `read_ranges` accepts them;
            None determines them from the samples.

    Returns:
        The samples; None if the user gave none and simulated patches suit the network.

    Raises:
        OptionError: there are no samples, and simulated patches do not suit the network; or a
            stated range is not valid.
        ImageError: the network does not accept the samples.
    """
    channels = int(model.graph.input[0].type.tensor_type.shape.dim[1].dim_value) or 1
    fixed_px = fixed_tile_px(model)
    min_side_px = 1
    try:
        tiling = tiling_of(model)
        multiple_px = tiling.alignment_px
        min_side_px = tiling.whole_px(1)
    except ModelError:
        multiple_px = 0
    if samples is not None:
        if isinstance(samples, str | os.PathLike):
            source: Path | list[Pair] = Path(samples)
        else:
            source = samples_in(samples)
        ranges = None if input_range is None else read_ranges(input_range, channels)
        return read_samples(source, channels, fixed_px, multiple_px or 1, ranges, min_side_px)
    # Simulated patches have one channel and PATCH_PX a side.
    if fixed_px is not None and not multiple_px:
        what = f"only images of {fixed_px} x {fixed_px} pixels"
    elif channels != 1:
        what = f"{channels} channels"
    elif multiple_px and PATCH_PX % multiple_px:
        what = f"images of multiples of {multiple_px} pixels"
    else:
        return None
    raise OptionError(
        f"`samples` must be given, because the network reads {what}, and simulated patches "
        f"are {PATCH_PX} x {PATCH_PX} pixels of one channel. Give a .npy or .npz file of "
        "(N, C, H, W), or a folder of images."
    )


def read_samples(
    source: Path | Sequence[Pair],
    channels: int,
    fixed_px: int | None,
    multiple_px: int = 1,
    ranges: Ranges | None = None,
    min_side_px: int = 1,
) -> OwnSamples:
    """Read samples from a file, a folder or arrays, and cut them to a size that the network
    accepts.

    Args:
        source: the file or folder, or pairs of an image (C, H, W) and its reference.
        channels: the number of channels that the network reads.
        fixed_px: side of the image that the network is fixed to; None cuts large samples to
            patches.
        multiple_px: sides are cut to multiples of this number of pixels.
        ranges: the ranges that the values must be in, and onto which pixels of image files are
            mapped; None determines them from the samples.
        min_side_px: the shortest side that the network accepts.

    Returns:
        The samples, (1, C, h, w) float32 each.

    Raises:
        ImageError: samples that the network does not accept, or samples without any contrast.
    """
    # Messages name a sample by its file or, in memory, by its place.
    label = f"`{IN_MEMORY}`"
    name = IN_MEMORY
    if isinstance(source, Path):
        label = str(source)
        name = source.name
    samples = []
    min_side_px = fixed_px or max(min_side_px, multiple_px)
    for sample, image, reference in stored_samples(source, ranges or ()):
        pixels = _valid_image(sample, image, channels, ranges)
        target = _valid_reference(sample, reference)
        if min(image.shape[1:]) < min_side_px:
            raise ImageError(
                f"{sample} must have at least {min_side_px} pixels a side, got "
                f"{times(image.shape[1:])}. Give larger images."
            )
        samples += [(sample, p) for p in _cut(pixels, target, sample, fixed_px, multiple_px)]
    if not samples:
        raise ImageError(f"{label} contains no sample, but at least one is needed. {REMEDY}")
    stated = ranges is not None
    if ranges is None:
        ranges = ranges_of(image for _, (image, _) in samples)
        try:
            require_ranges(ranges)
        except ValueError as error:
            raise ImageError(
                f"The values of {label} have {error}. Divide them by full scale."
            ) from error
    # Any network preserves a constant image, so a mean over such samples would hide errors. A map
    # of noise levels is constant in each sample.
    textured = [
        (sample, pair)
        for sample, pair in samples
        if np.ptp(to_shares(pair[0], ranges), (2, 3)).max() >= LEAST_CONTRAST
    ]
    if not textured:
        raise ImageError(
            f"All samples of {label} are constant, but samples need contrast. Give real images."
        )
    return OwnSamples(name, textured, ranges, stated)


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    """Return numbers as float32, or raise ImageError if some are NaN or infinite."""
    finite = np.asarray(values, np.float32)
    missing = int(np.count_nonzero(~np.isfinite(finite)))
    if missing:
        raise ImageError(
            f"{name} has {counted(missing, 'NaN or infinite value')}. Leave out samples with "
            "missing pixels."
        )
    return finite


def _valid_reference(sample: str, reference: np.ndarray) -> np.ndarray:
    # Whether it must be an image in [0, 1] of the result's size depends on the measurement:
    # `quant.gate.compare`.
    if reference.dtype.kind not in "fuib":
        raise ImageError(
            f"The reference of {sample} must be of real numbers, got {reference.dtype}. {REMEDY}"
        )
    return _finite(f"The reference of {sample}", reference)


def _valid_image(name: str, image: np.ndarray, channels: int, ranges: Ranges | None) -> np.ndarray:
    if image.dtype.kind not in "fui" or len(image) != channels:
        raise ImageError(
            f"The network reads {counted(channels, 'channel')} of numbers, but {name} has "
            f"{counted(len(image), 'channel')} of {image.dtype}. {REMEDY}"
        )
    if not image.size:
        raise ImageError(f"{name} has no pixels: its shape is {format_shape(image)}. {REMEDY}")
    values = _finite(name, image)
    shares = to_shares(values, ranges or ())
    within = shares.min() >= 1 - LARGEST and shares.max() <= LARGEST
    if ranges is not None and not within:
        raise ImageError(
            f"The values of {name} must be in `input_range`, {in_words(ranges or (UNIT,))}, but "
            f"they are {values.min():.4g} to {values.max():.4g}. State a range that holds them."
        )
    # Values that rounding has moved outside, within the tolerance of LARGEST.
    return np.clip(values, 0, 1) if within and not ranges else values


def _cut(
    image: np.ndarray, reference: np.ndarray, name: str, fixed_px: int | None, multiple_px: int
) -> Iterator[Pair]:
    """Yield patches of an image (C, H, W), or the whole where a reference belongs to it."""
    height, width = image.shape[1:]
    size = times((height, width))
    # A reference may be of another size, such as an enlarged image: it cannot be cut.
    if reference.size:
        if fixed_px is not None and (height, width) != (fixed_px, fixed_px):
            raise ImageError(
                f"{name} must have {fixed_px} x {fixed_px} pixels, to which the network is fixed, "
                f"got {size}. {REMEDY}"
            )
        if height % multiple_px or width % multiple_px:
            raise ImageError(
                f"{name} has a reference, so its sides must be multiples of {multiple_px} pixels, "
                f"got {size}. Cut both."
            )
        yield image[None], reference[None]
        return
    # Sides of a strongly strided network may have to be multiples of more than PATCH_PX.
    side = fixed_px or max(PATCH_PX // multiple_px, 1) * multiple_px
    # An image smaller than a patch is one patch, cut to the sides that the network takes.
    rows, columns = (side if n >= side else n // multiple_px * multiple_px for n in image.shape[1:])
    for top in range(0, height - rows + 1, rows):
        for left in range(0, width - columns + 1, columns):
            patch = image[None, :, top : top + rows, left : left + columns]
            yield np.ascontiguousarray(patch), NO_REFERENCE
