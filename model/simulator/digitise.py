"""The converter: radiance to whole digital numbers, and back."""

import numpy as np
from torch import Tensor

from profiles.sensor import Sensor


def digitise(radiance: Tensor, sensor: Sensor) -> Tensor:
    """DN = min(max(round(gain * L), 0), 2^bits - 1), as float32, L in W/m2/sr/um."""
    return digitise_dn(radiance * sensor.gain_dn_per_radiance, sensor)


def digitise_dn(dn: Tensor, sensor: Sensor) -> Tensor:
    """Round to whole digital numbers and clip to the converter's range.

    Rounding adds 1/12 DN^2 of variance. Clipping comes before any cast, so that nothing wraps around.
    """
    return dn.round().clamp(0, sensor.max_dn)


def to_radiance(dn: Tensor, sensor: Sensor) -> Tensor:
    """Radiance in W/m2/sr/um of digital numbers, the offset taken off."""
    return (dn - sensor.offset_dn) / sensor.gain_dn_per_radiance


def to_dn(radiance: Tensor, sensor: Sensor) -> Tensor:
    """The inverse of `to_radiance`, clipped to the converter's range and not rounded."""
    return (radiance * sensor.gain_dn_per_radiance + sensor.offset_dn).clamp(0, sensor.max_dn)


def to_uint16(dn: Tensor) -> np.ndarray:
    """Whole digital numbers of at most 16 bits as the array that a TIFF file takes."""
    return np.asarray(dn.round().clamp(0, 65535).cpu().numpy().astype(np.uint16))
