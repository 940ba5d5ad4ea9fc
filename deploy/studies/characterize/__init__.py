"""Measure a sensor profile from the sensor's own raw frames: the part of `characterize` between
options and TOML.

- `frames`: the frames, the value of one digital number, and the level of the dark
- `measure`: noise and MTF, with intervals
- `profile`: figures, sentences, and the TOML file

Gain, ground sampling distance, black level, and bits unless pixels are clipped at full scale, are
requested from the user or assumed. If no edge gives an MTF, the profile has the user's value or an
assumption instead, marked as such.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from beers_deploy.model.metrics.instrument import snr
from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.profiles.errors import ImageError, counted
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.results import Table, input_of
from beers_deploy.studies.characterize.frames import MAX_DN, cut_box, open_frames
from beers_deploy.studies.characterize.measure import Snr, measure_mtf, measure_noise
from beers_deploy.studies.characterize.profile import (
    FULL_SCALE_RADIANCE,
    PARTS,
    Measurement,
    Stated,
    profile_toml,
)

__all__ = [
    "MeasuredSensor",
    "Measurement",
    "Stated",
    "measure",
    "measured_sensor",
    "profile_toml",
]


def measure(
    images: Sequence[Path], edges: Sequence[str] = (), stated: Stated | None = None
) -> Measurement:
    """Measure noise, MTF and SNR of a sensor from its raw images.

    Args:
        images: raw images of one sensor at one setting: files, and folders of them.
        edges: boxes with one straight edge as FILE:X,Y,WIDTH,HEIGHT in pixels. If empty, edges are
            searched for in the images.
        stated: the values that the user states about the sensor; None states none. A stated MTF is
            not measured.

    Returns:
        The images as frames, the noise as a function of the signal, the MTF curves, the SNRs at two
        radiances, and the gain, which the user states or which is assumed.

    Raises:
        ImageError: there is no image, or the images are not frames of one sensor.
        OptionError: a box or a stated value does not fit the images.
    """
    stated = stated or Stated()
    frames = open_frames(images, stated.bits, stated.black_level)
    regions = {words: cut_box(words, frames) for words in edges}
    noise = measure_noise(frames)
    mtf = measure_mtf(frames, regions, noise.model) if stated.mtf is None else {}
    gain = stated.gain or frames.full_scale_dn / FULL_SCALE_RADIANCE
    snrs = []
    for part in PARTS:
        dn = frames.full_scale_dn / part
        # The noise of rounding is not part of it.
        variance = noise.model.at(dn)
        snrs.append(Snr(dn / gain, *snr(dn, variance), variance.extrapolated))
    return Measurement(frames, noise, mtf, (snrs[0], snrs[1]), gain, stated)


@dataclass(frozen=True, kw_only=True, repr=False)
class MeasuredSensor(Sensor):
    """The profile of a sensor that was measured on its own images, as `characterize` returns it.

    Attributes:
        table: the measured figures with their intervals, and notes for the user.
    """

    table: Table | None = None


def measured_sensor(
    images: Any, edges: Sequence[str], stated: Stated
) -> tuple[MeasuredSensor, str]:
    """Measure a sensor from its raw images, and build its profile.

    Args:
        images: one image or a list of them, each a path or an array (H, W) of integers.
        edges: boxes with one straight edge as FILE:X,Y,WIDTH,HEIGHT in pixels; if empty, edges are
            searched for.
        stated: the values that the user states about the sensor.

    Returns:
        The sensor, and its profile as the text of a TOML file.

    Raises:
        ImageError: an image is no array of integers, or the images are not of one sensor.
        OptionError: a box or a stated value does not fit the images.
    """
    several = images if isinstance(images, list | tuple) else [images]
    with TemporaryDirectory(prefix="beers-deploy-") as folder:
        paths = [
            _as_file(image, Path(folder) / f"image{number}.tif")
            for number, image in enumerate(several)
        ]
        measurement = measure(paths, edges, stated)
        toml = profile_toml(measurement)
        profile = Path(folder) / "measured.toml"
        profile.write_text(toml, encoding="utf-8")
        count = len(measurement.frames.paths)
        table = Table(
            title=f"sensor of {counted(count, 'image')}",
            # The files of arrays are gone after this block: they are digested here.
            inputs=tuple(map(input_of, measurement.frames.paths)),
            rows=tuple(measurement.rows()),
            notes=tuple(measurement.notes()),
        )
        return MeasuredSensor(**vars(Sensor.load(str(profile))), table=table), toml


def _as_file(image: Any, path: Path) -> Path:
    if isinstance(image, str | os.PathLike):
        return Path(image)
    # 0 stands for a missing pixel, as in a file that is read.
    pixels = np.ma.filled(getattr(image, "values", image), 0)
    # Arrays of xarray and rasterio have a first axis for the bands.
    if pixels.ndim == 3 and len(pixels) == 1:
        pixels = pixels[0]
    if pixels.ndim != 2 or pixels.dtype.kind not in "ui":
        raise ImageError(
            "`images` must be integer digital numbers of shape (H, W), but one is "
            f"{pixels.dtype} of shape {pixels.shape}. Give raw pixels of one band."
        )
    if pixels.size and not 0 <= pixels.min() <= pixels.max() <= MAX_DN:
        raise ImageError(
            f"`images` must have digital numbers from 0 to {MAX_DN}, but one has "
            f"{pixels.min()} to {pixels.max()}. Give the raw image."
        )
    write_tiff(path, pixels.astype(np.uint16))
    return path
