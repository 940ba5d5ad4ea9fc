"""The targets of an evaluation, as a sensor acquires them: edges, flat fields, points, bars and
zone plates.

The random draws of edges come first, so that they are the same without the other targets.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count, product

import numpy as np

from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.simulator.acquire import NOISE, acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.profiles.instrument import Instrument

OVERSAMPLING = 5
"""Scene pixels per pixel of all targets except flat fields."""

ANGLES_DEG = (3.0, 5.0, 8.0, 11.0)
REPEATS = 3
SIDE_PX = 240

FLAT_PX = 128
RADIANCES = (10.0, 25.0, 100.0)
"""Radiances of the flat fields, W/m2/sr/um."""

POINT_BACKGROUNDS = (20.0, 100.0)
"""The radiance of the backgrounds of points, in W/m2/sr/um."""
POINT_RADIANCES = (12.0, 40.0, 120.0)
"""The light of a point: its contribution to the mean radiance of one pixel, in W/m2/sr/um."""
POINTS_A_SIDE = 6
POINT_STEP_PX = 48

PATTERN_BACKGROUND = 100.0
"""The mean radiance of patterns, in W/m2/sr/um."""
BAR_CONTRASTS = (0.05, 0.10)
BAR_PERIODS_PX = (2.0, 8 / 3, 3.0)
"""The periods of the bars. Contrast is the amplitude of the wave relative to the background."""
BARS_PX = 144
BARS_MEASURED_PX = 64
"""The side of the bars is a multiple of all periods, because scenes wrap around at their
borders.
"""

ZONE_CONTRASTS = (0.08, 0.30)
ZONE_BAND: tuple[float, float] = (0.35, 0.45)
"""The spatial frequencies that are measured, in cycles per pixel."""
ZONE_PX = 288
ZONE_NYQUIST_PX = 96
"""The side, and the radius at which the pattern reaches half a cycle per pixel and ends."""

Edges = Sequence[tuple[float, np.ndarray]]
"""Angle in degrees and image of each slanted edge."""


@dataclass(frozen=True)
class Points:
    """An image of points of light on a flat background, with which the light of points after
    restoration is measured.

    Attributes:
        background: the radiance of the background in W/m2/sr/um.
        acquired: the image that the degraded sensor acquires, (H, W) digital numbers.
        flat: the image of the background without points, (H, W) digital numbers, with the same
            noise.
        expected: the light of the points alone as the reference sensor sees it without noise,
            (H, W) digital numbers.
    """

    background: float
    acquired: np.ndarray
    flat: np.ndarray
    expected: np.ndarray


@dataclass(frozen=True)
class Pattern:
    """An image of faint bars or of a zone plate, with which the transfer of contrast is measured.

    Attributes:
        name: the name of the figure, which states kind, contrast and period.
        acquired: the image that the degraded sensor acquires, (H, W) digital numbers.
        expected: the image that the reference sensor acquires without noise, (H, W) digital
            numbers.
        measured: True where the restored image is compared with `expected`, bool (H, W).
    """

    name: str
    acquired: np.ndarray
    expected: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True)
class Targets:
    """The images of all targets, scenes whose truth is known, as one sensor acquires them.

    Attributes:
        sensor: the sensor that acquired the images.
        edges: the angle in degrees and the image (H, W) of each slanted edge, each with independent
            noise.
        flats: the radiance in W/m2/sr/um and the image (H, W) of each flat field.
        points: the images of points of light, one for each background.
        patterns: the images of bars and zone plates. Several of one name are measured together.
    """

    sensor: Instrument
    edges: Edges
    flats: Sequence[tuple[float, np.ndarray]]
    points: Sequence[Points]
    patterns: Sequence[Pattern]


def acquire_targets(sensor: Instrument, reference: Instrument, seed: int) -> Targets:
    """Simulate how a sensor acquires all targets: edges, flat fields, points, bars, zone plates.

    Args:
        sensor: the sensor of the degraded images.
        reference: the sensor that the restoration aims at, whose images without noise are the
            truth.
        seed: the seed of the noise and of the places of the points within their pixels.
    """
    sensors = sensor, reference.in_units_of(sensor)
    # The first numbers are those of the edges, which draw their own noise (`acquire_edges`).
    draws = (Draw(seed, number) for number in count(len(ANGLES_DEG) * REPEATS))
    flats = []
    for radiance in RADIANCES:
        field = np.full((FLAT_PX, FLAT_PX), radiance, np.float32)
        flats.append((radiance, _acquire(field, sensor, next(draws), ratio=1)))
    points = [
        _acquire_points(background, *sensors, next(draws)) for background in POINT_BACKGROUNDS
    ]
    # Zone plates are cos(pi / 2 r^2 / R): r / 2R cycles per pixel at the radius r.
    frequency = _radius_px(ZONE_PX, 1) / (2 * ZONE_NYQUIST_PX)
    ring = (frequency >= ZONE_BAND[0]) & (frequency <= ZONE_BAND[1])
    radius_px = _radius_px(ZONE_PX, OVERSAMPLING)
    # The pattern ends at the radius where it reaches Nyquist, because it would alias beyond.
    chirp = np.cos(math.pi / 2 * radius_px**2 / ZONE_NYQUIST_PX) * (radius_px < ZONE_NYQUIST_PX)
    plates = [(f"zone plate of {share:.0%}", share * chirp, ring) for share in ZONE_CONTRASTS]
    patterns = []
    for name, contrast, mask in (*_bars(), *plates):
        scene = (PATTERN_BACKGROUND * (1 + contrast)).astype(np.float32)
        draw = next(draws)
        raw = _acquire(scene, sensor, draw)
        patterns.append(Pattern(name, raw, _without_noise(scene, sensors[1], draw), mask))
    return Targets(sensor, acquire_edges(sensor, seed), flats, points, patterns)


def _acquire(
    scene: np.ndarray, sensor: Instrument, draw: Draw, ratio: int = OVERSAMPLING
) -> np.ndarray:
    return acquire(prepare_scene(scene, ratio), sensor, draw, margin_px=0)


def _without_noise(scene: np.ndarray, sensor: Instrument, draw: Draw) -> np.ndarray:
    prepared = prepare_scene(scene, OVERSAMPLING)
    return acquire(prepared, sensor, draw, "reference", margin_px=0, skip=NOISE)


def acquire_edges(sensor: Instrument, seed: int) -> Edges:
    """Simulate how a sensor acquires slanted edges at several angles, each with independent noise.

    Args:
        sensor: the sensor.
        seed: the seed of the noise.

    Returns:
        The angle in degrees and the image, digital numbers (H, W), of each edge.
    """
    edges = []
    for number, angle in enumerate(ANGLES_DEG * REPEATS):
        scene = slanted_edge(SIDE_PX, OVERSAMPLING, angle)
        edges.append((angle, _acquire(scene, sensor, Draw(seed, number))))
    return edges


def _acquire_points(
    background: float, sensor: Instrument, reference: Instrument, draw: Draw
) -> Points:
    # The same field without points, acquired with the same draws: the difference is their light.
    flat = np.full((POINTS_A_SIDE * POINT_STEP_PX * OVERSAMPLING,) * 2, background, np.float32)
    scene = flat.copy()
    generator = draw.generator("points")
    for row, column in point_places():
        # One scene pixel anywhere in its pixel: all phases of the sampling occur.
        y, x = ((at * POINT_STEP_PX + POINT_STEP_PX // 2) * OVERSAMPLING for at in (row, column))
        shift_y, shift_x = generator.integers(OVERSAMPLING, size=2)
        scene[y + shift_y, x + shift_x] += point_radiance(row, column) * OVERSAMPLING**2
    light = _without_noise(scene, reference, draw) - _without_noise(flat, reference, draw)
    return Points(background, _acquire(scene, sensor, draw), _acquire(flat, sensor, draw), light)


def point_places() -> list[tuple[int, int]]:
    """Return row and column of each point in the grid of `POINTS_A_SIDE` points a side."""
    return [divmod(number, POINTS_A_SIDE) for number in range(POINTS_A_SIDE**2)]


def point_radiance(row: int, column: int) -> float:
    """Return the light of the point at a row and column of the grid of points: its contribution to
    the mean radiance of one pixel, in W/m2/sr/um.
    """
    return POINT_RADIANCES[(row + column) % len(POINT_RADIANCES)]


def _bars() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return the bars, each across and along the track: name, contrast (S, S) in scene pixels and
    the mask (H, W) of measured pixels.
    """
    middle = np.zeros((BARS_PX, BARS_PX), bool)
    place = slice((BARS_PX - BARS_MEASURED_PX) // 2, (BARS_PX + BARS_MEASURED_PX) // 2)
    middle[place, place] = True
    bars = []
    for contrast, period_px in product(BAR_CONTRASTS, BAR_PERIODS_PX):
        # The crests lie on the centres of pixels: otherwise bars of a period of 2 px would be lost
        # in the sampling.
        wave = np.cos(2 * math.pi * _places_px(BARS_PX) / period_px)
        across = np.broadcast_to(contrast * wave, (wave.size, wave.size))
        name = f"bars of {contrast:.0%}, period {period_px:.3g} px"
        bars += [(name, across, middle), (name, across.T, middle)]
    return bars


def _places_px(side_px: int, ratio: int = OVERSAMPLING) -> np.ndarray:
    """Return the positions of the scene pixels of a side, in pixels. 0 is the centre of the first
    pixel.
    """
    return (np.arange(side_px * ratio) - (ratio - 1) / 2) / ratio


def _radius_px(side_px: int, ratio: int) -> np.ndarray:
    """Return the distance of every scene pixel from the middle, (side_px *
    ratio,) * 2, in pixels.
    """
    place = _places_px(side_px, ratio) - (side_px - 1) / 2
    return np.hypot(place[:, None], place)
