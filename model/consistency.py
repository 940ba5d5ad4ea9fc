"""The consistency step: a restored image that agrees with the raw one at low spatial frequencies.

    x' = x + G (y - H x)

y is the raw image and x the restored one. H is the blur that leads from the reference's MTF to the
sensor's, H(f) = MTF_sensor(f) / MTF_reference(f), with H(0) = 1. If x is right, y - H x is the
noise of y. Networks move the mean by some tenths of a per cent and dim faint points. This error
lies at low frequencies, and the low-pass filter G finds it there and removes it. G averages the
noise of y, so that little of it comes back.

G takes the mean of y - H x over blocks of BLOCK_PX x BLOCK_PX pixels and interpolates bilinearly
between the centres of the blocks. So only block means of H x are needed, and they cost a few
operations a pixel:

1. Near: the part of H within NEAR_PX is a sum of RANK separable filters, each evaluated for the
  block means alone.
2. Far: what the rest of H brings is computed from block means of x, up to FAR_BLOCKS blocks away.
  The formula's MTF has a kink at frequency 0, so H falls off as 1 / r^3 and may not be cut near its
  centre: H cut at 8 pixels lost 0.4 dB where the whole H gains 0.05 dB (measured on photographs of
  training places).

The blocks are aligned to the image, and every pixel is computed by the same float32 operations in
the same order wherever a tile begins. So tiles give the whole image's result bit for bit, if
REACH_PX pixels of x and RAW_REACH_PX of y around what is kept are at hand. Blocks that a missing or
saturated pixel reaches through the near part of H are left out, because the residual of a clipped
pixel is not noise; the blocks around them are interpolated instead.

Nothing but NumPy runs on pixels here, so that `deploy/kit/host.py` can do the same on a board's
host.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.profiles.instrument import Instrument

Image = NDArray[np.float32]

BLOCK_PX = 8
"""Side of a block.

