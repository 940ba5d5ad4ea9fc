"""Synthetic scenes with known objects: vehicles, ships, aircraft and tanks on plots of ground
between streets.

Radiances and texture are those of the simulator's procedural scene. The scene is drawn at 0.25 m a
pixel and rotated as a whole. A sensor makes one pixel of 0.75 m from three scene pixels, so a car
is 6 pixels long.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from PIL import Image, ImageDraw

from beers_deploy.model.simulator import procedural as drawing
from beers_deploy.model.simulator.procedural import Point
from beers_deploy.studies.detection.boxes import Boxes
from benchmarks.detector.objects import Part, aircraft, ship, tank, vehicle

CLASSES = ("vehicle", "ship", "aircraft", "tank")
VEHICLE, SHIP, AIRCRAFT, TANK = range(len(CLASSES))

SCENE_GSD_M = 0.25
"""Ground sampling distance of the scene."""
GAP_PX = 3
"""The number of scene pixels that stay free around an object and its shadow."""
TRIES = 4
"""The number of attempts to find a place before an object is left out."""
PLOT_M = 96.0
STREET_M = 9.0
KERB_M = 2.0


def synthetic_scene(
    generator: np.random.Generator, height_px: int, width_px: int
) -> tuple[np.ndarray, Boxes]:
    """Draw a scene of `height_px` x `width_px` pixels of 0.25 m. The same generator state gives the
    same scene.

    Returns:
        Radiance (H, W) float32 in W/m2/sr/um, and the boxes of its objects, of `CLASSES`. A box
        covers exactly the object's pixels, without its shadow. Every object lies completely within
        the scene, touches no other, and nothing covers it.
    """
    canvas = Canvas(height_px, width_px, generator)
    angle = generator.uniform(-0.5, 0.5)
    x, y = generator.uniform(-0.5, 0.5, 2) * PLOT_M
    # Half the diagonal: how far from the centre there is something to draw.
    world = drawing.turn(x, y, angle)
    reach = math.hypot(width_px, height_px) * SCENE_GSD_M / 2 + PLOT_M
    places = (np.arange(math.ceil(2 * reach / PLOT_M)) + 0.5) * PLOT_M - reach
    half_m = (PLOT_M - STREET_M) / 2 - KERB_M
    turn = drawing.turn
    plots = [Plot(canvas, turn(*world(u, v), angle), half_m) for v, u in product(places, places)]
    strips = [
        Plot(canvas, turn(*world(p + PLOT_M / 2, 0), angle + math.pi / 2), reach) for p in places
    ]
    strips += [Plot(canvas, turn(*world(0, p + PLOT_M / 2), angle), reach) for p in places]
    for strip in strips:
        _street(strip)
    for plot in plots:
        _KINDS[int(generator.integers(len(_KINDS)))](plot)
    for strip in strips:
        _traffic(strip)
    return canvas.textured(), Boxes.of(canvas.corners, canvas.classes)


class Canvas:
    """A scene that is being drawn, in metres around its centre: the radiance, and the objects on
    it.
    """

    def __init__(self, height_px: int, width_px: int, generator: np.random.Generator) -> None:
        self.generator = generator
        self.corners: list[tuple[int, int, int, int]] = []
        self.classes: list[int] = []
        self.size = width_px, height_px
        self._image = Image.new("F", self.size, drawing.GRASS)
        self._occupied = Image.new("L", self.size, 0)
        self.draw = ImageDraw.Draw(self._image)

    def textured(self) -> np.ndarray:
        """Return the radiance (H, W) float32 with the ground's texture."""
        width, height = self.size
        texture = drawing.texture(height, width, self.generator)
        return np.asarray(np.asarray(self._image) * texture, np.float32)

    def is_free(self, left: float, top: float, right: float, bottom: float) -> bool:
        """Return True if no object stands in a rectangle, in pixels."""
        box = math.floor(left), math.floor(top), math.floor(right), math.floor(bottom)
        return self._occupied.crop(box).getbbox() is None

    def put(self, kind: int, polygons: list[Part], shadow_px: float) -> None:
        """Draw an object from polygons in pixels, over the shadow that it casts to the right and
        downwards.
        """
        for polygon, _ in polygons:
            self.draw.polygon(
                [drawing.shift(point, shadow_px) for point in polygon], fill=drawing.SHADOW
            )
        own = Image.new("L", self.size, 0)
        for polygon, paint in polygons:
            self.draw.polygon(polygon, fill=paint)
            ImageDraw.Draw(own).polygon(polygon, fill=255)
        self._occupied.paste(255, mask=own)
        self.classes.append(kind)
        # The box of the pixels that Pillow fills, not of the polygons.
        self.corners.append(own.getbbox() or (0, 0, 0, 0))


