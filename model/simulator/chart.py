"""Draw a chart of squares: flat ground, faint bars, zone plates, soft texture, discs and points,
dark and bright.

Photographs rarely show faint and fine patterns, and never without a camera's noise. Charts teach a
network to preserve what the raw image shows of them, and to add nothing to flat areas.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.simulator.procedural import texture
from beers_deploy.model.simulator.sampling import Scene

SIDE_PX = 1080
SQUARE_PX = 180
"""Side of each square. It is a multiple of the target pixel at every oversampling from 2 to 6, as
is the side of a chart.
"""

LEVELS = (3.0, 390.0)
"""Radiance of the ground in W/m2/sr/um, log-uniform."""
PERIODS_PX = (3.0, 24.0)
"""Period of bars in scene pixels, log-uniform."""
CONTRASTS = (0.01, 0.6)
"""Contrast of bars, plates and discs: half of the difference over the mean, log-uniform."""
POINTS = (50.0, 20_000.0)
"""Radiance of a point of one scene pixel, log-uniform."""

Pattern = NDArray[np.float64]


def draw_charts(count: int, seed: int) -> list[Scene]:
    """Draw charts, each with its own generator."""
    generators = np.random.default_rng(seed).spawn(count)
    return [
        Scene(f"chart {number}", chart(generator)) for number, generator in enumerate(generators)
    ]


def chart(generator: np.random.Generator) -> NDArray[np.float32]:
    """Draw a chart (SIDE_PX, SIDE_PX) of radiance in W/m2/sr/um."""
    kinds = (flat, bars, zone_plate, soft_texture, discs, points)
    radiance = np.empty((SIDE_PX, SIDE_PX))
    for top in range(0, SIDE_PX, SQUARE_PX):
        for left in range(0, SIDE_PX, SQUARE_PX):
            kind: Callable[[float, np.random.Generator], Pattern] = kinds[
                int(generator.integers(len(kinds)))
            ]
            level = log_uniform(generator, LEVELS)
            radiance[top : top + SQUARE_PX, left : left + SQUARE_PX] = kind(level, generator)
    return radiance.astype(np.float32)


def flat(level: float, _generator: np.random.Generator) -> Pattern:
    """Return a square with the radiance `level`, in W/m2/sr/um, everywhere."""
    return np.full((SQUARE_PX, SQUARE_PX), level)


def bars(level: float, generator: np.random.Generator) -> Pattern:
    """Draw bars of any direction, between a sine and a square wave, around the radiance `level`."""
    y, x = _coordinates()
    angle = float(generator.uniform(0, math.pi))
    # Rows and columns are the commonest direction, and the hardest: they alias.
    if generator.random() < 0.5:
        angle = float(generator.choice([0.0, math.pi / 2]))
    wave_number = 2 * math.pi / log_uniform(generator, PERIODS_PX)
    phase = wave_number * (x * math.cos(angle) + y * math.sin(angle))
    return _wave(level, phase + generator.uniform(0, 2 * math.pi), generator)


def zone_plate(level: float, generator: np.random.Generator) -> Pattern:
    """Draw rings whose period falls outwards, down to PERIODS_PX[0] at most."""
    y, x = _coordinates()
    # The local frequency of a r^2 is a r / pi.
    steepest = math.pi / (PERIODS_PX[0] * SQUARE_PX / math.sqrt(2))
    return _wave(level, steepest * generator.uniform(0.3, 1) * (x**2 + y**2), generator)


def soft_texture(level: float, generator: np.random.Generator) -> Pattern:
    """Draw 1/f texture of low contrast around the radiance `level` in W/m2/sr/um, as of fields and
    lawn.
    """
    pattern = np.log(texture(SQUARE_PX, SQUARE_PX, generator))
    return np.asarray(level * np.exp(pattern * float(generator.uniform(0.05, 1.0))), np.float64)


def discs(level: float, generator: np.random.Generator) -> Pattern:
    """Draw discs that are a little brighter or darker than the ground of radiance `level`."""
    y, x = _coordinates()
    pattern = np.full((SQUARE_PX, SQUARE_PX), level)
    for _ in range(12):
        middle_y, middle_x = generator.uniform(-SQUARE_PX / 2, SQUARE_PX / 2, 2)
        inside = np.hypot(y - middle_y, x - middle_x) < generator.uniform(2, 30)
        pattern[inside] = level * (
            1 + float(generator.choice([-1, 1])) * log_uniform(generator, CONTRASTS)
        )
    return pattern


def points(level: float, generator: np.random.Generator) -> Pattern:
    """Draw points of light on flat ground of radiance `level`."""
    pattern = np.full((SQUARE_PX, SQUARE_PX), level)
    for _ in range(30):
        row, column = generator.integers(SQUARE_PX, size=2)
        pattern[row, column] += log_uniform(generator, POINTS)
    return pattern


def _coordinates() -> tuple[Pattern, Pattern]:
    places = np.asarray(np.arange(SQUARE_PX) - (SQUARE_PX - 1) / 2, np.float64)
    return places[:, None], places[None, :]


def _wave(level: float, phase: Pattern, generator: np.random.Generator) -> Pattern:
    steepness = float(generator.uniform(1, 4))
    contrast = log_uniform(generator, CONTRASTS)
    return level * (1 + contrast * np.clip(steepness * np.sin(phase), -1, 1))


def log_uniform(generator: np.random.Generator, ends: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform."""
    low, high = ends
    return low * math.exp(float(generator.uniform()) * math.log(high / low))
