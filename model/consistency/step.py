"""Make a restored image consistent with the raw one at low spatial frequencies.

    x' = x + G (y - H x)

Before that, what noise is left in the dark parts of x is smoothed (`model.consistency.smooth`).

y is the raw image and x the restored one. H is the blur that leads from the reference's MTF to the
sensor's, H(f) = MTF_sensor(f) / MTF_reference(f), with H(0) = 1. If x is right, y - H x is the
noise of y. Networks shift the mean by some tenths of a per cent and dim faint points. This error
lies at low frequencies, so the low-pass filter G isolates it and the step removes it. G averages
the noise of y, so that little of it is added.

G averages y - H x over blocks of BLOCK_PX x BLOCK_PX pixels and interpolates bilinearly between the
centres of the blocks. So only block means of H x are needed, and they cost a few operations a
pixel:

1. Near: the part of H within NEAR_PX is a sum of RANK separable filters, each evaluated for the
   block means alone.
2. Far: the contribution of the rest of H is computed from block means of x, up to FAR_BLOCKS blocks
   away. The formula's MTF has a kink at frequency 0, so H falls off as 1 / r^3 and may not be cut
   near its centre. H cut at 8 pixels lost 0.4 dB where the whole H gains 0.05 dB (measured on
   photographs of training places).

The blocks are aligned to the image, and every pixel is computed by the same float32 operations in
the same order wherever a tile begins. Tiles therefore reproduce the result of the whole image bit
for bit, if they include REACH_PX pixels of x and RAW_REACH_PX of y around the kept pixels. Blocks
that a missing or saturated pixel affects through the near part of H are excluded, because the
residual of a clipped pixel is not noise. They are interpolated from the blocks around them.

Only NumPy runs on pixels here, so that `deploy/kit/host.py` can do the same on a board's host.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from beers_deploy.model.consistency.blocks import (
    BLOCK_PX,
    BORDER_BLOCKS,
    Image,
    Placed,
    block_means,
    extend,
    free_blocks,
    interpolate,
)
from beers_deploy.model.consistency.detail import (
    FINE_PX,
    DetailStep,
    separable_sums,
    window_weights,
)
from beers_deploy.model.consistency.smooth import SMOOTH_PX, Smoothing
from beers_deploy.model.departure import has_other_curve
from beers_deploy.model.simulator.mtf import frequency_grid, sensor_mtf
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import Array

NEAR_PX = 8
"""Radius of the near part of H.

With 4 pixels the block means were 0.9 DN off, with 8 pixels 0.3 DN (measured).
"""

RANK = 3
"""Separable filters that make up the near part (its largest singular values).

The far part makes up for the rest.
"""

FAR_BLOCKS = 8
"""Reach of the far part in blocks.

