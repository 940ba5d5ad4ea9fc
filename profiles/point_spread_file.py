"""Read a point-spread function that a sensor's file names: a .npy file next to the profile."""

import math
from pathlib import Path

import numpy as np
from pydantic.dataclasses import dataclass

from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.response import (
    KEPT_SIDE,
    Array,
    PointSpread,
    SamplesPerPx,
    centroid,
    packed,
)
from beers_deploy.profiles.user_files.arrays import ALONE, load_arrays
from beers_deploy.profiles.validation import CONFIG, validated

FILE_SIDE = 4096
"""The maximum number of samples along one side of a file."""
CUT_SHARE = 1e-6
"""Rows and columns at the border with less than this share of the absolute weight are removed.

No frequency changes by more than twice this share.
"""
OFF_CENTRE_PX = 1.0


@dataclass(frozen=True, config=CONFIG)
class PointSpreadFile:
    """The keys of the table [mtf] of a sensor's file that name a file with its point-spread
    function.

    Attributes:
        psf: path of the .npy file, relative to the folder of the profile.
        psf_samples_per_px: the number of samples per pixel of the sensor in each direction.
    """

    psf: str
    psf_samples_per_px: SamplesPerPx

    def read(self, label: str, folder: Path) -> PointSpread:
        """Read the point-spread function, scale it to a sum of 1, and cut off its empty border.

        Args:
            label: the name of the profile, for error messages.
            folder: the folder of the profile, which must contain the .npy file.

        Raises:
            ProfileError: the path leads out of the folder, the file holds no array of real numbers,
                or the samples are not those of a blur around the middle.
        """
        try:
            inside = (folder / self.psf).resolve().is_relative_to(folder.resolve())
        # A circle of links raises the first, a NUL the second.
        except (OSError, ValueError):
            inside = False
        if not inside:
            raise ProfileError(
                f"{label} mtf.psf must be the name of a file in the profile's folder or below it, "
                f"got {printable(repr(self.psf))}. Copy the file there."
            )
        where = f"{label} mtf.psf ({folder / self.psf})"
        samples = _read_samples(where, folder / self.psf)
        finite = bool(np.isfinite(samples).all())
        # The largest is brought to 1 first, because the sum of finite samples may overflow.
        samples = samples / max(float(np.abs(samples).max()), 1e-300) if finite else samples
        total = float(samples.sum())
        if not finite or total <= 0:
            fault = f"their sum is {total:g}" if finite else "some are NaN or infinite"
            raise ProfileError(
                f"{where} must hold finite samples whose sum is above 0, but {fault}. Correct the "
                "file; a background must be subtracted first."
            )
        samples = samples / total
        shift_px = math.hypot(*centroid(samples)) / self.psf_samples_per_px
        if shift_px > OFF_CENTRE_PX:
            raise ProfileError(
                f"{where} must have its centroid within {OFF_CENTRE_PX:g} target pixel of the "
                f"middle, but it lies {shift_px:.3g} pixels off. Crop the file around its "
                "centroid, and subtract its background."
            )
        # Border rows and columns that hold, in total, less than CUT_SHARE of the weight.
        weight = np.abs(samples)
        parts = []
        for axis in (1, 0):
            grown = np.cumsum(weight.sum(axis)) / weight.sum()
            # Two axes with two ends each: every end may lose a quarter of the share.
            ends = np.searchsorted(grown, (CUT_SHARE / 4, 1 - CUT_SHARE / 4)) + np.array([0, 1])
            parts.append(slice(*ends))
        core = samples[tuple(parts)]
        height, width = core.shape
        if max(height, width) > KEPT_SIDE:
            raise ProfileError(
                f"{where} must have all but a millionth of its weight within {KEPT_SIDE} x "
                f"{KEPT_SIDE} samples, but it takes {width} x {height}. Crop it, or sample it "
                "more coarsely."
            )
        fields = {
            "height": height,
            "width": width,
            "samples": packed(core),
            "samples_per_px": self.psf_samples_per_px,
        }
        return validated(PointSpread, fields, where)


def _read_samples(where: str, path: Path) -> Array:
    """Read the samples (H, W) of a .npy file, or raise ProfileError."""
    try:
        # Mapped: nothing is read before its shape is known.
        samples = load_arrays(path).get(ALONE, np.zeros(0))
        if (
            samples.ndim != 2
            or samples.dtype.kind not in "iuf"
            or not 1 <= min(samples.shape) <= max(samples.shape) <= FILE_SIDE
        ):
            raise ValueError(f"it is {samples.dtype} of shape {samples.shape}")
        return np.asarray(samples, np.float64)
    except ValueError as error:
        raise ProfileError(
            f"{where} is not a .npy file of one array of real numbers, (rows, columns), of at most "
            f"{FILE_SIDE} a side: {printable(str(error))}. Check the path, which is relative to "
            "the profile's folder; crop the array, leave one plane, and save it with numpy.save."
        ) from error