@dataclass(frozen=True)
class Plot:
    """A square plot of ground. `place` maps metres around its centre to metres on the canvas."""

    canvas: Canvas
    place: Callable[[float, float], Point]
    half_m: float

    @property
    def random(self) -> np.random.Generator:
        """The generator of the canvas."""
        return self.canvas.generator

    def rectangle(
        self, x: float, y: float, width: float, height: float, radiance: float, by: float = 0
    ) -> None:
        """Fill a rectangle of the plot from its corner (x, y), shifted right and down in the scene
        by `by` pixels.
        """
        corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
        outline = [drawing.shift(self._pixel(*corner), by) for corner in corners]
        self.canvas.draw.polygon(outline, fill=radiance)

    def pad(self, radiance: float) -> None:
        """Fill the whole plot."""
        self.rectangle(-self.half_m, -self.half_m, 2 * self.half_m, 2 * self.half_m, radiance)

    def line(self, start: Point, end: Point, radiance: float, width_m: float) -> None:
        """Draw a line on the plot."""
        width_px = max(round(width_m / SCENE_GSD_M), 1)
        self.canvas.draw.line(
            [self._pixel(*start), self._pixel(*end)], fill=radiance, width=width_px
        )

    def tree(self, x: float, y: float) -> None:
        """Draw a tree of 1.5 to 3.5 m radius, unless an object stands there."""
        radius = self.random.uniform(1.5, 3.5) / SCENE_GSD_M
        middle = self._pixel(x, y)
        if self.canvas.is_free(*drawing.around(*middle, 2 * radius)):
            drawing.tree(self.canvas.draw, *middle, radius, self.random)

    def put(
        self, kind: int, parts: list[Part], x: float, y: float, turned: float, height_m: float
    ) -> bool:
        """Put a rotated object at (x, y) if it lies completely within plot and scene and clear of
        others. Return True if it does.
        """
        own = drawing.turn(x, y, turned)
        shadow_px = height_m / SCENE_GSD_M
        outlines = [[own(*point) for point in polygon] for polygon, _ in parts]
        polygons = [[self._pixel(*point) for point in outline] for outline in outlines]
        points = np.concatenate(polygons)
        low = points.min(0) - GAP_PX
        high = points.max(0) + GAP_PX + shadow_px
        if (
            np.abs(np.concatenate(outlines)).max() > self.half_m
            or low.min() < 0
            or (high >= self.canvas.size).any()
        ):
            return False
        if not self.canvas.is_free(*low, *high):
            return False
        self.canvas.put(
            kind,
            [(polygon, paint) for polygon, (_, paint) in zip(polygons, parts, strict=True)],
            shadow_px,
        )
        return True

    def scatter(self, count: int, put: Callable[[float, float], bool]) -> None:
        """Put up to `count` objects at random places on the plot. An object that finds no room is
        left out.
        """
        for _ in range(count):
            any(put(*self.random.uniform(-self.half_m, self.half_m, 2)) for _ in range(TRIES))

    def _pixel(self, x: float, y: float) -> Point:
        right, down = self.place(x, y)
        width, height = self.canvas.size
        return right / SCENE_GSD_M + width / 2, down / SCENE_GSD_M + height / 2


