"""Choose the exposure: dark parts of an image are multiplied before a network sees them, and
divided afterwards.

Inside a network, and in INT8 above all, errors are relative to full scale: its steps add about 2 DN
rms at every level, so in the dark it hardly denoises. An image multiplied by a factor is the image
of a sensor whose gain is larger by that factor. A network that is conditioned on its sensor can be
given that sensor. The same weights therefore restore dark ground as well as bright ground.

A pixel gets the highest factor at which no pixel within the network's receptive radius exceeds
HEADROOM of full scale, and none within EDGE_RADIUS_PX differs too much from its neighbours. The
choice depends only on the pixels that the network reads anyway, so tiles with an exact halo choose
as the whole image does.

Before an integer network, the image can be multiplied further than the training range allows. The
network is then conditioned on a sensor of less gain, and the rest of the factor makes its steps
finer (`Exposure.finer`): a body of convolutions, ReLU and sums passes a positive factor on, so only
its biases must grow with it. Around points of light and edges of saturated areas, the correction
exceeds what INT8 represents. There a factor of 1/2 makes the steps coarser and their range wider.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

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

HEADROOM = 0.8
"""Share of full scale that an image may reach once it was multiplied.

Restored edges overshoot the raw image and INT8 clips large corrections: with the whole of full
scale, bright scenes lost 0.2 dB; from 0.4 to 0.8 none lost, and at a quarter of the radiance 0.8
gains 0.06 dB over 0.6 (measured on training places).
"""

SHARPEST = 0.115
"""The largest difference of a multiplied pixel from the mean of its 3 x 3 neighbourhood, as a share
of full scale.

Beyond it, INT8 clips the correction of `convbeers-s`. At twice and four times the radiance, a
factor of 1/2 there gains 0.20 and 0.34 dB outside saturated pixels; at the radiance of the
photographs it gains 0.01 dB, and 13 % of the squares of 128 pixels have such a place (measured on
training places).
"""

EDGE_RADIUS_PX = 8
"""The distance up to which an edge beyond SHARPEST decides over a pixel's factor.

Within the whole receptive radius, dark ground around lamps was restored in steps twice as coarse:
it lost up to 2 dB on drawn scenes, and photographs gained only 0.04 dB more (measured).
"""

SHARPEST_IN_DARK = 0.2
"""The same at factors above 1, whose networks represent corrections 1.1 to 2.2 times as large.

With 0.115, points of 120 W/m2/sr/um on ground of 20 have 84 instead of 97 % of their flux, because
the ground around them is restored at another exposure than the rest (measured).
"""

NOISE_BEYOND = 1.25
"""The largest ratio of the noise to that of the training range.

At 1.25 times the networks still gain 0.1 to 0.8 dB, at 1.4 times they lose 0.2 dB in some scenes,
at twice 4 dB (measured).
"""

INTEGER_FACTORS = (2, 4, 8, 16)
"""The factors by which images are multiplied before an integer network."""

INTEGER_STEP = 4
"""The ratio of the two factors that an integer network uses. The factor between them gains less
than 0.02 dB (measured on training places).
"""

INTEGER_NOISE = 2.5
"""The largest ratio of the multiplied image's noise to that of the training range.

Up to 2.4 times, `convbeers-s` gained 0.03 to 0.45 dB at a twentieth of the radiance. At 4 times, it
lost up to 0.4 dB behind some sensors (measured on training places).
"""

FINEST = 4
"""The largest `Exposure.finer`. The features of a network that encode brightness grow with it as
well, and at 8 they are clipped: for the noisiest sensor the result then lost 2 dB (measured on
training places).
"""

GAIN_NOISE = 1.1
"""The largest ratio of the noise that an integer network is conditioned on to that of the training
range.

