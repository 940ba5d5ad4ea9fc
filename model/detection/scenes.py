"""Drawn scenes with known objects: plots of harbour, apron, tank farm, car park, houses and fields between streets.

The world is that of the procedural scene, its radiances and its texture, drawn at 0.25 m a pixel and turned as a
whole: of three scene pixels a sensor makes one of 0.75 m, in which a car is 6 pixels long.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.detection.canvas import SCENE_GSD_M, Canvas, Plot
from model.detection.objects import AIRCRAFT, CLASSES, SHIP, TANK, VEHICLE, aircraft, ship, tank, vehicle
from model.simulator.drawing import ASPHALT, CONCRETE, SHADOW, SOIL, WATER, WHITE, turn

__all__ = ["CLASSES", "SCENE_GSD_M", "LabelledScene", "labelled_scene"]

PLOT_M, STREET_M = 96.0, 9.0
KERB_M = 2.0


@dataclass(frozen=True)
class LabelledScene:
    """A scene and what stands in it.

    Attributes:
        radiance: (H, W) float32 in W/m2/sr/um.
        corners: (N, 4) float64, x1, y1, x2, y2 in scene pixels, where pixel i covers [i, i + 1): exactly the pixels
            of the object, its shadow left out.
        classes: (N,) int64 into `CLASSES`.
    """

    radiance: np.ndarray
    corners: np.ndarray
    classes: np.ndarray


def labelled_scene(generator: np.random.Generator, height_px: int, width_px: int) -> LabelledScene:
    """Draw a scene of that many pixels of 0.25 m, the same for the same generator state.

    Every object lies whole within the scene, touches no other, and nothing covers it.
    """
    canvas = Canvas(height_px, width_px, generator)
    angle, (x, y) = float(generator.uniform(-0.5, 0.5)), generator.uniform(-0.5, 0.5, 2) * PLOT_M
    world, reach = turn(x, y, angle), canvas.reach_m + PLOT_M
    places = (np.arange(math.ceil(2 * reach / PLOT_M)) + 0.5) * PLOT_M - reach
    plots = [Plot(canvas, *world(u, v), angle, (PLOT_M - STREET_M) / 2 - KERB_M) for v in places for u in places]
    streets = [(world(p + PLOT_M / 2, 0), angle + math.pi / 2) for p in places]
    streets += [(world(0, p + PLOT_M / 2), angle) for p in places]
    strips = [Plot(canvas, *centre, turned, reach) for centre, turned in streets]
    for strip in strips:
        _street(strip)
    for plot in plots:
        _KINDS[int(generator.integers(len(_KINDS)))](plot)
    for strip in strips:
        _traffic(strip)
    return LabelledScene(
        canvas.textured(), np.array(canvas.corners, np.float64).reshape(-1, 4), np.array(canvas.classes, np.int64)
    )


def _street(strip: Plot) -> None:
    """Asphalt between pavements, dashes in the middle."""
    reach = strip.half_m
    strip.rectangle(-reach, -STREET_M / 2 - KERB_M, 2 * reach, STREET_M + 2 * KERB_M, CONCRETE * 0.8)
    strip.rectangle(-reach, -STREET_M / 2, 2 * reach, STREET_M, ASPHALT)
    for u in np.arange(-reach, reach, 8.0):
        strip.line((u, 0.0), (u + 3.4, 0.0), WHITE * 0.7, 0.3)


def _traffic(strip: Plot) -> None:
    for u in strip.random.uniform(-strip.half_m, strip.half_m, int(strip.half_m / 12)):
        side = float(strip.random.choice([-1, 1]))
        turned = float(strip.random.normal(0, 0.03)) + (math.pi if side > 0 else 0.0)
        strip.put(VEHICLE, vehicle(strip.random), float(u), side * 2.3, turned, 0.8)


def _harbour(plot: Plot) -> None:
    """Water, a quay along one side, a pier, and ships beside them or under way."""
    plot.pad(WATER)
    half = plot.half_m
    plot.rectangle(-half, -half, 2 * half, 7.0, CONCRETE)
    pier = float(plot.random.uniform(-0.4, 0.4)) * half
    plot.rectangle(pier, -half, 4.0, float(plot.random.uniform(0.4, 1.3)) * half, CONCRETE * 0.8)
    for _ in range(int(plot.random.integers(0, 6))):
        plot.put(VEHICLE, vehicle(plot.random), float(plot.random.uniform(-half, half)), 3.5 - half, 0.0, 0.8)

    def sail(x: float, y: float) -> bool:
        moored, anywhere = plot.random.choice([0, math.pi / 2]), plot.random.uniform(0, math.tau)
        parts, turned = ship(plot.random), float(plot.random.choice([moored, anywhere]))
        hull = np.array([turn(x, y, turned)(*point) for point in parts[0][0]])
        return _is_afloat(hull, plot, pier) and plot.put(SHIP, parts, x, y, turned, 1.5)

    plot.scatter(int(plot.random.integers(3, 14)), sail)


def _is_afloat(hull: np.ndarray, plot: Plot, pier: float) -> bool:
    """Whether a hull (N, 2), in metres of the plot, clears the quay and the pier."""
    clear_of_pier = hull[:, 0].max() < pier or hull[:, 0].min() > pier + 4
    return bool(hull[:, 1].min() > 7 - plot.half_m and clear_of_pier)


def _apron(plot: Plot) -> None:
    """Concrete slabs, a taxi line, aircraft parked at any angle, and what serves them."""
    plot.pad(CONCRETE * float(plot.random.uniform(0.6, 1.0)))
    half = plot.half_m
    for position in np.arange(-half, half, 7.5):
        plot.line((position, -half), (position, half), CONCRETE * 0.65, 0.25)
        plot.line((-half, position), (half, position), CONCRETE * 0.65, 0.25)
    bend = float(plot.random.uniform(-0.5, 0.5)) * half
    plot.line((-half, bend), (half, bend), WHITE * 0.8, 0.3)
    plot.scatter(
        int(plot.random.integers(1, 8)),
        lambda x, y: plot.put(AIRCRAFT, aircraft(plot.random), x, y, float(plot.random.uniform(0, math.tau)), 2.5),
    )
    _scatter_vehicles(plot, 5)


def _tank_farm(plot: Plot) -> None:
    """Gravel, bunds around each tank, and tanks of one or two sizes."""
    plot.pad(SOIL * float(plot.random.uniform(0.8, 1.3)))
    radius = float(plot.random.uniform(5, 15))
    step = 2.9 * radius + 3
    count = int(2 * plot.half_m / step)
    start = -step * (count - 1) / 2
    for row in range(count):
        for column in range(count):
            x, y = start + step * column, start + step * row
            for side in (-0.48 * step, 0.48 * step):
                plot.line((x + side, y - 0.48 * step), (x + side, y + 0.48 * step), CONCRETE, 0.8)
                plot.line((x - 0.48 * step, y + side), (x + 0.48 * step, y + side), CONCRETE, 0.8)
            if plot.random.random() < 0.75:
                own = radius * float(plot.random.choice([1.0, 1.0, 0.6]))
                plot.put(TANK, tank(own, plot.random), x, y, 0.0, 0.35 * own)
    _scatter_vehicles(plot, 3)


def _car_park(plot: Plot) -> None:
    """Rows of stalls between lanes, some 60 % taken, a few trees in between."""
    plot.pad(ASPHALT * float(plot.random.uniform(0.9, 1.6)))
    half, taken = plot.half_m, float(plot.random.uniform(0.2, 0.9))
    for y in np.arange(6.0 - half, half - 4, 13.0):
        for x in np.arange(3.0 - half, half - 3, 2.9):
            plot.line((x - 1.45, y - 2.6), (x - 1.45, y + 2.6), WHITE * 0.6, 0.25)
            if plot.random.random() < taken:
                turned = math.pi / 2 * float(plot.random.choice([-1, 1])) + float(plot.random.normal(0, 0.03))
                plot.put(VEHICLE, vehicle(plot.random), float(x), float(y), turned, 0.8)
        if plot.random.random() < 0.5:
            plot.tree(float(plot.random.uniform(-half, half)), float(y) + 6)


def _houses(plot: Plot) -> None:
    """Gable roofs and flat halls in gardens, trees, a car here and there."""
    half = plot.half_m
    for y in np.arange(14.0 - half, half - 8, 24.0):
        for x in np.arange(12.0 - half, half - 8, 20.0):
            long, wide = plot.random.uniform(9, 16), plot.random.uniform(7, 11)
            _house(plot, float(x - long / 2), float(y - wide / 2), float(long), float(wide))
            plot.tree(float(x + plot.random.uniform(-9, 9)), float(y + 11))
    _scatter_drives(plot)


def _house(plot: Plot, x: float, y: float, long: float, wide: float) -> None:
    """A roof, one slope in the sun, and its shadow."""
    bright, shade = float(plot.random.uniform(60, 200)), 2.2
    corners = [(x, y), (x + long, y), (x + long, y + wide), (x, y + wide)]
    plot.canvas.area([(px + shade, py + shade) for px, py in (plot.place(*c) for c in corners)], SHADOW)
    plot.rectangle(x, y, long, wide / 2, bright)
    plot.rectangle(x, y + wide / 2, long, wide / 2, bright * float(plot.random.choice([0.55, 1.0])))


def _scatter_drives(plot: Plot) -> None:
    """Cars in the gaps between the houses' rows."""
    for y in np.arange(26.0 - plot.half_m, plot.half_m - 4, 24.0):
        for x in plot.random.uniform(-plot.half_m, plot.half_m, 3):
            plot.rectangle(float(x) - 3.5, float(y) - 1.6, 7.0, 3.2, CONCRETE * 0.7)
            plot.put(VEHICLE, vehicle(plot.random), float(x), float(y), 0.0, 0.8)


def _scatter_vehicles(plot: Plot, most: int) -> None:
    plot.scatter(
        int(plot.random.integers(0, most + 1)),
        lambda x, y: plot.put(VEHICLE, vehicle(plot.random), x, y, float(plot.random.uniform(0, math.tau)), 0.8),
    )


def _field(plot: Plot) -> None:
    """Crop rows, and the trees of a hedge."""
    base, half = float(plot.random.choice([38, 55, 70, 88])), plot.half_m
    plot.pad(base)
    for x in np.arange(-half, half, float(plot.random.uniform(0.8, 2.5))):
        plot.line((float(x), -half), (float(x), half), base * 0.85, 0.4)
    for y in plot.random.uniform(-half, half, 12):
        plot.tree(half - 4, float(y))


def _forest(plot: Plot) -> None:
    """Trees, crown at crown."""
    for x, y in plot.random.uniform(-plot.half_m, plot.half_m, (260, 2)):
        plot.tree(float(x), float(y))


_KINDS = (_harbour, _harbour, _apron, _apron, _tank_farm, _car_park, _houses, _field, _forest)
