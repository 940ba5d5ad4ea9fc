"""Choose the exposure: dark parts of an image are multiplied before a network sees them, and
divided afterwards.

Inside a network, and in INT8 above all, errors are relative to full scale: its steps add about 2 DN
rms at every level, so in the dark it hardly denoises. An image multiplied by a factor is the image
of a sensor whose gain is larger by that factor. A network that is conditioned on its sensor can be
given that sensor. The same weights therefore restore dark ground as well as bright ground.

A pixel gets the highest factor at which no pixel within the network's receptive radius exceeds
HEADROOM of full scale. The choice depends only on the pixels that the network reads anyway, so
tiles with an exact halo choose as the whole image does.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from beers_deploy.model.family import RANGES, sensor_values
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor

FACTORS = (2, 4, 8)
"""Powers of two, by which an image is multiplied without rounding."""

MOST_FACTORS = 2
"""Only the highest of the possible factors are used. Each factor that a tile needs costs one more
run of the network, and a factor of 2 below 4 and 8 gains less than 0.02 dB (measured on training
places).
"""

HEADROOM = 0.6
"""Share of full scale that an image may reach once it was multiplied.

Restored edges overshoot the raw image and INT8 clips large corrections: with the whole of full
scale, bright scenes lost 0.2 dB; from 0.4 to 0.8 none lost (measured on training places).
"""

NOISE_BEYOND = 1.25
"""How far the noise may exceed that of the training range.

At 1.25 times the networks still gain 0.1 to 0.8 dB, at 1.4 times they lose 0.2 dB in some scenes,
at twice 4 dB (measured).
"""


def factors_for(sensor: Instrument) -> tuple[int, ...]:
    """Return the exposure factors that a network conditioned on `sensor` can use, in rising order.

    An exposure factor multiplies the pixel values of dark ground before the network; 1 is always
    among them.

    A factor raises the noise over full scale. It is excluded if the noise exceeds the training
    range by more than NOISE_BEYOND.
    """
    usable = [factor for factor in FACTORS if _within_training(sensor, factor)]
    return (1, *usable[-MOST_FACTORS:])


def _within_training(sensor: Instrument, factor: int) -> bool:
    brighter = replace(sensor, gain_dn_per_radiance=sensor.gain_dn_per_radiance * factor)
    values = sensor_values(brighter)
    return all(
        values[key] <= NOISE_BEYOND * RANGES[key][1] for key in ("sigma_dark", "sigma_bright")
    )


def brightened(sensor: Sensor, factor: int) -> Sensor:
    """Return the profile of a sensor of `factor` times the gain, otherwise the same."""
    return sensor.replace(gain_dn_per_radiance=sensor.gain_dn_per_radiance.low * factor)


def choose_factors(
    image: NDArray[np.float32],
    factors: Iterable[int],
    radius_px: int,
    full_scale: float,
    offset: float,
) -> NDArray[np.int64]:
    """Choose for every pixel the factor that multiplies it before the network.

    A pixel gets the largest factor at which no pixel within `radius_px` exceeds HEADROOM, so that
    dark ground is restored at a higher exposure and nothing is clipped.

    Args:
        image: (h, w) pixel values, none missing.
        factors: in rising order, 1 first.
        radius_px: receptive radius of the network.
        full_scale: the pixel value that is 1.0 to the network.
        offset: the pixel value of the dark, which is no light and is not multiplied.

    Returns:
        (h, w) one of `factors` for each pixel; exact where `radius_px` more pixels around it are in
            `image`.
    """
    size = 2 * radius_px + 1
    brightest_in_column = maximum_filter1d(image, size, axis=0, mode="nearest")
    brightest = maximum_filter1d(brightest_in_column, size, axis=1, mode="nearest")
    pixel_factors = np.ones(image.shape, np.int64)
    for factor in factors:
        # The factors rise, so that a higher one that fits replaces a lower one.
        if factor > 1:
            fits = (brightest - offset) * factor + offset <= HEADROOM * full_scale
            pixel_factors[fits] = factor
    return pixel_factors
