"""The regularisation of the MTF compensation, derived from the image: the Wiener optimum of its
noise and its scene.

The compensation divides by |H|^2 + epsilon r^2, r = |f| / f_Nyquist. It is the Wiener filter if the
power of the noise over that of the scene is epsilon r^2, which holds for white noise and a scene
whose power falls as S / r^2. The power of natural scenes falls approximately so.

1. In each block of 4 x 4 pixels, v = alpha L + beta is the variance of the noise at the block's
  mean radiance L, rounding included, and g the mean squared difference of neighbouring pixels.
  White noise adds 2 v to g.
2. u = g / (2 v) - 1, at least 0, is the scene over the noise. A Wiener filter with this ratio
  leaves v u / (u + 1) of the noise. NL-Bayes acts similarly: it leaves little in flat parts and
  most of the noise in fine texture. N is the mean of v u / (u + 1) over the image.
3. S = mean of (g - 2 v) / c. A scene of power S / r^2 adds c S to the squared differences, where c
  = mean over the frequencies of |H|^2 |D|^2 / r^2, H is the transfer of the sensor, and D that of a
  difference of neighbours (|D|^2 is the mean of both axes).
4. epsilon = a (N / S)^p, and at most 0.33 sigma / L, the root of the mean of v over the mean
  radiance. The constants a and p were fitted by
  `git show 793b3353:benchmarks/traditional_epsilon.py`.

A change of the gain, which scales radiance and noise together, leaves epsilon as it is.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beers_deploy.model.simulator.detector import to_radiance
from beers_deploy.model.simulator.mtf import frequency_grid, sensor_mtf
from beers_deploy.model.traditional.noise import with_rounding_noise
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST, Array

SCALE = 0.55
POWER = 1.12
"""The constants of epsilon = a (N / S)^p, both without a unit, fitted to denoising first.

If deconvolution comes first, the mean loss to the best epsilon of each image is 0.07 dB on 120
images, and constants fitted to this order lose as much (measured).
"""

LARGEST_PER_NOISE = 0.33
"""The bound of epsilon over sigma / L, the noise as a share of the radiance.

In flat and dark images the formula asks for more, which gains 0.02 dB in the mean of the scan but
erases faint patterns near Nyquist. It leaves 15 % of the contrast of bars with 10 % contrast and a
period of 2 px, relative to the reference. With this bound 64 % are left (measured).
"""

LARGEST_EPSILON = 1.0
"""The bound of epsilon in the dark."""

LEAST_NOISE = 0.005
LEAST_CONTRAST = 0.02
"""The least N, and the least mean of g - 2 v, over the mean of v.

NL-Bayes leaves 1 % of the noise in flat fields. Differences of 22 500 pixels measure 2 v to within
about 0.02 v, so that less is no evidence of contrast.
"""

BLOCK_PX = 4
"""Side of a block, similar to that of the patches of NL-Bayes.

With 8 and 16 px the mean loss to the best epsilon is 0.001 and 0.003 dB larger."""

GRID = 64
"""Frequencies along an axis in the mean of the spectrum."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class NoiseAndScene:
    """The power of the noise and of the scene in an image, from which epsilon is derived.

    Each attribute is a mean over the known pixels, in (W/m2/sr/um)^2 unless stated otherwise.

    Attributes:
        radiance: the mean radiance L in W/m2/sr/um, at least 0.
        noise: variance of the noise, v.
        residual: the part of the noise that denoising is expected to leave, v u / (u + 1), where u
            = g / (2 v) - 1, at least 0, is the scene over the noise.
        contrast: the mean squared difference of neighbours, g, less that of the noise, 2 v; may be
            negative.
    """

    radiance: float
    noise: float
    residual: float
    contrast: float

    def ratio(self, sensor: Instrument) -> float:
        """Return N / S, the power of the noise over that of the scene at Nyquist, above 0 and
        finite.
        """
        residual = max(self.residual, LEAST_NOISE * self.noise)
        contrast = max(self.contrast, LEAST_CONTRAST * self.noise)
        # The mean squared difference of neighbouring pixels in an image of a scene whose power is
        # 1 / r^2, with r the frequency over Nyquist.
        fx, fy = frequency_grid(GRID)
        r_squared = (fx**2 + fy**2) / NYQUIST**2
        # The mean of an image is no contrast, so the quotient is 0 there.
        r_squared[0, 0] = np.inf
        differences = 2 * np.sin(np.pi * fx) ** 2 + 2 * np.sin(np.pi * fy) ** 2
        power = np.abs(sensor_mtf(fx, fy, sensor)) ** 2
        return residual * float((power * differences / r_squared).mean()) / contrast

    @property
    def largest_epsilon(self) -> float:
        """The largest epsilon that does not erase faint patterns; it is larger for an image with
        more noise.
        """
        sigma = self.noise**0.5
        # Compared as products, because the radiance of the dark is 0.
        if LARGEST_EPSILON * self.radiance <= LARGEST_PER_NOISE * sigma:
            return LARGEST_EPSILON
        return float(LARGEST_PER_NOISE * sigma / self.radiance)


