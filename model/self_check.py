"""Check a restoration: blurred as the sensor blurs, the restored image must differ from the raw one
by noise only.

    r    = (y - H x) / deviation(y)
    chi2 = mean over the cells of a block of (sum of r)^2 / pixels, in which the smooth part of r
           counts a hundredth; with single pixels as cells, or with larger cells if that is more

y is the raw image, x the restored one, and H the blur that leads from the reference's MTF to the
sensor's, as in `model.consistency`. The deviation of the noise is that of the sensor's profile. No
reference and no model of a fault is needed.

1. Blur the restored image by H. Its kernel is cut at REACH_PX, and the rest (0.3 % of its sum) is
   spread evenly.
2. Divide the residual by the deviation of the noise at the light of H x.
3. Sum over cells of CELL_PX. The blur has removed most of the finer detail from H x, so that finer
   parts of the residual are mostly noise, which would hide an error.
4. Average over blocks of BLOCK_PX, without pixels whose residual is unknown: missing and saturated
   ones, those close to one, and those at the image's border. The smooth part of a residual is its
   mean in squares of SMOOTH_PX.

Noise alone has a chi2 of about 1, and a correct restoration usually less, because it retains a part
of the noise. `sharpening`, the mean of (x - H x)^2 / variance(y), states what the restoration
changed. The errors of a correct restoration grow with it, and so does the bound: MOST_CHI2 +
MOST_PER_SHARPENING x sharpening. A chi2 beyond it means that the sensor would not show x as y.
Reasons are another network's file, a broken tile or a flipped weight.

If the scene is smooth, a wrong restoration changes little. If the sharpening is below
LEAST_SHARPENING, a block within the bound is no evidence: it is not decidable.

The check cannot detect a profile that is itself wrong, because the same wrong H restored the image
and blurs it again. The sensor check detects that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter

from beers_deploy.model.consistency.blocks import Image, Placed
from beers_deploy.model.consistency.step import blur_between, centre
from beers_deploy.profiles.instrument import Instrument, PixelNoise, pixel_noise
from beers_deploy.profiles.response import Array

BLOCK_PX = 64
"""Side of a block: chi2 of its 256 cells of pure noise scatters by 9 %."""

REACH_PX = 128
"""Radius at which the kernel of H is cut: H x is then 0.3 DN off in the mean, and 0.8 DN at half
the radius (measured on a drawn scene of 480 DN rms).
"""

CELL_PX = 4
"""Side of the cells whose sums are judged. Of 68 blocks that lose 0.5 to 2 dB by a
flipped weight 26 are found, and 2 if single pixels are judged alone (measured on training places).
"""

SMOOTH_PX = 16
"""Side of the squares whose means are the smooth part of a residual."""

SMOOTH_WEIGHT = 0.01
"""Weight of the smooth part. Correct restorations are off by up to 1.5 deviations over whole dark
blocks next to bright roofs, whose light reaches farther than the networks see. A wrong sensor shows
in the rest of the residual, and an offset of three deviations is still found.
"""

LEAST_TERM = 1e-5
"""Terms of the kernel below this share of the largest are omitted. They sum to 0.001 (measured)."""

NEAR_PX = 16
"""Pixels this close to a missing or saturated one, or to the image's border, do not count: 2 % of
H's kernel lie farther away.
"""

LEAST_PX = BLOCK_PX**2 // 2
"""A block with fewer pixels that count has no chi2."""

MOST_CHI2 = 1.3
MOST_PER_SHARPENING = 0.01
"""The bound of chi2 is MOST_CHI2 + MOST_PER_SHARPENING x sharpening. Of 4845 blocks, under 15
sensors, at three radiances and by five shipped networks, none reached 0.8 of it (measured on
training places). Noise alone passes MOST_CHI2 at four deviations in a whole block.
"""

LEAST_SHARPENING = 40.0
"""An MTF that is 30 % wrong moves chi2 beyond the bound in all blocks above it (measured)."""

WITHIN = 0
OUTSIDE = 1
SMOOTH = 2
"""States of a block in a written map."""


@dataclass(frozen=True)
class Judged:
    """The self-check's measurements of an image: arrays (n, m) with one value for each block, which
    is NaN if too few of its pixels count.

    Attributes:
        chi2: the mean squared sum of the residual in a cell, over the variance of this sum for
            noise alone. Cells are single pixels, or larger where that gives more; the residual's
            smooth part counts SMOOTH_WEIGHT.
        sharpening: the mean square of the restoration's change, over the same variance.
    """

    chi2: Array
    sharpening: Array

    @property
    def outside(self) -> NDArray[np.bool_]:
        """True for each block whose residual is more than noise."""
        return self.chi2 > MOST_CHI2 + MOST_PER_SHARPENING * self.sharpening

    @property
    def decidable(self) -> NDArray[np.bool_]:
        """True for each block that would show a wrong restoration, or shows one."""
        return (self.sharpening >= LEAST_SHARPENING) | self.outside


@dataclass(frozen=True)
class SelfCheck:
    """The self-check for images of one sensor.

    Attributes:
        rows: the filters along rows, (terms, 2 REACH_PX + 1). The kernel of the blur H is the sum
            over the terms of the product of a row filter and a column filter.
        columns: the filters along columns, of the same shape.
        noise: the noise of a pixel, with that of a column added up over the rows of a cell.
        full_scale: the pixel value at and above which a raw pixel is saturated.
    """

    rows: Image
    columns: Image
    noise: PixelNoise
    full_scale: float

    @classmethod
    def of(
        cls, sensor: Instrument, reference: Instrument, full_scale: float | None = None
    ) -> "SelfCheck":
        """Build the check of images that `sensor` acquired and that were restored to `reference`.

        Args:
            sensor: the instrument that acquired the raw images.
            reference: the instrument that the restoration aims at.
            full_scale: the pixel value that is the sensor's largest digital number; that number
                itself if None.
        """
        scale = sensor.max_dn if full_scale is None else full_scale
        kernel = centre(blur_between(sensor, reference), REACH_PX)
        # The kernel has long tails: cut without this, a constant image would come out darker.
        kernel = kernel + (1 - kernel.sum()) / kernel.size
        left, values, right = np.linalg.svd(kernel)
        terms = np.count_nonzero(values > LEAST_TERM * values[0])
        # A column's pattern adds up over the rows of a cell. The factor of 2 allows for the scatter
        # of chi2 over the few columns of a block.
        return cls(
            rows=(left[:, :terms] * values[:terms]).T.astype(np.float32),
            columns=right[:terms].astype(np.float32),
            noise=pixel_noise(sensor, scale, patterns=2 * CELL_PX),
            full_scale=float(scale),
        )

    def judge(self, raw: Image, restored: Image, down: Placed, across: Placed) -> Judged:
        """Judge the blocks of a window.

        Args:
            raw: y, (h, w) pixel values, NaN where a pixel is missing; they reach REACH_PX beyond
                the kept pixels, as far as the image does.
            restored: x, the restored pixels (h, w) at the same places.
            down: where the rows lie, and which are kept; the kept ones begin at a multiple of
                BLOCK_PX.
            across: where the columns lie, and which are kept, in the same way.

        Returns:
            The measurements of the blocks of the kept pixels, (n, m) each.
        """
        missing = np.isnan(raw) | np.isnan(restored)
        # Only far tails of the kernel see the filling, because pixels near it do not count.
        x = restored
        if missing.all():
            x = np.zeros_like(restored)
        elif missing.any():
            # Missing pixels get the value of the nearest known one.
            nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
            x = restored[tuple(nearest)]
        pads = []
        for placed, side in zip((down, across), x.shape, strict=True):
            # The pixels of the kernel's reach that lie beyond the image, before and after it.
            before = REACH_PX - (placed.keep_start - placed.start)
            pads.append((before, REACH_PX - (placed.start + side - placed.keep_stop)))
        kernel = self.rows.T @ self.columns
        wide = np.pad(x, pads, "symmetric")
        # The transform wraps around, which reaches the first 2 REACH_PX rows and columns alone.
        spectrum = np.fft.rfft2(wide) * np.fft.rfft2(kernel, wide.shape)
        blurred = np.fft.irfft2(spectrum, wide.shape)[2 * REACH_PX :, 2 * REACH_PX :]

        inside = down.keep_slice, across.keep_slice
        excluded = missing | (raw >= self.full_scale)
        if excluded.any():
            excluded = maximum_filter(excluded, 2 * NEAR_PX + 1, mode="constant")
        # Only the image's own border is excluded, so that tiles give the same figures as the whole
        # image.
        counts = ~excluded[inside] & down.beyond(NEAR_PX)[:, None] & across.beyond(NEAR_PX)
        y = np.where(counts, raw[inside], 0)
        # The variance is taken at the light of H x. The noise of y is in the residual as well, so
        # that its own light would bias the quotient.
        variance = self.noise.variance(blurred)
        pixels = _sums(counts, BLOCK_PX)
        residual = np.where(counts, (y - blurred) / np.sqrt(variance), 0)
        cells, smooth = (
            _sums(_sums(residual, side) ** 2 / np.maximum(_sums(counts, side), 1), BLOCK_PX // side)
            for side in (CELL_PX, SMOOTH_PX)
        )
        smooth = (1 - SMOOTH_WEIGHT) * smooth
        squares = np.maximum(_sums(residual**2, BLOCK_PX) - smooth, CELL_PX**2 * (cells - smooth))
        change = _sums(np.where(counts, (x[inside] - blurred) ** 2 / variance, 0), BLOCK_PX)
        enough = np.where(pixels < LEAST_PX, np.nan, pixels)
        return Judged(chi2=squares / enough, sharpening=change / enough)


def _sums(values: NDArray[np.generic], side: int) -> Array:
    """Return the sums over squares of `side` values a side; the last ones may be narrower.

    Args:
        values: (h, w), of any type that float64 holds.
        side: the side of a square.

    Returns:
        The sums (n, m) float64, because float32 would lose digits in a block of 4096 pixels.
    """
    down, across = (np.arange(0, length, side) for length in values.shape)
    sums = np.add.reduceat(values, down, axis=0, dtype=np.float64)
    return np.add.reduceat(sums, across, axis=1)
