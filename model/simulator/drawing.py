"""What drawn scenes share: radiances of a clear day in W/m2/sr/um, the texture of the ground, and shapes on a canvas.

Pillow's canvas holds floats; points are (x, y) in its pixels.
"""

import math
from collections.abc import Callable

import numpy as np
from PIL import ImageDraw

Point = tuple[float, float]

SHADOW, ASPHALT, GRASS, SOIL, CONCRETE, WHITE, WATER = 12.0, 30.0, 45.0, 75.0, 120.0, 260.0, 16.0


def texture(height_px: int, width_px: int, generator: np.random.Generator) -> np.ndarray:
    """Multiplicative 1/f texture around 1, some 12 % rms: nothing on the ground is flat."""
    white = generator.standard_normal((height_px, width_px), dtype=np.float32)
    fy, fx = np.fft.fftfreq(height_px)[:, None], np.fft.rfftfreq(width_px)[None, :]
    radius = np.hypot(fx, fy)
    spectrum = np.fft.rfft2(white) / np.maximum(radius, 1 / 400)
    pattern = np.fft.irfft2(spectrum, s=(height_px, width_px))
    return np.asarray(np.exp(0.12 * pattern / pattern.std()))


def tree(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, generator: np.random.Generator) -> None:
    """A shadow, a dark crown around (x, y) with sunlit and darker leaves."""
    draw.ellipse(around(x + 0.6 * radius, y + 0.6 * radius, radius), fill=SHADOW)
    draw.ellipse(around(x, y, radius), fill=float(generator.uniform(24, 34)))
    draw.ellipse(around(x - 0.25 * radius, y - 0.25 * radius, 0.65 * radius), fill=float(generator.uniform(36, 60)))
    for _ in range(6):
        dx, dy = generator.uniform(-0.6, 0.4, 2) * radius
        draw.ellipse(around(x + dx, y + dy, 0.14 * radius), fill=float(generator.uniform(20, 80)))


def box(corner: Point, width: float, height: float, angle: float) -> list[Point]:
    """A rectangle turned about its corner."""
    place = turn(*corner, angle)
    return [place(0, 0), place(width, 0), place(width, height), place(0, height)]


def rectangle(half_long: float, half_wide: float) -> list[Point]:
    """A rectangle around (0, 0)."""
    return [(-half_long, -half_wide), (half_long, -half_wide), (half_long, half_wide), (-half_long, half_wide)]


def turn(x: float, y: float, angle: float) -> Callable[[float, float], Point]:
    """From a turned frame centred at (x, y) to the canvas."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return lambda u, v: (x + cosine * u - sine * v, y + sine * u + cosine * v)


def shift(point: Point, by: float) -> Point:
    """A point moved right and down: where the shadow of something of that height falls."""
    return (point[0] + by, point[1] + by)


def around(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    """The square (left, top, right, bottom) around a circle."""
    return (x - radius, y - radius, x + radius, y + radius)
