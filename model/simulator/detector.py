"""What the detectors and the electronics do to the sampled signal, on the target grid: the order
stands here.

Haze before the instrument, saturation and what spills over, fixed-pattern noise of a push-broom
sensor, noise that grows with the light, dead and hot pixels, and the converter. Each random effect
has a generator of its own, keyed by (seed, patch, effect).
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
"""The traditional pipeline computes with tensors."""

NOISE_LIMIT = 6.0
"""Draws are clipped here (two in a billion), so that the effect of noise has a bound."""


def noise_sigma(radiance: np.ndarray, sensor: Instrument) -> np.ndarray:
    """sigma(L) = sqrt(alpha L + beta), in W/m2/sr/um, for radiances of any shape (paper, section
    3.3).

    Ringing can push L below zero, where there is no light to be noisy about: L counts as 0 there. A
    negative variance (possible only for a sensor built by hand) counts as 0 too.
    """
    return np.asarray(np.sqrt(np.maximum(sensor.alpha * np.maximum(radiance, 0) + sensor.beta, 0)))


def add_noise(
    radiance: np.ndarray, sensor: Instrument, generator: np.random.Generator
) -> np.ndarray:
    """L + sigma(L) * n, n standard normal and independent per pixel; any shape."""
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
    """Radiance in W/m2/sr/um of digital numbers of any shape, the offset taken off."""
    return (dn - sensor.offset_dn) / sensor.gain_dn_per_radiance


def to_dn(radiance: Pixels, sensor: Instrument) -> Pixels:
    """Digital numbers of radiances of any shape: `to_radiance` backwards, clipped to the range and
    not rounded.
    """
    return (radiance * sensor.gain_dn_per_radiance + sensor.offset_dn).clip(0, sensor.max_dn)


def to_uint16(dn: np.ndarray) -> np.ndarray:
    """Whole digital numbers of at most 16 bits, of any shape, as the array that
    a TIFF file takes.
    """
    # A cast without a clip would wrap values below 0 around to 65535.
    return np.asarray(np.rint(dn).clip(0, 65535), np.uint16)


@dataclass(frozen=True)
class Draw:
    """What names a patch's randomness: the run's seed and the patch's number."""

    seed: int
    patch: int = 0

    def generator(self, effect: str) -> np.random.Generator:
        """The generator of one effect of this patch; counter-based (Philox), the same on every
        machine.
        """
        # Python's own hash of a text differs from process to process, CRC-32 does not.
        entropy = (self.seed, self.patch, zlib.crc32(effect.encode()))
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))


def detect(
    signal: np.ndarray, sensor: Instrument, draw: Draw, role: str, skip: Collection[str] = ()
) -> np.ndarray:
    """Digital numbers of a blurred, sampled signal (..., H, W) in W/m2/sr/um: whole ones, unless
    told otherwise.

    Args:
        signal: radiance on the target grid.
        sensor: the instrument; it has an effect by having its table.
        draw: seed and patch number; each effect takes its own generator from it.
        role: "degraded" or "reference", so that the two draws of a pair differ.
        skip: effects to leave out, see `plan.Plan.skipped`; without "digitising" they are clipped
            and not rounded.
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