The mean of 64 pixels has an eighth of a pixel's noise. Blocks of 16 and 32 gained less (0.01 and
0.03 dB, measured).
"""

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

BORDER_BLOCKS = 2
"""Blocks at the image's border that are left out, because H brings light into them that x does not
show. With all blocks the outer 8 pixels lost 0.2 dB, with one left out 0.05 dB; with two they gain
(measured on training places).
"""

REACH_PX = BLOCK_PX * (FAR_BLOCKS + BORDER_BLOCKS + 1) - 1
"""How far from a pixel lie the restored pixels that its correction depends on."""

RAW_REACH_PX = BLOCK_PX * (BORDER_BLOCKS + 1) - 1 + NEAR_PX
"""How far from a pixel lie the raw pixels that its correction depends on."""

LEAST_SHARE = 0.25
"""Where fewer of the weights around a pixel lie on usable blocks, the correction fades out instead
of ending in a step.
"""

GRID = 512
"""Frequencies along an axis from which H is transformed: wide enough for the far part not to wrap
around.
"""

PRODUCTS_PER_PX = (
    RANK
    * (BLOCK_PX + 2 * NEAR_PX)
    * (1 / BLOCK_PX + 1 / BLOCK_PX**2)  # The near part, by rows and by columns.
    + (1 + 1 / BLOCK_PX) * 2  # Block means of y and of x.
    + (2 * FAR_BLOCKS + 1) ** 2 / BLOCK_PX**2  # The far part.
    + 2 * (1 + 1 / BLOCK_PX)  # Interpolation.
)
"""Products, each with its sum, that the step takes for a pixel."""

EXCESS_SIGMAS = 6.0
"""Above so many standard deviations of noise no pixel is clipped at zero."""


@dataclass(frozen=True)
class Placed:
    """Where in an image the pixels of an array lie along one side.

    Attributes:
        size_px: of the image.
        start: place in the image of the array's first pixel.
        keep_start: first kept pixel, in the image.
        keep_stop: end of the kept pixels (excluded).
    """

    size_px: int
    start: int
    keep_start: int
    keep_stop: int

    @property
    def blocks(self) -> tuple[int, int]:
        """First and last block that the kept pixels are interpolated from.

        BORDER_BLOCKS at either end of the image are left out, unless it has no others.
        """
        # Pixel p lies between the centres of blocks (p - 4) // 8 and the next: a centre lies at 8 k
        # + 3.5.
        half = BLOCK_PX // 2
        count = -(-self.size_px // BLOCK_PX)
        left_out = BORDER_BLOCKS if count > 2 * BORDER_BLOCKS else 0
        low = left_out
        high = count - 1 - left_out
        first = (self.keep_start - half) // BLOCK_PX
        last = (self.keep_stop - 1 - half) // BLOCK_PX + 1
        return min(max(first, low), high), max(min(last, high), low)

    def span(self, around_px: int) -> tuple[int, int]:
        """Pixels of all these blocks, and as many around them; they may lie beyond the image."""
        first, last = self.blocks
        return BLOCK_PX * first - around_px, BLOCK_PX * (last + 1) + around_px


@dataclass(frozen=True)
class Consistency:
    """The consistency step for images of one sensor.

    Attributes:
        rows: weights (RANK, BLOCK_PX + 2 NEAR_PX) of the rows that enter a block's mean of the near
            part of H x.
        columns: weights of the columns, likewise; a term's weight of a pixel is the product of the
            two.
        far: weights (2 FAR_BLOCKS + 1, 2 FAR_BLOCKS + 1) of the block means around a block.
        means: mean values of a raw block at which `excess` is stated, rising.
        excess: what clipping the noise at zero has added to them.
        full_scale: the pixel value at and above which a raw pixel is saturated.
    """

    rows: Image
    columns: Image
    far: Image
    means: Image
    excess: Image
    full_scale: float

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
        kernel = _blur_between(sensor, reference)
        near = _centre(kernel, NEAR_PX)
        left, values, right = np.linalg.svd(near)
        left = left[:, :RANK]
        values = values[:RANK]
        right = right[:RANK]
        near = (left * values) @ right
        box = np.full(BLOCK_PX, 1 / BLOCK_PX)
        # Convolution turns a filter around; the sums below go forwards.
        rows = np.array(
            [np.convolve(vector[::-1], box) for vector in (left * values).T], np.float32
        )
        columns = np.array([np.convolve(vector[::-1], box) for vector in right], np.float32)
        far = _far_weights(kernel, near)[::-1, ::-1]
        means, excess = _clipped_noise(sensor, scale)
        return cls(rows, columns, far.astype(np.float32), means, excess, float(scale))

    def correction(
        self, raw: Image, restored: Image, down: Placed, across: Placed, raw_at: tuple[int, int]
    ) -> Image:
        """Compute G (y - H x) for the kept pixels.

        Args:
            raw: y, (h, w) pixel values; they reach RAW_REACH_PX beyond the kept pixels, as far as
                the image does.
            restored: x, (h', w'), NaN where a pixel is missing; it reaches REACH_PX beyond,
                likewise.
            down: where the rows of `restored` lie, and which are kept.
            across: where its columns lie, and which are kept.
            raw_at: row and column in the image of the first pixel of `raw`.

        Returns:
            (kept rows, kept columns) float32, to be added to x.
        """
        missing = np.isnan(restored)
        any_missing = bool(missing.any())
        finite = np.where(missing, np.float32(0), restored) if any_missing else restored
        origin = down.start, across.start
        blurred = self._near(_extended(finite, (down, across), origin, NEAR_PX))
        blurred += self._far(finite, missing if any_missing else None, down, across)
        raw_means = _block_means(_extended(raw, (down, across), raw_at, 0))
        residual = raw_means - _interpolated_excess(raw_means, self.means, self.excess) - blurred
        saturated = (raw >= self.full_scale).astype(np.float32)
        weights = np.float32(1) - _reached(_extended(saturated, (down, across), raw_at, NEAR_PX))
        if any_missing:
            missing_pixels = _extended(missing.astype(np.float32), (down, across), origin, NEAR_PX)
            weights *= np.float32(1) - _reached(missing_pixels)
        if weights.all():
            return _interpolated(residual, down, across)
        share = _interpolated(weights, down, across)
        change = _interpolated(residual * weights, down, across)
        change /= np.maximum(share, np.float32(LEAST_SHARE))
        return change

    def _near(self, padded: Image) -> Image:
        """Block means of the near part of H x, from pixels with NEAR_PX more on every side."""
        total: Image | None = None
        for row, column in zip(self.rows, self.columns, strict=True):
            term = _weighted(_weighted(padded, row, 0), column, 1)
            total = term if total is None else total + term
        assert total is not None  # noqa: S101 - RANK is at least 1
        return total

    def _far(
        self, finite: Image, missing: NDArray[np.bool_] | None, down: Placed, across: Placed
    ) -> Image:
        """Block means of the far part of H x.

        A block with missing pixels counts as the block in the middle does.
        """
        around_px = BLOCK_PX * FAR_BLOCKS
        origin = down.start, across.start
        means = _block_means(_extended(finite, (down, across), origin, around_px))
        if missing is None:
            return self._around(means)
        missing_share = _block_means(
            _extended(missing.astype(np.float32), (down, across), origin, around_px)
        )
        complete = (missing_share == 0).astype(np.float32)
        middle = means[FAR_BLOCKS:-FAR_BLOCKS, FAR_BLOCKS:-FAR_BLOCKS]
        # Where all blocks are whole the last factor is exactly 0, because both sums add the same
        # numbers.
        return self._around(means * complete) + middle * (
            self._around(np.ones_like(complete)) - self._around(complete)
        )

    def _around(self, means: Image) -> Image:
        """The sum of block means around each block, weighted by `far`."""
        side = len(self.far)
        height = means.shape[0] - side + 1
        width = means.shape[1] - side + 1
        total = np.zeros((height, width), np.float32)
        for row in range(side):
            for column in range(side):
                total += self.far[row, column] * means[row : row + height, column : column + width]
        return total


def _blur_between(sensor: Instrument, reference: Instrument) -> NDArray[np.float64]:
    """The filter H around its first pixel, (GRID, GRID) float64 of sum 1."""
    fy = np.fft.fftfreq(GRID)[:, None]
    fx = np.fft.fftfreq(GRID)[None, :]
    ratio = sensor_mtf(fx, fy, sensor) / sensor_mtf(fx, fy, reference)
    return np.asarray(np.fft.ifft2(ratio / ratio[0, 0]).real)


def _centre(kernel: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    """The middle (2 R + 1, 2 R + 1) of a filter that lies around its first element."""
    return np.roll(kernel, (radius, radius), (0, 1))[: 2 * radius + 1, : 2 * radius + 1]


def _far_weights(kernel: NDArray[np.float64], near: NDArray[np.float64]) -> NDArray[np.float64]:
    """What each block mean around a block adds to the mean of H x there, the near part left out.

    The mean over one block of what a filter f makes of another, d blocks away and of constant
    value, is the sum of f(8 d + e) (8 - |e_y|) (8 - |e_x|) / 64 over the offsets e. What lies
    beyond the farthest blocks is spread over all of them, so that a constant image stays as it is.
    """
    remainder = kernel.copy()
    offsets = np.arange(-NEAR_PX, NEAR_PX + 1)
    remainder[np.ix_(offsets, offsets)] -= near
    ramp = np.maximum(BLOCK_PX - np.abs(np.fft.fftfreq(GRID, 1 / GRID)), 0)
    overlap = np.outer(ramp, ramp) / BLOCK_PX**2
    summed = np.fft.ifft2(np.fft.fft2(remainder) * np.fft.fft2(overlap)).real
    weights = _centre(summed[::BLOCK_PX, ::BLOCK_PX], FAR_BLOCKS)
    return np.asarray(weights + (1 - near.sum() - weights.sum()) / weights.size)


def _clipped_noise(sensor: Instrument, full_scale: float) -> tuple[Image, Image]:
    """What the converter's clipping at zero adds to the mean of a dark block: its mean value, and
    the excess.

    A signal s with Gaussian noise sigma, clipped at 0, has the mean s + e with e = sigma phi(s /
    sigma) - s Phi(-s / sigma), phi and Phi being the normal density and distribution.
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


