"""The hard cases: images (H, W) float32 in digital numbers of 12 bits that an instrument
encounters, or that a fault produces.

The same generator draws the same images.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft

from beers_deploy.model.simulator.mtf import transfer_function

FULL_DN = 4095
SIDE_PX = 96
DRAWN_MTF = 0.25
"""The MTF at Nyquist of the drawn ground, as a sharp sensor sees it."""

Draw = Callable[[int, np.random.Generator], list[np.ndarray]]
"""Draws images for a side in pixels. Their order has no meaning."""


def flat(*levels: float) -> Draw:
    """Return a function that draws constant images (side, side), one for each level.

    Args:
        levels: the brightness of each image as a share of full scale.
    """
    return lambda side, _: [_filled(side, level * FULL_DN) for level in levels]


def steps(side: int, _: np.random.Generator) -> list[np.ndarray]:
    """Draw steps from black to full scale, vertical, horizontal and slanted: three images (side,
    side).
    """
    row, column = np.mgrid[:side, :side]
    return [
        _two(column >= side // 2),
        _two(row >= side // 2),
        _two(column + 0.2 * row >= 0.6 * side),
    ]


def checkerboard(side: int, _: np.random.Generator) -> list[np.ndarray]:
    """Draw black and full scale alternately, which is Nyquist along both axes: one image (side,
    side).
    """
    row, column = np.mgrid[:side, :side]
    return [_two((row + column) % 2 == 1)]


def hot_pixel(side: int, _: np.random.Generator) -> list[np.ndarray]:
    """Draw one pixel at full scale on dark ground: one image (side, side)."""
    image = _filled(side, 200)
    image[side // 2, side // 2] = FULL_DN
    return [image]


def dead_lines(side: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Draw a landscape (`ground`) with a column and a row at 0: one image (side, side)."""
    image = ground(side, generator)
    image[:, side // 3] = 0
    image[side // 2] = 0
    return [image]


def glint(side: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Draw dark water with glints beyond full scale, clipped: one image (side, side)."""
    image = 150 + 10 * generator.standard_normal((side, side))
    sparks = generator.random((side, side)) > 0.97
    image[sparks] += generator.exponential(6000, int(sparks.sum()))
    return [_digital(image)]


def snow(side: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Draw 99 % of the pixels at full scale and the rest in shadow: one image (side, side)."""
    image = _filled(side, FULL_DN)
    shadow = generator.random((side, side)) < 0.01
    image[shadow] = generator.uniform(500, 3500, int(shadow.sum()))
    return [_digital(image)]


def night(side: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Draw integers of 1 to 20 DN: one image (side, side)."""
    return [generator.integers(1, 21, (side, side)).astype(np.float32)]


def ramps(side: int, _: np.random.Generator) -> list[np.ndarray]:
    """Draw a ramp over 12 bits from left to right, (side, side), and an image of every number once,
    (64, 64).
    """
    across = np.tile(np.linspace(0, FULL_DN, side), (side, 1))
    return [_digital(across), np.arange(4096, dtype=np.float32).reshape(64, 64)]


def star(side: int, _: np.random.Generator) -> list[np.ndarray]:
    """Draw a Siemens star of 36 spokes, whose middle is finer than the pixels: one image (side,
    side).
    """
    row, column = np.mgrid[:side, :side] - (side - 1) / 2
    return [_two(np.sin(18 * np.arctan2(row, column)) > 0)]


def noisy(side: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Draw one landscape (side, side) whose noise is a third of the signal at every brightness."""
    clean = ground(side, generator)
    return [_digital(clean * (1 + generator.standard_normal(clean.shape) / 3))]


def through(mtf_nyquist: float) -> Draw:
    """Return a function that draws one image (side, side): a landscape (`ground`) seen through an
    instrument with the given MTF at Nyquist (a share), without noise.
    """
    return lambda side, generator: [ground(side, generator, mtf_nyquist)]


def stripes(side: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Draw a landscape (`ground`) that lacks every seventh column and one row (NaN): one image
    (side, side).
    """
    image = ground(side, generator)
    image[:, 3::7] = np.nan
    image[side // 4] = np.nan
    return [image]


def scattered(value: float) -> Draw:
    """Return a function that draws one image (side, side): a landscape (`ground`) in which 2 % of
    the pixels have the given value.
    """

    def draw(side: int, generator: np.random.Generator) -> list[np.ndarray]:
        image = ground(side, generator)
        image[generator.random(image.shape) < 0.02] = value
        return [image]

    return draw


def sized(*shapes: tuple[int, int]) -> Draw:
    """Return a function that cuts images of the given shapes (H, W) from one drawn landscape
    (`ground`). The side that it is called with has no effect.
    """

    def draw(_: int, generator: np.random.Generator) -> list[np.ndarray]:
        largest = ground(max(max(shape) for shape in shapes), generator)
        return [largest[: shape[0], : shape[1]].copy() for shape in shapes]

    return draw


def narrow(_: int, __: np.random.Generator) -> list[np.ndarray]:
    """Draw an image of one row, (1, 97), and one of one column, (97, 1), at half of full scale."""
    row = np.full((1, 97), FULL_DN // 2, np.float32)
    return [row, row.T.copy()]


def ground(side: int, generator: np.random.Generator, mtf_nyquist: float = DRAWN_MTF) -> np.ndarray:
    """Draw a landscape of rectangles of all sizes and brightnesses, as an instrument sees it.

    Args:
        side: the side of the image in pixels.
        generator: draws the rectangles.
        mtf_nyquist: the instrument's MTF at Nyquist, a share; by default that of a sharp one.

    Returns:
        An image (side, side) of integers of 0 to 4095, float32, without noise.
    """
    image = _filled(side, generator.uniform(800, 1600))
    for _ in range(40):
        top, left = generator.integers(0, side, 2)
        height, width = generator.integers(1, max(side // 3, 2), 2)
        image[top : top + height, left : left + width] = generator.uniform(100, 4000)
    spectrum = fft.rfft2(image) * transfer_function(side, side, 1, mtf_nyquist)
    return _digital(fft.irfft2(spectrum, s=(side, side)))


def _filled(side: int, dn: float) -> np.ndarray:
    return np.full((side, side), np.rint(dn), np.float32)


def _two(bright: np.ndarray) -> np.ndarray:
    return np.where(bright, np.float32(FULL_DN), np.float32(0))


def _digital(image: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.rint(image), 0, FULL_DN), np.float32)


@dataclass(frozen=True)
class Case:
    """A hard case: a kind of image that is difficult for a network.

    Attributes:
        name: the short name in tables.
        draw: the function that draws the images of the case, given a side in pixels and a random
            generator.
        pixels: "valid" if all pixels are valid, or the fault of some: "missing" (NaN), "infinite",
            or "beyond" 12 bits.
        flat: True if all pixels of an image are equal, so that the mean must be preserved.
        large: True if the image is so large that only the checks of a single run are made.
    """

    name: str
    draw: Draw
    pixels: str = "valid"
    flat: bool = False
    large: bool = False


CASES = (
    Case("black", flat(0.0), flat=True),
    Case("full scale", flat(1.0), flat=True),
    Case("deciles", flat(*(k / 10 for k in range(1, 10))), flat=True),
    Case("steps", steps),
    Case("checkerboard", checkerboard),
    Case("hot pixel", hot_pixel),
    Case("dead column and row", dead_lines),
    Case("glint", glint),
    Case("snow", snow),
    Case("night", night),
    Case("ramps", ramps),
    Case("Siemens star", star),
    Case("SNR 3", noisy),
    Case("no noise", through(DRAWN_MTF)),
    Case("MTF 0.1 %", through(0.001)),
    Case("MTF 60 %", through(0.6)),
    Case("nodata stripes", stripes, pixels="missing"),
    Case("NaN pixels", scattered(np.nan), pixels="missing"),
    Case("infinite pixels", scattered(np.inf), pixels="infinite"),
    Case("beyond 12 bits", scattered(60_000), pixels="beyond"),
    Case("1 x 1", sized((1, 1))),
    Case("1 x N", sized((1, 97), (97, 1))),
    Case("flat 1 x N", narrow, flat=True),
    Case("35 x 35", sized((35, 35))),
    Case("641 x 640", sized((640, 641)), large=True),
)
