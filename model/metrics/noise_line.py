"""Fit the noise line of an instrument, variance = alpha L + beta, to blurred images of any scene.

Natural scenes of a few hundred pixels have no homogeneous areas. The blur helps: it leaves almost
no texture in the corners of the spectrum, beyond 0.55 cycles per pixel, and noise is white.

1. Cut blocks (`noise_blocks`). The energy of a block's waves up to 0.2 cycles per pixel is its
   structure, that beyond 0.55 its noise.
2. Use the blocks of little structure. That does not select by noise, because the two bands share no
   wave.
3. Fit noise = alpha L + beta + leak * structure, none of them negative, which subtracts leaked
   texture.
4. Draw parts of the images with replacement: the spread is the interval.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from beers_deploy.model.metrics.noise_blocks import MIDDLE, ROUNDING, Blocks
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.profiles.errors import counted

STRUCTURES = (10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
"""Limits of a block's structure relative to its noise; the smallest that leaves enough blocks is
used.
"""
ENOUGH = 300
LEAST = 60
LEAST_PARTS = 5
MAX_LEAK = 0.5
"""The largest share of the energy in the corners that may come from texture."""
MAX_COLOUR = 0.15
COLOUR_SCATTER = 3.0
"""Limits of the difference between the noise at middle frequencies and in the corners, which white
noise does not exceed.
"""
MOSAIC = 0.2
"""The largest noise at middle frequencies, relative to the finest detail, of an image from a mosaic
of colour filters.
"""
MIN_RANGE = 0.25
"""Least spread of the blocks' means, relative to the brightest; a smaller one does not determine a
line.
"""
LEAST_NOISE = 0.5 * ROUNDING
QUIET_PERCENT = 5.0
"""The least noise above rounding, in DN^2, of the quietest blocks; restored or resampled images
have less.
"""
SEED = 0
"""Seed of the draws for intervals, so that one image always gives the same result."""
DRAWS = 200
PASSES = 6
FINE_WAVES = 21
MAX_SCATTER = 3.5
"""The number of waves beyond FINE in a block; and the largest deviation of their mean square, in
standard deviations.
"""
EDGE_PERCENT = 2.0
"""This share of the blocks lies below, and above, the radiances that are reported as measured."""


@dataclass(frozen=True)
class Variance:
    """The variance of the noise at one pixel value, without the variance of rounding.

    Attributes:
        value: the variance in DN^2.
        interval: the ends of its 95 % interval in DN^2.
        extrapolated: True if the pixel value lies outside the range in which noise was measured.
    """

    value: float
    interval: tuple[float, float]
    extrapolated: bool


@dataclass(frozen=True)
class NoiseModel:
    """The noise of a sensor: its variance in DN^2 is alpha * DN + beta, without that of rounding.

    Attributes:
        alpha: growth of the variance with the pixel value, in DN.
        beta: variance without light, in DN^2.
        draws: (D, 2) alpha and beta of each draw of the bootstrap.
        blocks: the number of blocks of 16 x 16 pixels that were used.
        measured_dn: about the smallest and the largest mean of the blocks, without the outer 2 %.
        leak: share of texture in the corners of the spectrum, which was subtracted.
        colour: noise at middle frequencies over that at the finest; 1 for white noise. The line is
            that of the stronger of the two.
        white: True if the two are equal within chance.
        one_level: True if noise was measured at only one level of light, so that its growth with
            light is assumed.
        spectrum: noise in the bands of SPECTRUM over that beyond FINE.
    """

    alpha: float
    beta: float
    draws: np.ndarray
    blocks: int
    measured_dn: tuple[float, float]
    leak: float
    colour: float = 1.0
    white: bool = True
    one_level: bool = False
    spectrum: tuple[float, ...] = ()

    def total(self, dn: np.ndarray) -> np.ndarray:
        """Return the variance in DN^2 of pixels with the values `dn` (any shape), including the
        variance of rounding.
        """
        return np.asarray(self.alpha * np.maximum(dn, 0) + self.beta + ROUNDING)

    def at(self, dn: float) -> Variance:
        """Return the variance of the noise at one pixel value above 0; its interval is wider
        outside the measured range.
        """
        value = self.alpha * dn + self.beta
        low, high = np.percentile(self.draws @ (dn, 1.0), [2.5, 97.5])
        dark, bright = self.measured_dn
        beyond = max(math.log(dark / dn), math.log(dn / bright), 0.0)
        # A straight line is subtracted for the leaked texture, which may be wrong by a part of it.
        wider = 1 + beyond
        model = 0.04 + 0.2 * self.leak
        low, high = (value + wider * (end - value) for end in (min(low, value), max(high, value)))
        return Variance(value, (max(low - model * value, 0.0), high + model * value), beyond > 0)


def fit_noise(blocks: Blocks, incomplete: bool = False) -> NoiseModel | Refusal:
    """Fit the line variance = alpha * DN + beta to blocks of any number of images of one sensor.

    The draws of the interval are always the same.

    Args:
        blocks: the blocks of all images.
        incomplete: True to accept noise that is not white, and noise at only one level of light.

    Returns:
        The line, or the reason why these images do not determine one.
    """
    if blocks.mean.size < LEAST:
        return Refusal(
            f"{counted(blocks.mean.size, 'block')} of 16 x 16 unclipped pixels, {LEAST} are needed"
        )
    quietest = float(np.percentile(blocks.fine, QUIET_PERCENT))
    # A restored or resampled image has less noise at the finest detail than a detector.
    if quietest < ROUNDING + LEAST_NOISE:
        return Refusal(
            f"the finest detail has a variance of {quietest:.2g} DN^2, but rounding alone adds "
            f"{ROUNDING:.2g}"
        )
    quiet, fit = _choose(blocks)
    parts = np.unique(quiet.part)
    if quiet.mean.size < LEAST or parts.size < LEAST_PARTS:
        return Refusal(
            f"{counted(quiet.mean.size, 'block')} without much texture, {LEAST} are needed"
        )
    dark, bright = (float(v) for v in np.percentile(quiet.mean, [EDGE_PERCENT, 100 - EDGE_PERCENT]))
    one_level = bright - dark < MIN_RANGE * bright
    if one_level and not incomplete:
        return Refusal(f"all even areas have {dark:.4g} to {bright:.4g} DN, too narrow for a line")
    generator = np.random.default_rng(SEED)
    numbers = np.searchsorted(parts, quiet.part)
    fits = []
    for _ in range(DRAWS):
        # Parts are drawn with replacement: the weight of a block is how often its part is drawn.
        drawn = generator.integers(parts.size, size=parts.size)
        counts = np.bincount(drawn, minlength=parts.size).astype(np.float64)
        fits.append(_fitted(quiet, counts[numbers]))
    draws = np.array(fits)
    if one_level:
        # It is not known how the noise grows with light. The fit attributes all of it to photons,
        # because a restoration that assumes too much noise in bright light smooths, and one that
        # assumes too little produces grain. The draws range from none to all.
        level = float(np.median(quiet.mean))
        shares = np.append(1.0, generator.uniform(size=len(draws)))
        numbers = np.vstack([fit, draws])
        noise = numbers[:, 0] * level + numbers[:, 1]
        alpha = shares * noise / max(level, ROUNDING)
        splits = np.stack([alpha, (1 - shares) * noise, numbers[:, 2]], axis=1)
        fit = splits[0]
        draws = splits[1:]
    leak = float(
        fit[2] * np.maximum(quiet.structure - quiet.noise(fit), 0).mean() / quiet.fine.mean()
    )
    # Beta without the variance of rounding.
    lines = np.maximum(np.vstack([fit, draws])[:, :2] - (0, ROUNDING), 0.0)
    alpha, beta = lines[0].tolist()
    model = NoiseModel(
        alpha, beta, lines[1:], quiet.mean.size, (dark, bright), leak, one_level=one_level
    )
    return _judged(_with_colour(quiet, model), incomplete)


def _judged(model: NoiseModel, incomplete: bool) -> NoiseModel | Refusal:
    """Return the line, or why it is not the noise of one detector."""
    if model.leak > MAX_LEAK:
        return Refusal(f"{model.leak:.0%} of the finest detail is texture, {MAX_LEAK:.0%} at most")
    if model.white or (incomplete and model.colour >= MOSAIC):
        return model
    mosaic = "not white" if model.colour >= MOSAIC else "a mosaic of unequal channels"
    return Refusal(f"noise {model.colour:.2f} times as strong at middle frequencies: {mosaic}")


def _choose(blocks: Blocks) -> tuple[Blocks, np.ndarray]:
    """Choose the blocks with the least structure that are numerous enough, and fit them.

    Returns:
        The blocks and their fit. If no limit leaves enough blocks, those of the last limit.
    """
    for limit in STRUCTURES:
        quiet, fit = _quiet(blocks, limit)
        if quiet.mean.size >= ENOUGH:
            break
    return quiet, fit


def _quiet(blocks: Blocks, limit: float) -> tuple[Blocks, np.ndarray]:
    """Return the blocks with little structure, and their fit.

    Blocks whose finest detail differs from that of the others by more than chance are excluded.
    """
    noise = expected = np.full(blocks.mean.size, max(np.percentile(blocks.fine, 10), ROUNDING))
    for _ in range(PASSES):
        quiet = blocks.structure <= limit * noise
        if quiet.sum() < LEAST:
            quiet = blocks.structure <= np.partition(blocks.structure, LEAST - 1)[LEAST - 1]
        # Rows of crops, nets and ripples are as fine as noise: such blocks stand apart from the
        # rest.
        alike = np.abs(blocks.fine - expected) <= MAX_SCATTER * math.sqrt(2 / FINE_WAVES) * expected
        sample = blocks.only(quiet & alike if (quiet & alike).sum() >= LEAST else quiet)
        fit = _fitted(sample, np.ones(sample.mean.size))
        noise = blocks.noise(fit)
        expected = noise + fit[2] * np.maximum(blocks.structure - noise, 0)
    return blocks.only((blocks.structure <= limit * noise) & alike), fit


def _fitted(blocks: Blocks, weights: np.ndarray, band: np.ndarray | None = None) -> np.ndarray:
    """Fit (alpha, beta, leak), none negative, to a band (N,), by default the finest.

    The scatter of a mean square is proportional to its size, so residuals are weighted by it.
    """
    from scipy.optimize import nnls

    band = blocks.fine if band is None else band
    size = np.full(band.size, max(float(weights @ band / weights.sum()), ROUNDING))
    fit = np.zeros(3)
    for _ in range(4):
        noise = blocks.noise(fit) if fit.any() else size
        # White noise is equal in all bands, so an excess of the structure is texture.
        terms = np.stack(
            [blocks.mean, np.ones(band.size), np.maximum(blocks.structure - noise, 0)], axis=1
        )
        # A mean square scatters by its size.
        root = np.sqrt(weights) / size
        fit, _ = nnls(terms * root[:, None], band * root)
        size = np.maximum(terms @ fit, 0.3 * ROUNDING)
    return fit


def _with_colour(blocks: Blocks, model: NoiseModel) -> NoiseModel:
    """Return the line with the spectrum of the noise; if that is not flat, return the line of its
    stronger part.

    A restoration should rather be given too much noise than too little, because noise that it
    mistakes for detail is amplified.
    """
    place = np.array([float(np.median(blocks.mean)), 1.0])
    ones = np.ones(blocks.mean.size)
    fine = float((model.alpha, model.beta) @ place)
    spectrum = [
        float((_fitted(blocks, ones, band)[:2] @ place - ROUNDING) / fine)
        for band in blocks.spectrum.T
    ]
    middle = spectrum[MIDDLE]
    scatter = float((model.draws @ place).std()) / fine
    white = abs(middle - 1) <= MAX_COLOUR + COLOUR_SCATTER * scatter
    stronger = 1.0 if white else max(middle, 1.0)
    return replace(
        model,
        alpha=model.alpha * stronger,
        beta=model.beta * stronger,
        draws=model.draws * stronger,
        colour=middle,
        white=bool(white),
        spectrum=tuple(spectrum),
    )