def _interpolated_excess(block_means: Image, means: Image, excess: Image) -> Image:
    """The excess at block means `own`; a mean below the least that is possible counts as no light
    at all.
    """
    values = np.interp(block_means, means, excess, right=0.0).astype(np.float32)
    return np.minimum(values, np.maximum(block_means, np.float32(0)))


def _extended(
    image: Image, sides: tuple[Placed, Placed], origin: tuple[int, int], around_px: int
) -> NDArray[np.float32]:
    """The pixels of the blocks of a window and `around_px` more, mirrored beyond the image's
    borders (edge twice).
    """
    slices = []
    pads = []
    for placed, first in zip(sides, origin, strict=True):
        start, stop = placed.span(around_px)
        low = max(start, 0)
        high = min(stop, placed.size_px)
        slices.append(slice(low - first, high - first))
        pads.append((low - start, stop - high))
    inside = image[slices[0], slices[1]]
    if not any(map(any, pads)):
        return inside
    return _mirrored(image, sides, origin, around_px)


def _mirrored(
    image: Image, sides: tuple[Placed, Placed], origin: tuple[int, int], around_px: int
) -> NDArray[np.float32]:
    """As `_extended`, pixel by pixel: c b a | a b c | c b a, folded back
    whatever the image's size.
    """
    numbers = []
    for placed, first in zip(sides, origin, strict=True):
        period = 2 * placed.size_px
        number = np.arange(*placed.span(around_px)) % period
        numbers.append(np.minimum(number, period - 1 - number) - first)
    return np.asarray(image[np.ix_(*numbers)])


