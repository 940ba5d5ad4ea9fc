"""What the detectors and the electronics do to the sampled signal, on the target grid: the order stands here.

Haze before the instrument, saturation and what spills over, fixed-pattern noise of a push-broom sensor, noise that
grows with the light, dead and hot pixels, and the converter. Each random effect has a generator of its own, keyed
by (seed, patch, effect).
"""

import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from beers_deploy.profiles.effects import Defects, Dsnu, Effect, FullWell, Haze, Offset, Prnu, Striping
from beers_deploy.profiles.sensor import Instrument

if TYPE_CHECKING:
    from torch import Tensor

Pixels = TypeVar("Pixels", np.ndarray, "Tensor")
"""The traditional chain computes with tensors."""

NOISE_LIMIT = 6.0
"""Draws are clipped here (two in a billion), so that the effect of noise has a bound."""


def noise_sigma(radiance: np.ndarray, sensor: Instrument) -> np.ndarray:
    """sigma(L) = sqrt(alpha L + beta), in W/m2/sr/um, for radiances of any shape (paper, section 3.3).

    Ringing can push L below zero, where there is no light to be noisy about: L counts as 0 there. A negative
    variance (possible only for a sensor built by hand) counts as 0 too.
    """
    return np.asarray(np.sqrt(np.maximum(sensor.alpha * np.maximum(radiance, 0) + sensor.beta, 0)))


def add_noise(radiance: np.ndarray, sensor: Instrument, generator: np.random.Generator) -> np.ndarray:
    """L + sigma(L) * n, n standard normal and independent per pixel; any shape."""
    normal = generator.standard_normal(radiance.shape, dtype=np.float32)
    np.clip(normal, -NOISE_LIMIT, NOISE_LIMIT, out=normal)
    return radiance + noise_sigma(radiance, sensor) * normal


PATTERN_LIMIT = 4.0
"""Detectors further out are rejected at the factory: draws are clipped here, so that bounds can be proven."""


def _columns(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """One clipped standard normal number a column, (W,) float32."""
    draw = generator.standard_normal(image.shape[-1], dtype=np.float32)
    return np.asarray(np.clip(draw, -PATTERN_LIMIT, PATTERN_LIMIT))


def saturate(radiance: np.ndarray, well: FullWell) -> np.ndarray:
    """L' = min(L + share * (k * max(L - well, 0)), well), in W/m2/sr/um.

    k spreads the excess up and down the column, falling by e every `blooming_px` pixels, and sums to 1 at most
    (what leaves the image is lost). Limits: below the well nothing changes; share 0 is a plain clip.
    """
    excess = np.maximum(radiance - well.radiance, 0)
    if well.blooming_share > 0 and well.blooming_px > 0 and (excess > 0).any():
        radiance = radiance + well.blooming_share * _spread(excess, well.blooming_px)
    return np.asarray(np.minimum(radiance, well.radiance))


def _spread(excess: np.ndarray, length_px: float) -> np.ndarray:
    """Convolve each column of (..., H, W) with the two-sided exponential without its centre, normalised."""
    radius = min(int(6 * length_px) + 1, excess.shape[-2] - 1)
    if radius < 1:
        return np.zeros_like(excess)
    distance = np.abs(np.arange(-radius, radius + 1, dtype=np.float64))
    with np.errstate(over="ignore"):  # of a length near 0 no neighbour is reached
        kernel = np.exp(-distance / length_px) * (distance > 0)
    if kernel.sum() == 0:  # so short that not even a neighbour is reached
        return np.zeros_like(excess)
    from scipy.ndimage import convolve1d  # a sixth of a second to load, for what few sensors have

    return np.asarray(convolve1d(excess, kernel / kernel.sum(), axis=-2, mode="constant"))


def add_defects(dn: np.ndarray, defects: Defects, max_dn: int, generator: np.random.Generator) -> np.ndarray:
    """Pixels of DN (H, W) dead (0 DN) or hot (max_dn), each at its rate per million; rates 0 change nothing."""
    draw = generator.random(dn.shape, dtype=np.float32)
    dead, hot = defects.dead_per_million / 1e6, defects.hot_per_million / 1e6
    dn = np.where(draw < dead, np.float32(0), dn)
    # One draw decides both, so a pixel is never dead and hot.
    return np.where(draw >= 1 - hot, np.float32(max_dn), dn) if hot > 0 else dn


def digitise(dn: np.ndarray, sensor: Instrument) -> np.ndarray:
    """Round digital numbers, of any shape, to whole ones and clip them to the converter's range.

    Rounding adds 1/12 DN^2 of variance. Clipping comes before any cast, so that nothing wraps around.
    """
    return np.asarray(np.rint(dn).clip(0, sensor.max_dn))


def to_radiance(dn: Pixels, sensor: Instrument) -> Pixels:
    """Radiance in W/m2/sr/um of digital numbers of any shape, the offset taken off."""
    return (dn - sensor.offset_dn) / sensor.gain_dn_per_radiance


def to_dn(radiance: Pixels, sensor: Instrument) -> Pixels:
    """Digital numbers of radiances of any shape: `to_radiance` backwards, clipped to the range and not rounded."""
    return (radiance * sensor.gain_dn_per_radiance + sensor.offset_dn).clip(0, sensor.max_dn)


def to_uint16(dn: np.ndarray) -> np.ndarray:
    """Whole digital numbers of at most 16 bits, of any shape, as the array that a TIFF file takes."""
    return np.asarray(np.rint(dn).clip(0, 65535), np.uint16)


@dataclass(frozen=True)
class Draw:
    """What names a patch's randomness: the run's seed and the patch's number."""

    seed: int
    patch: int = 0

    def generator(self, effect: str) -> np.random.Generator:
        """The generator of one effect of this patch; counter-based (Philox), the same on every machine."""
        entropy = (self.seed, self.patch, zlib.crc32(effect.encode()))
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))