def _street(strip: Plot) -> None:
    reach = strip.half_m
    strip.rectangle(
        -reach, -STREET_M / 2 - KERB_M, 2 * reach, STREET_M + 2 * KERB_M, drawing.CONCRETE * 0.8
    )
    strip.rectangle(-reach, -STREET_M / 2, 2 * reach, STREET_M, drawing.ASPHALT)
    for u in np.arange(-reach, reach, 8.0):
        strip.line((u, 0.0), (u + 3.4, 0.0), drawing.WHITE * 0.7, 0.3)


def _traffic(strip: Plot) -> None:
    for u in strip.random.uniform(-strip.half_m, strip.half_m, int(strip.half_m / 12)):
        side = strip.random.choice([-1, 1])
        turned = strip.random.normal(0, 0.03) + (math.pi if side > 0 else 0.0)
        strip.put(VEHICLE, vehicle(strip.random), u, side * 2.3, turned, 0.8)


def _harbour(plot: Plot) -> None:
    """Draw water, a quay along one side, a pier, and ships moored or under way."""
    plot.pad(drawing.WATER)
    half = plot.half_m
    plot.rectangle(-half, -half, 2 * half, 7.0, drawing.CONCRETE)
    pier = plot.random.uniform(-0.4, 0.4) * half
    plot.rectangle(pier, -half, 4.0, plot.random.uniform(0.4, 1.3) * half, drawing.CONCRETE * 0.8)
    for _ in range(int(plot.random.integers(0, 6))):
        plot.put(
            VEHICLE, vehicle(plot.random), plot.random.uniform(-half, half), 3.5 - half, 0.0, 0.8
        )

    def sail(x: float, y: float) -> bool:
        moored = plot.random.choice([0, math.pi / 2])
        anywhere = plot.random.uniform(0, math.tau)
        parts = ship(plot.random)
        turned = plot.random.choice([moored, anywhere])
        hull = np.array([drawing.turn(x, y, turned)(*point) for point in parts[0][0]])
        clear_of_pier = hull[:, 0].max() < pier or hull[:, 0].min() > pier + 4
        clear = clear_of_pier and hull[:, 1].min() > 7 - plot.half_m
        return bool(clear) and plot.put(SHIP, parts, x, y, turned, 1.5)

    plot.scatter(int(plot.random.integers(3, 14)), sail)


def _apron(plot: Plot) -> None:
    """Draw concrete slabs, a taxi line, aircraft parked at any angle, and service vehicles."""
    plot.pad(drawing.CONCRETE * plot.random.uniform(0.6, 1.0))
    half = plot.half_m
    for position in np.arange(-half, half, 7.5):
        plot.line((position, -half), (position, half), drawing.CONCRETE * 0.65, 0.25)
        plot.line((-half, position), (half, position), drawing.CONCRETE * 0.65, 0.25)
    bend = plot.random.uniform(-0.5, 0.5) * half
    plot.line((-half, bend), (half, bend), drawing.WHITE * 0.8, 0.3)
    _scatter(plot, AIRCRAFT, aircraft, (1, 7), 2.5)
    _scatter(plot, VEHICLE, vehicle, (0, 5), 0.8)


def _tank_farm(plot: Plot) -> None:
    """Draw gravel, bunds around each tank, and tanks of one or two sizes."""
    plot.pad(drawing.SOIL * plot.random.uniform(0.8, 1.3))
    radius = plot.random.uniform(5, 15)
    step = 2.9 * radius + 3
    count = int(2 * plot.half_m / step)
    start = -step * (count - 1) / 2
    for row in range(count):
        for column in range(count):
            x = start + step * column
            y = start + step * row
            for side in (-0.48 * step, 0.48 * step):
                plot.line(
                    (x + side, y - 0.48 * step), (x + side, y + 0.48 * step), drawing.CONCRETE, 0.8
                )
                plot.line(
                    (x - 0.48 * step, y + side), (x + 0.48 * step, y + side), drawing.CONCRETE, 0.8
                )
            if plot.random.random() < 0.75:
                own = radius * plot.random.choice([1.0, 1.0, 0.6])
                plot.put(TANK, tank(own, plot.random), x, y, 0.0, 0.35 * own)
    _scatter(plot, VEHICLE, vehicle, (0, 3), 0.8)


