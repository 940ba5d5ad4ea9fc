"""How brightly the ground of calibration and gate patches is lit, so that together they cover the
sensor's range.

Scenes as they are drawn leave most of the range empty: 2 pixels in 100 000 lie above 0.7 of full
scale. A network that clips bright ground then passes the gate, and a network calibrated on them
does clip it. So a stated share of the patches is lit as on a dark day, up to full scale, and beyond
it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beers_deploy.profiles.instrument import Instrument

DARKEST = 1 / 20
DARK = 1 / 4
"""Factors on the radiance of patches lit as on a dark day, log-uniform between the two."""

BRIGHTEST_PIXELS = 0.999
"""The quantile of a bright patch that comes to lie near full scale."""

BRIGHT = (0.75, 1.0)
"""Where that quantile lies, over full scale."""

SATURATED = (0.005, 0.05)
"""Share of the pixels of a saturated patch whose radiance exceeds full scale."""


@dataclass(frozen=True)
class Lighting:
    """One way to light the ground.

    Attributes:
        name: of the lighting.
        share: of the patches that are lit so.
        factor: returns the factor on the radiance (h, w) in W/m2/sr/um, given the radiance at full
            scale.
    """

    name: str
    share: float
    factor: Callable[[NDArray[np.floating], float, np.random.Generator], float]


def _as_drawn(
    radiance: NDArray[np.floating], full_scale: float, generator: np.random.Generator
) -> float:
    del radiance, full_scale, generator
    return 1.0


def _dark(
    radiance: NDArray[np.floating], full_scale: float, generator: np.random.Generator
) -> float:
    del radiance, full_scale
    # Uniform in the logarithm, so that each factor of two of the darkness is equally likely.
    return float(np.exp(generator.uniform(np.log(DARKEST), np.log(DARK))))


def _bright(
    radiance: NDArray[np.floating], full_scale: float, generator: np.random.Generator
) -> float:
    return _factor_to(
        float(np.quantile(radiance, BRIGHTEST_PIXELS)), full_scale * generator.uniform(*BRIGHT)
    )


def _saturated(
    radiance: NDArray[np.floating], full_scale: float, generator: np.random.Generator
) -> float:
    return _factor_to(float(np.quantile(radiance, 1 - generator.uniform(*SATURATED))), full_scale)


def _factor_to(radiance: float, target: float) -> float:
    """Return target / radiance; 1 for ground without any light, which no factor brightens."""
    return target / radiance if radiance > 0 else 1.0


CALIBRATION = (
    Lighting("as drawn", 13 / 16, _as_drawn),
    Lighting("bright", 2 / 16, _bright),
    Lighting("dark", 1 / 16, _dark),
)
"""Up to full scale, but not beyond: at the edge of a saturated area a network corrects much and in
vain, because the result is clipped, and steps that hold such corrections are coarser everywhere.
With a sixteenth of saturated patches a DnCNN lost 0.2 dB more on photographs; with a quarter of
bright and an eighth of saturated ones a U-Net lost 0.41 dB instead of 0.17 (measured).
"""

JUDGING = (
    Lighting("as drawn", 12 / 16, _as_drawn),
    Lighting("bright", 2 / 16, _bright),
    Lighting("dark", 1 / 16, _dark),
    Lighting("saturated", 1 / 16, _saturated),
)
"""The gate also looks at the surroundings of saturated areas."""


def assign_lightings(
    count: int, lightings: Sequence[Lighting], generator: np.random.Generator
) -> list[Lighting]:
    """Return a lighting for each of `count` patches, in random order, in their shares."""
    ends = np.cumsum([lighting.share for lighting in lightings])
    # Each patch stands for the middle of an equal part of [0, 1], which rounds the shares to whole
    # patches.
    middles = (np.arange(count) + 0.5) / count
    numbers = np.searchsorted(ends, middles)
    return [lightings[number] for number in generator.permutation(numbers)]


def full_scale_radiance(sensor: Instrument) -> float:
    """Return the radiance in W/m2/sr/um that the sensor's largest digital number stands for."""
    return (sensor.max_dn - sensor.offset_dn) / sensor.gain_dn_per_radiance