Twice as many changed the PSNR by less than 0.01 dB (measured).
"""


REACH_PX = BLOCK_PX * (FAR_BLOCKS + BORDER_BLOCKS + 1) - 1 + SMOOTH_PX
"""The correction of a pixel depends on restored pixels up to this distance."""

RAW_REACH_PX = BLOCK_PX * (BORDER_BLOCKS + 1) - 1 + NEAR_PX
"""The correction of a pixel depends on raw pixels up to this distance."""

LEAST_SHARE = 0.25
"""If a smaller share of the weights around a pixel lies on usable blocks, the correction fades out
instead of ending in a step.
"""

GRID = 512
"""The number of frequencies along an axis from which H is computed. It is large enough for the far
part not to wrap around.
"""

PRODUCTS_PER_PX = (
    RANK
    * (BLOCK_PX + 2 * NEAR_PX)
    * (1 / BLOCK_PX + 1 / BLOCK_PX**2)  # The near part, by rows and by columns.
    + (1 + 1 / BLOCK_PX) * 2  # Block means of y and of x.
    + (2 * FAR_BLOCKS + 1) ** 2 / BLOCK_PX**2  # The far part.
    + 2 * (1 + 1 / BLOCK_PX)  # Interpolation.
)
"""The number of multiply-accumulate operations of the step per pixel, without smoothing the dark:
about 30 more where an image is dark.
"""

DETAIL_PRODUCTS_PER_PX = (
    RANK * (FINE_PX + 2 * NEAR_PX) * (1 / FINE_PX + 1 / FINE_PX**2)  # The near part.
    + 4 * (1 + 1 / FINE_PX)  # Means of blocks, and interpolation.
)
"""The number of additional ones where the step corrects finer detail too."""

EXCESS_SIGMAS = 6.0
"""Signals of more than this number of standard deviations of noise are never clipped at zero."""


@dataclass(frozen=True)
class Consistency:
    """The consistency step x + G (y - H x) for images y of one sensor, restored to x.

    H blurs a restored image x from the reference's MTF to the sensor's. G averages over blocks and
    interpolates between their centres.

    Attributes:
        rows: weights (RANK, BLOCK_PX + 2 NEAR_PX) of the rows that enter a block's mean of the near
            part of H x.
        columns: weights of the columns, likewise; a term's weight of a pixel is the product of the
            two.
        far: weights (2 FAR_BLOCKS + 1, 2 FAR_BLOCKS + 1) of the block means around a block.
        means: mean values of a raw block at which `excess` is given, ascending, in pixel values.
        excess: the amount that clipping the noise at zero has added to them, in pixel values.
        full_scale: the pixel value at and above which a raw pixel is saturated.
        detail: the step for finer detail, where the sensor's MTF departs from the formula's curve;
            else None.
        smoothing: the step that smooths x before H is applied to it.
    """

    rows: Image
    columns: Image
    far: Image
    means: Image
    excess: Image
    full_scale: float
    detail: DetailStep | None
    smoothing: Smoothing

    @classmethod
    def of(
        cls, sensor: Instrument, reference: Instrument, full_scale: float | None = None
    ) -> "Consistency":
        """Build the step for images that `sensor` acquired and that were restored to `reference`.

        Args:
            sensor: the instrument whose raw images are restored.
            reference: the instrument that the restoration aims at.
            full_scale: the pixel value that is the sensor's largest digital number; that number
                itself if None.
        """
        scale = sensor.max_dn if full_scale is None else full_scale
        kernel = blur_between(sensor, reference)
        near = centre(kernel, NEAR_PX)
        left, values, right = np.linalg.svd(near)
        left = left[:, :RANK]
        values = values[:RANK]
        right = right[:RANK]
        down = (left * values).T
        separable = down.T @ right
        # The far part: a filter f is applied to a block of constant value, d blocks away. The mean
        # of the result over one block is the sum over the offsets e of f(8 d + e) (8 - |e_y|)
        # (8 - |e_x|) / 64.
        remainder = kernel.copy()
        offsets = np.arange(-NEAR_PX, NEAR_PX + 1)
        remainder[np.ix_(offsets, offsets)] -= separable
        ramp = np.maximum(BLOCK_PX - np.abs(np.fft.fftfreq(GRID, 1 / GRID)), 0)
        overlap = np.outer(ramp, ramp) / BLOCK_PX**2
        summed = np.fft.ifft2(np.fft.fft2(remainder) * np.fft.fft2(overlap)).real
        far = centre(summed[::BLOCK_PX, ::BLOCK_PX], FAR_BLOCKS)
        # The weight beyond the farthest blocks is spread over all of them, so that a constant image
        # does not change.
        far = (far + (1 - separable.sum() - far.sum()) / far.size)[::-1, ::-1]
        means, excess = _clipped_noise(sensor, scale)
        return cls(
            rows=window_weights(down, BLOCK_PX),
            columns=window_weights(right, BLOCK_PX),
            far=far.astype(np.float32),
            means=means,
            excess=excess,
            full_scale=float(scale),
            detail=DetailStep.of(down, right) if has_other_curve(sensor) else None,
            smoothing=Smoothing.of(sensor, scale),
        )

    def correction(
        self, raw: Image, restored: Image, down: Placed, across: Placed, raw_at: tuple[int, int]
    ) -> Image:
        """Compute the correction for the kept pixels: what smoothing changes, G (y - H x), and that
        of finer detail.

        y counts less the amount that clipping the noise at zero adds. Blocks with a missing or
        saturated pixel within NEAR_PX are excluded. Pixels around them get the correction of the
        other blocks, which fades out where these have less than LEAST_SHARE of the weights.

        Args:
            raw: y, (h, w) pixel values; they reach RAW_REACH_PX beyond the kept pixels, as far as
                the image does.
            restored: x, the restored pixels (h', w'), NaN where one is missing. They reach REACH_PX
                beyond the kept pixels, as far as the image does.
            down: where the rows of `restored` lie in the image, and which are kept.
            across: where its columns lie, and which are kept.
            raw_at: row and column in the image of the first pixel of `raw`.

        Returns:
            (kept rows, kept columns) float32, to be added to x.
        """
        missing = np.isnan(restored)
        any_missing = bool(missing.any())
        smooth = self.smoothing.smoothed(restored)
        finite = np.where(missing, np.float32(0), smooth) if any_missing else smooth
        sides = down, across
        origin = down.start, across.start
        near_pixels = extend(finite, sides, origin, NEAR_PX)
        raw_pixels = extend(raw, sides, raw_at, 0)
        blurred = separable_sums(near_pixels, self.rows, self.columns, BLOCK_PX)
        blurred += self._far(finite, missing if any_missing else None, sides)
        raw_means = block_means(raw_pixels)
        excess = np.interp(raw_means, self.means, self.excess, right=0.0).astype(np.float32)
        # A mean below the smallest possible value counts as no light.
        excess = np.minimum(excess, np.maximum(raw_means, np.float32(0)))
        residual = raw_means - excess - blurred
        weights = free_blocks(raw >= self.full_scale, sides, raw_at, NEAR_PX)
        if any_missing:
            weights *= free_blocks(missing, sides, origin, NEAR_PX)
        share: Image | None = None
        if weights.all():
            change = interpolate(residual, down, across)
        else:
            share = interpolate(weights, down, across)
            change = interpolate(residual * weights, down, across)
            change /= np.maximum(share, np.float32(LEAST_SHARE))
        if self.detail is not None:
            fine = self.detail.correction(raw_pixels, near_pixels, down, across)
            # Next to an excluded block, the finer residual is no noise, and may be NaN.
            change += fine if share is None else np.where(share == 1, fine, np.float32(0))
        if smooth is not restored:
            window = down.keep_slice, across.keep_slice
            change += np.where(missing, np.float32(0), smooth - restored)[window]
        return change

    def _far(
        self, finite: Image, missing: NDArray[np.bool_] | None, sides: tuple[Placed, Placed]
    ) -> Image:
        """Compute block means of the far part of H x.

        A block with missing pixels is replaced by the block in the middle.
        """
        around_px = BLOCK_PX * FAR_BLOCKS
        origin = sides[0].start, sides[1].start
        means = block_means(extend(finite, sides, origin, around_px))
        if missing is None:
            return self._around(means)
        missing_share = block_means(extend(missing.astype(np.float32), sides, origin, around_px))
        complete = (missing_share == 0).astype(np.float32)
        middle = means[FAR_BLOCKS:-FAR_BLOCKS, FAR_BLOCKS:-FAR_BLOCKS]
        # Where all blocks are whole the last factor is exactly 0, because both sums add the same
        # numbers.
        return self._around(means * complete) + middle * (
            self._around(np.ones_like(complete)) - self._around(complete)
        )

    def _around(self, means: Image) -> Image:
        """Sum the block means around each block, weighted by `far`."""
        side = len(self.far)
        height = means.shape[0] - side + 1
        width = means.shape[1] - side + 1
        total = np.zeros((height, width), np.float32)
        for row in range(side):
            for column in range(side):
                total += self.far[row, column] * means[row : row + height, column : column + width]
        return total


def blur_between(sensor: Instrument, reference: Instrument) -> Array:
    """Compute the filter H, centred on its first pixel, (GRID, GRID) float64 of sum 1."""
    fx, fy = frequency_grid(GRID)
    ratio = sensor_mtf(fx, fy, sensor) / sensor_mtf(fx, fy, reference)
    return np.fft.ifft2(ratio / ratio[0, 0]).real


def centre(kernel: Array, radius: int) -> Array:
    """Cut a filter that is centred on its first element to (2 R + 1, 2 R + 1)."""
    return np.roll(kernel, (radius, radius), (0, 1))[: 2 * radius + 1, : 2 * radius + 1]


def _clipped_noise(sensor: Instrument, full_scale: float) -> tuple[Image, Image]:
    """Compute how much clipping at zero raises the mean of a dark block.

    A signal s with Gaussian noise sigma, clipped at 0, has the mean s + e with e = sigma phi(s /
    sigma) - s Phi(-s / sigma), where phi and Phi are the normal density and distribution.

    Returns:
        Mean values of a block after clipping, and the excess e at each.
    """
    gain = sensor.gain_dn_per_radiance
    unit = full_scale / sensor.max_dn
    variance_dark_dn = sensor.beta * gain**2 + 1 / 12
    # The noise grows with the signal: the range ends where the signal is EXCESS_SIGMAS times its
    # own noise.
    slope_dn = sensor.alpha * gain
    end_dn = EXCESS_SIGMAS**2 * slope_dn + EXCESS_SIGMAS * np.sqrt(variance_dark_dn)
    signal_dn = np.linspace(0, end_dn, 256)
    light_dn = np.maximum(signal_dn - sensor.offset_dn, 0)
    sigma_dn = np.sqrt(slope_dn * light_dn + variance_dark_dn)
    # With an offset the darkest signal is the offset, not 0.
    depth = np.maximum(signal_dn, sensor.offset_dn) / sigma_dn
    density = np.exp(-(depth**2) / 2) / np.sqrt(2 * np.pi)
    excess_dn = sigma_dn * density - depth * sigma_dn * ndtr(-depth)
    means = np.asarray((signal_dn + excess_dn) * unit, np.float32)
    return means, np.asarray(excess_dn * unit, np.float32)
