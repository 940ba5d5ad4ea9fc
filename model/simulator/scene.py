"""A scene: radiance in W/m2/sr/um on a grid finer than the sensor's, read from an image file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from model.images import read_pixels
from profiles.errors import ImageError
from profiles.sensor import Sensor


@dataclass(frozen=True)
class Scene:
    """Radiance (H, W) float32 in W/m2/sr/um, and the name it goes by."""

    name: str
    radiance: Tensor


def read_scene(path: Path, sensor: Sensor) -> Scene:
    """Read a scene from an image file.

    1. 8-bit RGB or mono: sRGB, linearised, the bands averaged (a panchromatic band weighs the visible evenly:
       an assumption); white stands for the sensor's full scale.
    2. 16-bit mono TIFF or PNG: digital numbers, made radiance by the sensor's gain.
    3. float mono TIFF: radiance in W/m2/sr/um as it stands.

    Raises:
        ImageError: not an image, or pixels of another kind.
    """
    pixels = read_pixels(path)
    radiance: np.ndarray
    if pixels.dtype == np.uint8:
        radiance = _linear(pixels) * (sensor.max_dn / sensor.gain_dn_per_radiance)
    elif pixels.ndim == 2 and pixels.dtype == np.uint16:
        radiance = pixels.astype(np.float32) / np.float32(sensor.gain_dn_per_radiance)
    elif pixels.ndim == 2 and np.issubdtype(pixels.dtype, np.floating):
        radiance = pixels.astype(np.float32)
    else:
        raise ImageError(
            str(path),
            expected="8-bit RGB or mono, 16-bit mono, or float mono pixels",
            got=f"{pixels.dtype} of shape {pixels.shape}",
            remedy="convert it to one of these",
        )
    return Scene(path.name, torch.from_numpy(np.ascontiguousarray(radiance, dtype=np.float32)))


def _linear(pixels: np.ndarray) -> np.ndarray:
    """8-bit sRGB to linear light in [0, 1], bands averaged (IEC 61966-2-1)."""
    code = np.arange(256) / 255
    table = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)
    light: np.ndarray = table[pixels]
    return np.asarray(light if light.ndim == 2 else light[..., :3].mean(axis=-1))
