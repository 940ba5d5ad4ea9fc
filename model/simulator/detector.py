"""Simulate detectors and electronics on the target grid; this module defines the order of the
effects.

The effects are haze in front of the instrument, saturation and blooming, fixed-pattern noise of a
push-broom sensor, signal-dependent noise, dead and hot pixels, and the converter. Each random
effect has its own generator, keyed by (seed, patch, effect).
"""

import zlib
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from beers_deploy.profiles.effects import pixel_effects
from beers_deploy.profiles.instrument import Instrument

if TYPE_CHECKING:
    from torch import Tensor

Pixels = TypeVar("Pixels", np.ndarray, "Tensor")
"""Arrays or tensors, because the traditional pipeline computes with tensors."""

NOISE_LIMIT = 6.0
"""Draws are clipped here (two in a billion), so that the effect of noise has a bound."""


def noise_sigma(radiance: np.ndarray, sensor: Instrument) -> np.ndarray:
    """Compute sigma(L) = sqrt(alpha L + beta), in W/m2/sr/um, for radiances of any shape (paper,
    section 3.3).

    Ringing can make L negative, where there is no photon noise: L counts as 0 there.
    """
    return np.asarray(np.sqrt(sensor.alpha * np.maximum(radiance, 0) + sensor.beta))


def add_noise(
    radiance: np.ndarray, sensor: Instrument, generator: np.random.Generator
) -> np.ndarray:
    """Add noise: L + sigma(L) * n, with n standard normal and independent per pixel; any shape."""
    normal = generator.standard_normal(radiance.shape, dtype=np.float32)
    # The plan of effects needs a bound of the noise, and a normal number has none.
    np.clip(normal, -NOISE_LIMIT, NOISE_LIMIT, out=normal)
    return radiance + noise_sigma(radiance, sensor) * normal


def digitise(dn: np.ndarray, sensor: Instrument) -> np.ndarray:
    """Round digital numbers, of any shape, to whole ones and clip them to the converter's range.

    Rounding adds 1/12 DN^2 of variance. Clipping comes before any cast, so that nothing wraps
    around.
    """
    return np.asarray(np.rint(dn).clip(0, sensor.max_dn))


def to_radiance(dn: Pixels, sensor: Instrument) -> Pixels:
    """Convert digital numbers of any shape to radiance in W/m2/sr/um, after
    subtracting the offset.
    """
    return (dn - sensor.offset_dn) / sensor.gain_dn_per_radiance


def to_dn(radiance: Pixels, sensor: Instrument) -> Pixels:
    """Convert radiance of any shape to digital numbers, clipped to the range and not rounded.

    It is the inverse of `to_radiance` within the range.
    """
    return (radiance * sensor.gain_dn_per_radiance + sensor.offset_dn).clip(0, sensor.max_dn)


def to_uint16(dn: np.ndarray) -> np.ndarray:
    """Round digital numbers of any shape to uint16, clipped to 16 bits, as stored in
    a TIFF file.
    """
    # A cast without a clip would wrap values below 0 around to 65535.
    return np.asarray(np.rint(dn).clip(0, 65535), np.uint16)


@dataclass(frozen=True)
class Draw:
    """The key of a patch's random numbers: the seed of the run and the number of the patch."""

    seed: int
    patch: int = 0

    def generator(self, effect: str) -> np.random.Generator:
        """Return the generator of one effect of this patch.

        It is counter-based (Philox), so that it is the same on every machine.
        """
        # Python's own hash of a text differs from process to process, CRC-32 does not.
        entropy = (self.seed, self.patch, zlib.crc32(effect.encode()))
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))


def detect(
    signal: np.ndarray, sensor: Instrument, draw: Draw, role: str, skip: Collection[str] = ()
) -> np.ndarray:
    """Compute the digital numbers of a blurred, sampled signal (..., H, W) in W/m2/sr/um.

    Args:
        signal: the radiance at each pixel of the sensor.
        sensor: the instrument. An effect is simulated if the profile has a table for it.
        draw: seed and patch number; each effect derives its own generator from it.
        role: "degraded" or "reference", so that the two draws of a pair differ.
        skip: effects to omit, see `plan.Plan.skipped`; without "digitising" digital numbers are
            clipped and not rounded.

    Returns:
        Digital numbers, which are integers unless "digitising" is skipped.
    """
    effects = {name: effect for name, effect in sensor.effects.items() if name not in skip}

    def apply(image: np.ndarray, acts_on: str) -> np.ndarray:
        for name, effect in pixel_effects(effects, acts_on).items():
            # Each effect has its own generator: leaving one out changes no draw of the others.
            image = effect.apply(image, sensor, partial(draw.generator, f"{name}-{role}"))
        return image

    signal = apply(signal, "radiance")
    if "noise" not in skip:
        # The role belongs to the key, so that the two noises of a pair are independent.
        signal = add_noise(signal, sensor, draw.generator(f"noise-{role}"))
    dn = apply(signal * sensor.gain_dn_per_radiance, "DN")
    return dn.clip(0, sensor.max_dn) if "digitising" in skip else digitise(dn, sensor)