def _car_park(plot: Plot) -> None:
    """Draw rows of stalls between lanes, partly occupied, with a few trees in between."""
    plot.pad(drawing.ASPHALT * plot.random.uniform(0.9, 1.6))
    half = plot.half_m
    occupancy = plot.random.uniform(0.2, 0.9)
    for y in np.arange(6.0 - half, half - 4, 13.0):
        for x in np.arange(3.0 - half, half - 3, 2.9):
            plot.line((x - 1.45, y - 2.6), (x - 1.45, y + 2.6), drawing.WHITE * 0.6, 0.25)
            if plot.random.random() < occupancy:
                turned = math.pi / 2 * plot.random.choice([-1, 1]) + plot.random.normal(0, 0.03)
                plot.put(VEHICLE, vehicle(plot.random), x, y, turned, 0.8)
        if plot.random.random() < 0.5:
            plot.tree(plot.random.uniform(-half, half), y + 6)


def _houses(plot: Plot) -> None:
    """Draw gable roofs and flat halls in gardens, trees, and cars between the rows of houses."""
    half = plot.half_m
    for y in np.arange(14.0 - half, half - 8, 24.0):
        for x in np.arange(12.0 - half, half - 8, 20.0):
            long = plot.random.uniform(9, 16)
            wide = plot.random.uniform(7, 11)
            _house(plot, x - long / 2, y - wide / 2, long, wide)
            plot.tree(x + plot.random.uniform(-9, 9), y + 11)
    for y in np.arange(26.0 - half, half - 4, 24.0):
        for x in plot.random.uniform(-half, half, 3):
            plot.rectangle(x - 3.5, y - 1.6, 7.0, 3.2, drawing.CONCRETE * 0.7)
            plot.put(VEHICLE, vehicle(plot.random), x, y, 0.0, 0.8)


def _house(plot: Plot, x: float, y: float, long: float, wide: float) -> None:
    bright = plot.random.uniform(60, 200)
    plot.rectangle(x, y, long, wide, drawing.SHADOW, 2.2 / SCENE_GSD_M)
    plot.rectangle(x, y, long, wide / 2, bright)
    plot.rectangle(x, y + wide / 2, long, wide / 2, bright * plot.random.choice([0.55, 1.0]))


def _scatter(
    plot: Plot,
    kind: int,
    make: Callable[[np.random.Generator], list[Part]],
    counts: tuple[int, int],
    height_m: float,
) -> None:
    """Put objects of one kind at random places and angles on a plot. `counts` are the minimum and
    maximum number.
    """
    plot.scatter(
        int(plot.random.integers(*counts, endpoint=True)),
        lambda x, y: plot.put(
            kind, make(plot.random), x, y, plot.random.uniform(0, math.tau), height_m
        ),
    )


def _field(plot: Plot) -> None:
    base = plot.random.choice([38, 55, 70, 88])
    half = plot.half_m
    plot.pad(base)
    for x in np.arange(-half, half, plot.random.uniform(0.8, 2.5)):
        plot.line((x, -half), (x, half), base * 0.85, 0.4)
    for y in plot.random.uniform(-half, half, 12):
        plot.tree(half - 4, y)


def _forest(plot: Plot) -> None:
    for x, y in plot.random.uniform(-plot.half_m, plot.half_m, (260, 2)):
        plot.tree(x, y)


_KINDS = (_harbour, _harbour, _apron, _apron, _tank_farm, _car_park, _houses, _field, _forest)
