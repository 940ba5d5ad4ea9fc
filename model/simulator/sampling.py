"""Read a scene from an image file as radiance in W/m2/sr/um, blur it and sample it onto the
sensor's grid.

Every r-th point of the blurred scene is sampled, centred, without a shift.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import fft

from beers_deploy.model.raster.images import read_pixels
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument

logger = logging.getLogger(__name__)

SATURATED_SHARE = 0.5
"""The share of a scene above full scale from which its counts are taken for those of another
scale.
"""


def scene_spectrum(radiance: np.ndarray) -> np.ndarray:
    """Compute the half spectrum (..., H, W // 2 + 1) of a scene (..., H, W), for any number of
    sensors.
    """
    return np.asarray(fft.rfft2(radiance))


def sample(
    spectrum: np.ndarray,
    transfer: np.ndarray,
    width: int,
    oversampling: int,
) -> np.ndarray:
    """Blur a scene by `transfer`, and sample it at the centre of each target pixel.

    Target pixel n covers scene pixels r*n to r*n + r - 1, so it is sampled at their centre, r*n +
    (r - 1) / 2. For even r that lies between two scene pixels: a phase ramp goes there, where
    slicing would shift by half a pixel.

    Args:
        spectrum: (..., H, W // 2 + 1) complex, of a scene whose H and W are multiples of r.
        transfer: (H, W // 2 + 1), see `mtf.transfer_function`.
        width: W in scene pixels.
        oversampling: r, scene pixels per target pixel.

    Returns:
        (..., H / r, W / r) float32. The borders wrap: crop a margin of real scene.
    """
    height = spectrum.shape[-2]
    centre = (oversampling - 1) / 2
    # For even r the centre lies between two scene pixels: slicing alone would shift the image.
    ramp_y = _ramp(np.fft.fftfreq(height), centre)
    ramp_x = _ramp(np.fft.rfftfreq(width), centre)
    # Keeping every r-th row is adding up the r aliases of each frequency: what follows is r times
    # smaller.
    rows = height // oversampling
    blurred = spectrum * transfer
    blurred *= ramp_y[:, None]
    aliases = blurred.reshape(*blurred.shape[:-2], oversampling, rows, -1)
    folded = aliases.sum(-3) * (ramp_x / oversampling)
    lines = fft.irfft(
        fft.ifft(folded, axis=-2, overwrite_x=True), n=width, axis=-1, overwrite_x=True
    )
    return np.ascontiguousarray(lines[..., ::oversampling])


def crop_divisible(radiance: np.ndarray, oversampling: int) -> np.ndarray:
    """Cut the last rows and columns of (..., H, W), so that H and W are multiples of the
    oversampling.
    """
    height, width = (size // oversampling * oversampling for size in radiance.shape[-2:])
    if not (height and width):
        raise ImageError(
            f"The scene must have at least {oversampling} pixels a side, one pixel of the sensor. "
            "Give a larger scene or a smaller oversampling."
        )
    return radiance[..., :height, :width]


def resample(radiance: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resample a scene (H, W) onto another grid over the same ground, band-limited, for non-integer
    ratios.

    Frequencies below the Nyquist frequency of both grids are unchanged, and all others are zero: at
    Nyquist itself, a grid holds waves of one phase alone. Pixel n of the new grid lies at (n + 1/2)
    H / height - 1/2 of the old, so that the ground does not shift. The borders wrap.

    scikit-image's `resize` is not used, because its splines blur and alias, on a photograph by 26
    of 255 and more (measured).
    """
    old_height, old_width = radiance.shape[-2:]
    ramp_y = _ramp(np.fft.fftfreq(old_height), (old_height / height - 1) / 2)
    ramp_x = _ramp(np.fft.rfftfreq(old_width), (old_width / width - 1) / 2)
    spectrum = scene_spectrum(radiance) * ramp_y[:, None] * ramp_x
    rows = min(old_height, height)
    columns = min(old_width, width)
    top = (rows + 1) // 2
    bottom = (rows - 1) // 2
    half = (columns + 1) // 2
    resampled = np.zeros((height, width // 2 + 1), spectrum.dtype)
    resampled[:top, :half] = spectrum[:top, :half]
    resampled[height - bottom :, :half] = spectrum[old_height - bottom :, :half]
    # The inverse transform divides by the points of the new grid, not of the old one.
    scale = height * width / (old_height * old_width)
    return np.asarray(fft.irfft2(resampled, s=(height, width)) * scale)


def _ramp(frequency: np.ndarray, shift_px: float) -> np.ndarray:
    return np.exp(2j * np.pi * frequency * shift_px).astype(np.complex64)


@dataclass(frozen=True)
class Scene:
    """The radiance (H, W) float32 of a scene in W/m2/sr/um, and its name."""

    name: str
    radiance: np.ndarray


def read_scene(path: Path, sensor: Instrument) -> Scene:
    """Read a scene from an image file.

    1. 8-bit RGB or mono: sRGB, linearised, the bands averaged (it is assumed that a panchromatic
       band weights the visible evenly); white corresponds to the sensor's full scale.
    2. 16-bit mono TIFF or PNG: digital numbers, converted to radiance by the sensor's gain.
    3. float mono TIFF: radiance in W/m2/sr/um.
    """
    return scene_of(path.name, read_pixels(path), sensor)


def scene_of(name: str, pixels: np.ndarray, sensor: Instrument) -> Scene:
    """Convert the pixels of an image to a scene, as `read_scene` does for a file.

    Warns if more than half of the scene is brighter than the sensor's full scale, as counts of
    another scale are: such a scene is saturated.

    Raises:
        ImageError: pixels of another kind, or without a value.
    """
    radiance: np.ndarray
    if pixels.dtype == np.uint8:
        # 8-bit sRGB becomes linear light in [0, 1] (IEC 61966-2-1), and bands are averaged.
        # scikit-image linearises only in its conversion to XYZ, which weights them as an eye does.
        code = np.arange(256) / 255
        curve = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
        light = curve.astype(np.float32)[pixels]
        light = light if light.ndim == 2 else light[..., :3].mean(axis=-1)
        radiance = light * (sensor.max_dn / sensor.gain_dn_per_radiance)
    elif pixels.ndim == 2 and pixels.dtype == np.uint16:
        radiance = pixels.astype(np.float32) / np.float32(sensor.gain_dn_per_radiance)
    elif pixels.ndim == 2 and np.issubdtype(pixels.dtype, np.floating):
        radiance = pixels.astype(np.float32)
        if not np.isfinite(radiance).all():
            raise ImageError(f"{name} has pixels that are NaN or infinite. Crop them off.")
    else:
        raise ImageError(
            f"{name} must have 8-bit RGB or mono, 16-bit mono, or float mono pixels, but it has "
            f"{pixels.dtype} pixels of shape {pixels.shape}. Convert it to one of these."
        )
    full = sensor.max_dn / sensor.gain_dn_per_radiance
    above = np.count_nonzero(radiance > np.float32(full)) / max(radiance.size, 1)
    if above > SATURATED_SHARE:
        logger.warning(
            "%s: %.0f %% of its pixels are above the sensor's full scale of %d DN or %.4g "
            "W/m2/sr/um and will saturate; rescale it",
            name,
            100 * above,
            sensor.max_dn,
            full,
        )
    return Scene(name, np.ascontiguousarray(radiance, dtype=np.float32))