RADIANCE_EFFECTS = ("veil", "full_well", "prnu")
DN_EFFECTS = ("dsnu", "striping", "offset", "defects")


def detect(signal: np.ndarray, sensor: Instrument, draw: Draw, role: str, skip: Collection[str] = ()) -> np.ndarray:
    """Digital numbers of a blurred, sampled signal (..., H, W) in W/m2/sr/um: whole ones, unless told otherwise.

    Args:
        signal: radiance on the target grid.
        sensor: the instrument; it has an effect by having its table.
        draw: seed and patch number; each effect takes its own generator from it.
        role: "degraded" or "reference", so that the two draws of a pair differ.
        skip: effects to leave out, see `plan.Plan.skipped`; without "digitising" they are clipped and not rounded.
    """
    wanted = {name: effect for name, effect in sensor.effects.items() if name not in skip}

    def apply(image: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        for name in names:
            if name in wanted:
                image = apply_effect(image, wanted[name], sensor, partial(draw.generator, f"{name}-{role}"))
        return image

    signal = apply(signal, RADIANCE_EFFECTS)
    if "noise" not in skip:
        signal = add_noise(signal, sensor, draw.generator(f"noise-{role}"))
    dn = apply(signal * sensor.gain_dn_per_radiance, DN_EFFECTS)
    return dn.clip(0, sensor.max_dn) if "digitising" in skip else digitise(dn, sensor)


def apply_effect(
    image: np.ndarray, effect: Effect, sensor: Instrument, generator: Callable[[], np.random.Generator]
) -> np.ndarray:
    """Apply one effect of the target grid to an image (..., H, W); the generator is made only for those that draw."""
    match effect:
        case Haze():  # the same before and after the blur, whose gain at frequency 0 is 1
            return image * effect.transmittance + effect.path_radiance
        case FullWell():
            return saturate(image, effect)
        case Prnu():
            return image * (1 + effect.rms * _columns(image, generator()))
        case Dsnu():
            return image + effect.rms_dn * _columns(image, generator())
        case Striping():  # half of it added to even columns and taken from odd ones
            return image + effect.odd_even_dn * (0.5 - (np.arange(image.shape[-1]) % 2).astype(image.dtype))
        case Offset():
            return image + effect.offset_dn
        case Defects():
            return add_defects(image, effect, sensor.max_dn, generator())
        case _:
            return image  # anti-alias and smear: part of the transfer function