def _weighted(image: Image, weights: Image, axis: int) -> Image:
    """Weighted sums over windows that begin BLOCK_PX apart along an axis: as long as `weights`,
    from the first on.
    """
    count = (image.shape[axis] - len(weights)) // BLOCK_PX + 1
    end = BLOCK_PX * (count - 1) + 1
    total: Image | None = None
    for place, weight in enumerate(weights):
        steps = slice(place, place + end, BLOCK_PX)
        term = (image[steps] if axis == 0 else image[:, steps]) * weight
        total = term if total is None else np.add(total, term, out=total)
    assert total is not None  # noqa: S101 - there are weights
    return total


def _block_means(image: Image) -> Image:
    """The means of whole blocks."""
    mean = np.full(BLOCK_PX, 1 / BLOCK_PX, np.float32)
    return _weighted(_weighted(image, mean, 0), mean, 1)


def _reached(flags: Image) -> Image:
    """1 for each block that a flag reaches within NEAR_PX, else 0; `flags` has NEAR_PX more on
    every side.
    """
    ones = np.ones(BLOCK_PX + 2 * NEAR_PX, np.float32)
    if not flags.any():
        shape = tuple((side - 2 * NEAR_PX) // BLOCK_PX for side in flags.shape)
        return np.zeros(shape, np.float32)
    return np.asarray(_weighted(_weighted(flags, ones, 0), ones, 1) > 0, np.float32)


def _interpolated(blocks: Image, down: Placed, across: Placed) -> Image:
    """Bilinear interpolation between the centres of blocks, at the kept pixels."""
    return _along(_along(blocks, down).T, across).T


def _along(blocks: Image, placed: Placed) -> Image:
    """Linear interpolation along the first axis; at the image's border the nearest block inside
    counts.
    """
    half = BLOCK_PX // 2
    first, last = placed.blocks
    pixels = np.arange(placed.keep_start, placed.keep_stop)
    left = (pixels - half) // BLOCK_PX
    # In sixteenths, which float32 holds exactly: the two weights add up to 1.
    share = ((2 * (pixels - half) + 1) % (2 * BLOCK_PX)).astype(np.float32) / np.float32(
        2 * BLOCK_PX
    )
    lower = np.clip(left, first, last) - first
    upper = np.clip(left + 1, first, last) - first
    return blocks[lower] * (np.float32(1) - share)[:, None] + blocks[upper] * share[:, None]
