"""Smooth the noise that a network leaves in the dark parts of a restored image.

Around a pixel a network sees 20 pixels or fewer, so that it leaves more noise in flat ground than
the traditional pipeline, which averages over similar patches far away. In bright scenes this hardly
matters.

    a  = max(v - n, 0) / v
    x' = mean(a) x + mean((1 - a) m)

m and v are the mean and the variance of the restored pixels x in a window of WINDOW_PX x WINDOW_PX,
and the means are taken over the windows that contain a pixel: a guided filter whose guide is the
image itself (He, Sun and Tang, IEEE TPAMI 2013). n is the variance that counts as noise:

    n = SHARE max(variance(m) - (m / LIGHT)^2, 0)

variance(m) is that of the raw image's noise at the light m. Windows with more variance than n are
hardly changed, and those whose light is LIGHT times its noise or more are not changed at all. Only
arrays with a pixel below that light take time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.consistency.blocks import Image, weighted_sums
from beers_deploy.profiles.instrument import Instrument, PixelNoise, pixel_noise

WINDOW_PX = 3
"""Side of a window. One of 5 pixels gains as much and takes longer (measured)."""

SHARE = 0.04
"""The share of the raw image's variance that counts as noise.

On 20 training places at a twentieth of the radiance it gains convbeers-half-xs, convbeers-s and
convbeers in INT8 0.07, 0.04 and 0.03 dB, and behind SNR 15 / 50 0.70, 0.20 and 0.07 dB. A share of
0.1 gains the first 0.11 and 1.05 dB, but takes texture from the last, which loses 0.03 dB behind
the noisier sensor (measured).
"""

LIGHT = 40.0
"""The signal-to-noise ratio of the raw image from which nothing is smoothed.

Without this limit the gain is as large, and brighter images take time too (measured).
"""

SMOOTH_PX = 2 * (WINDOW_PX // 2)
"""A smoothed pixel depends on restored pixels up to this distance."""


@dataclass(frozen=True)
class Smoothing:
    """The step that smooths the restored images of one sensor.

    Attributes:
        noise: the variance n, which counts as 0 where it is negative.
    """

    noise: PixelNoise

    @classmethod
    def of(cls, sensor: Instrument, full_scale: float) -> "Smoothing":
        """Build the step for restored images of a sensor.

        Args:
            sensor: the instrument that acquired the raw images.
            full_scale: the pixel value that is the sensor's largest digital number.
        """
        dark, growth, square, offset = pixel_noise(sensor, full_scale)
        square -= 1 / LIGHT**2
        return cls(PixelNoise(SHARE * dark, SHARE * growth, SHARE * square, offset))

    def smoothed(self, restored: Image) -> Image:
        """Return smoothed pixels, (h, w) float32; `restored` itself if it has no dark pixel.

        Every pixel is computed by the same float32 operations in the same order wherever the array
        begins in the image. Pixels within SMOOTH_PX of a missing one are returned unchanged.

        Args:
            restored: pixels (h, w), NaN where one is missing. They are mirrored beyond the array,
                so that the outer SMOOTH_PX pixels are right at the border of the image only.
        """
        least = np.fmin.reduce(restored, axis=None, keepdims=True)
        # But for rounding, no mean is below the smallest pixel, so that no window would change.
        if not self.noise.variance(least * np.float32(0.99)) > 0:
            return restored
        x = np.pad(restored, SMOOTH_PX, "symmetric")
        m = _means(x)
        n = np.maximum(self.noise.variance(m), np.float32(0))
        v = _means(x * x) - m * m
        # 1 - a, which is exactly 0 without noise: then x' is exactly x.
        rest = np.asarray(n / np.maximum(np.maximum(v, n), np.float32(1e-30)), np.float32)
        around = x[SMOOTH_PX:-SMOOTH_PX, SMOOTH_PX:-SMOOTH_PX]
        result = around - _means(rest) * around + _means(rest * m)
        return np.where(np.isnan(result), around, result)


def _means(values: Image) -> NDArray[np.float32]:
    """Return the means over all windows that lie within an array (h, w)."""
    mean = np.full(WINDOW_PX, 1 / WINDOW_PX, np.float32)
    return weighted_sums(weighted_sums(values, mean, 0, 1), mean, 1, 1)