def measure(strips: Iterable[Tensor], sensor: Instrument) -> NoiseAndScene:
    """Measure the noise and the contrast of an image.

    Missing pixels do not count, and neither do blocks whose known pixels are all saturated. A
    single saturated pixel counts, because epsilon would otherwise jump when a bright point begins
    to saturate.

    The result does not depend, to the last bit, on how the strips are cut. The image is measured in
    bands of 4 rows on a grid of its own, and the sums of the bands are added in order.

    Args:
        strips: digital numbers in strips (any, W), NaN where they are missing.
        sensor: the instrument that acquired the image.
    """
    digitised = with_rounding_noise(sensor)
    sums = np.zeros(4)
    pixels = 0
    above = None
    for band in bands(strips):
        dn = band.double().numpy()
        radiance = to_radiance(dn, sensor)
        of_band, count = _sums(radiance, above, dn < sensor.max_dn, digitised)
        sums += of_band
        pixels += count
        above = radiance[-1:]
    if not pixels:
        return NoiseAndScene(radiance=0.0, noise=digitised.beta, residual=0.0, contrast=0.0)
    return NoiseAndScene(*(float(mean) for mean in sums / pixels))


def derived_epsilon(measured: NoiseAndScene, sensor: Instrument) -> float:
    """Return the strength of the regularisation that suits an image: epsilon = a (N / S)^p, above 0
    and at most `largest_epsilon`.

    Args:
        measured: the noise and the contrast of the image.
        sensor: the instrument that acquired the image.
    """
    return float(min(SCALE * measured.ratio(sensor) ** POWER, measured.largest_epsilon))


def bands(strips: Iterable[Tensor]) -> Iterator[Tensor]:
    """Yield the rows of an image that arrives in strips (any, W) in bands of BLOCK_PX rows; the
    last band may have fewer.
    """
    remainder: Tensor | None = None
    for strip in strips:
        rows = strip if remainder is None else torch.cat([remainder, strip])
        complete = len(rows) // BLOCK_PX * BLOCK_PX
        for top in range(0, complete, BLOCK_PX):
            yield rows[top : top + BLOCK_PX]
        remainder = rows[complete:]
    if remainder is not None and len(remainder):
        yield remainder


def _sums(
    radiance: Array, above: Array | None, unsaturated: Mask, sensor: Instrument
) -> tuple[Array, int]:
    """Return the sums of L, v, v u / (u + 1) and g - 2 v over the pixels of a band (rows, W), and
    their number.

    `above` is the row over the band, (1, W), if there is one. Blocks without a pair of neighbours
    do not count.
    """
    first = np.full((1, radiance.shape[1]), np.nan) if above is None else above
    across = np.diff(radiance, axis=1, prepend=np.nan)
    along = np.diff(radiance, axis=0, prepend=first)
    light, pixels = _blocks(radiance)
    squares = np.zeros_like(light)
    axes = np.zeros_like(light)
    for differences in (across, along):
        total, pairs = _blocks(np.square(differences))
        squares += total / np.maximum(pairs, 1)
        axes += pairs > 0
    _, below_full_scale = _blocks(np.where(unsaturated, radiance, np.nan))
    # Saturated pixels contain no information about the scene. A single one among others is kept, or
    # epsilon would jump.
    usable = (axes > 0) & (below_full_scale > 0)
    pixels = pixels[usable]
    mean_radiance = np.maximum(light[usable] / pixels, 0)
    variance = sensor.alpha * mean_radiance + sensor.beta
    # White noise adds 2 v to the squared difference of two neighbours.
    contrast = squares[usable] / axes[usable] - 2 * variance
    scene_over_noise = np.maximum(contrast / (2 * variance), 0)
    # A Wiener filter leaves the share u / (u + 1) of the noise, and NL-Bayes a similar one.
    residual = variance * scene_over_noise / (scene_over_noise + 1)
    sums = [
        float((pixels * values).sum()) for values in (mean_radiance, variance, residual, contrast)
    ]
    return np.array(sums), int(pixels.sum())


def _blocks(values: Array) -> tuple[Array, Array]:
    """Return the sum and the number of the known values (rows, W) in each block of BLOCK_PX
    columns.
    """
    valid = np.isfinite(values)
    columns = np.where(valid, values, 0.0).sum(0), valid.sum(0, dtype=np.float64)
    missing_columns = -values.shape[1] % BLOCK_PX
    # Rows are added first: sums over the few columns of a block are slow.
    total, number = (
        np.pad(per_column, (0, missing_columns)).reshape(-1, BLOCK_PX).sum(1)
        for per_column in columns
    )
    return total, number