It may be less than NOISE_BEYOND, because finer steps replace the rest of the factor: at 1.15 times
a network lost 0.1 dB to one of half the gain (measured on training places).
"""


@dataclass(frozen=True)
class Exposure:
    """A factor by which pixels are multiplied, and the sensor that the network is conditioned on.

    Attributes:
        factor: the factor, a power of two; 1 for pixels that stay as they are.
        gain: the part of the factor, a power of two, by which the gain of that sensor exceeds the
            gain of the sensor that acquired the image.
    """

    factor: float = 1
    gain: int = 1

    @property
    def finer(self) -> float:
        """The rest of the factor, by which the steps of an integer network become finer."""
        return self.factor / self.gain


UNCHANGED = Exposure()
"""The exposure of pixels that are restored as they are."""

DIMMED = Exposure(factor=0.5)
"""The exposure of pixels near points of light and strong edges, in an integer network."""


def factors_for(sensor: Instrument) -> tuple[int, ...]:
    """Return the exposure factors that a network conditioned on `sensor` was trained for, in rising
    order.

    An exposure factor multiplies the pixel values of dark ground before the network; 1 is always
    among them.

    A factor raises the noise over full scale. It is excluded if the noise exceeds the training
    range by more than NOISE_BEYOND.
    """
    usable = [factor for factor in FACTORS if noise_excess(sensor, factor) <= NOISE_BEYOND]
    return (1, *usable[-MOST_FACTORS:])


def exposures_for(sensor: Instrument, *, int8: bool) -> tuple[Exposure, ...]:
    """Return the exposures of a network conditioned on `sensor`, in rising order of their factors.

    Args:
        sensor: the sensor of the images.
        int8: True for an integer network, whose steps may be made finer or coarser; False for a
            float one, whose sensor has the whole factor as gain.
    """
    if not int8:
        return tuple(Exposure(factor, factor) for factor in factors_for(sensor))
    excess = {factor: noise_excess(sensor, factor) for factor in INTEGER_FACTORS}
    gain = max((f for f in FACTORS if excess[f] <= GAIN_NOISE), default=1)
    possible = [f for f in INTEGER_FACTORS if f <= FINEST * gain]
    usable = [f for f in possible if f <= gain or excess[f] <= INTEGER_NOISE]
    highest = usable[-1] if usable else 1
    factors = [f for f in (highest // INTEGER_STEP, highest) if f > 1]
    return (DIMMED, UNCHANGED, *(Exposure(factor, min(factor, gain)) for factor in factors))


def noise_excess(sensor: Instrument, factor: float) -> float:
    """Return the noise over full scale of a sensor of `factor` times the gain, relative to the end
    of the training range.
    """
    brighter = replace(sensor, gain_dn_per_radiance=sensor.gain_dn_per_radiance * factor)
    values = sensor_values(brighter)
    return max(values[key] / RANGES[key][1] for key in ("sigma_dark", "sigma_bright"))


def brightened(sensor: Sensor, factor: int) -> Sensor:
    """Return the profile of a sensor of `factor` times the gain, otherwise the same."""
    return sensor.replace(gain_dn_per_radiance=sensor.gain_dn_per_radiance.low * factor)


def edge_radius_px(radius_px: int) -> int:
    """Return the distance up to which an edge decides over the factor of a pixel, for a network of
    a receptive radius.
    """
    # A pixel's neighbourhood extends by one pixel, which must lie within the radius as well.
    return max(min(EDGE_RADIUS_PX, radius_px - 1), 0)


def choose_factors(
    image: NDArray[np.float32],
    factors: Iterable[float],
    radius_px: int,
    full_scale: float,
    offset: float,
) -> NDArray[np.float64]:
    """Choose for every pixel the factor that multiplies it before the network.

    A pixel gets the largest factor at which no pixel within `radius_px` exceeds HEADROOM, and none
    within EDGE_RADIUS_PX differs from its neighbours by more than SHARPEST_IN_DARK. Dark ground is
    so restored at a higher exposure, and little is clipped. A factor of 1 leaves pixels at their
    brightness, whatever that is, and its limit is SHARPEST. If no factor suits, a pixel gets the
    smallest one.

    Args:
        image: (h, w) pixel values, none missing.
        factors: in rising order.
        radius_px: receptive radius of the network.
        full_scale: the pixel value that is 1.0 to the network.
        offset: the pixel value of the dark, which is no light and is not multiplied.

    Returns:
        (h, w) one of `factors` for each pixel; exact where `radius_px` more pixels around it are in
            `image`.
    """
    brightest = maximum_filter(image, 2 * radius_px + 1, mode="nearest") - offset
    sharp = np.abs(image - uniform_filter(image, 3, mode="nearest"))
    sharpest = maximum_filter(sharp, 2 * edge_radius_px(radius_px) + 1, mode="nearest")
    smallest, *others = factors
    pixel_factors = np.full(image.shape, smallest, np.float64)
    for factor in others:
        limit = SHARPEST if factor == 1 else SHARPEST_IN_DARK
        fits = sharpest * factor <= limit * full_scale
        if factor > 1:
            fits &= brightest * factor + offset <= HEADROOM * full_scale
        # The factors rise, so that a higher one that fits replaces a lower one.
        pixel_factors[fits] = factor
    return pixel_factors
