"""A canvas in metres that knows which object each of its pixels shows, and square plots of ground on it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from model.detection.objects import Part
from model.simulator.drawing import GRASS, SHADOW, Point, shift, texture, tree, turn

SCENE_GSD_M = 0.25
"""Ground that a scene pixel covers."""
GAP_PX = 3
"""Scene pixels that stay free around an object and its shadow."""
TRIES = 4
"""Times that a place is looked for before an object is left out."""

Place = Callable[[float, float], Point]


class Canvas:
    """A scene being drawn, in metres around its centre: the radiance, and the objects on it."""

    def __init__(self, height_px: int, width_px: int, generator: np.random.Generator) -> None:
        self.generator = generator
        self.corners: list[tuple[int, int, int, int]] = []
        self.classes: list[int] = []
        self._size = width_px, height_px
        self._image, self._shown = Image.new("F", self._size, GRASS), Image.new("I", self._size, 0)
        self._draw, self._draw_shown = ImageDraw.Draw(self._image), ImageDraw.Draw(self._shown)

    @property
    def reach_m(self) -> float:
        """Half the diagonal: how far from the centre there is something to draw."""
        return math.hypot(*self._size) * SCENE_GSD_M / 2

    def textured(self) -> np.ndarray:
        """The radiance (H, W) float32 with the ground's texture."""
        width, height = self._size
        return np.asarray(np.asarray(self._image) * texture(height, width, self.generator), np.float32)

    def area(self, points: Sequence[Point], radiance: float) -> None:
        """Fill a polygon of the ground."""
        self._draw.polygon([self._pixel(point) for point in points], fill=radiance)

    def line(self, points: Sequence[Point], radiance: float, width_m: float) -> None:
        """Draw a line on the ground."""
        width_px = max(round(width_m / SCENE_GSD_M), 1)
        self._draw.line([self._pixel(point) for point in points], fill=radiance, width=width_px)

    def tree(self, point: Point, radius_m: float) -> None:
        """Draw a tree, unless an object stands there."""
        x, y = self._pixel(point)
        radius = radius_m / SCENE_GSD_M
        if self._is_free((x - 2 * radius, y - 2 * radius, x + 2 * radius, y + 2 * radius)):
            tree(self._draw, x, y, radius, self.generator)

    def put(self, kind: int, parts: list[Part], place: Place, height_m: float) -> bool:
        """Put an object where it lies whole within the scene and clear of others; says whether it found room.

        Args:
            kind: its class.
            parts: polygons around (0, 0), the lowest first.
            place: from there to metres on the canvas.
            height_m: of the object, as far as its shadow is shifted right and down.
        """
        polygons = [([self._pixel(place(*point)) for point in polygon], paint) for polygon, paint in parts]
        points, shadow_px = np.array([point for polygon, _ in polygons for point in polygon]), height_m / SCENE_GSD_M
        area = (*(points.min(0) - GAP_PX), *(points.max(0) + GAP_PX + shadow_px))
        inside = min(area[:2]) >= 0 and area[2] < self._size[0] and area[3] < self._size[1]
        if not inside or not self._is_free(area):
            return False
        for polygon, _ in polygons:
            self._draw.polygon([shift(point, shadow_px) for point in polygon], fill=SHADOW)
        self.classes.append(kind)
        for polygon, paint in polygons:
            self._draw.polygon(polygon, fill=paint)
            self._draw_shown.polygon(polygon, fill=len(self.classes))
        self.corners.append(self._corners_within(area))
        return True

    def _pixel(self, point: Point) -> Point:
        return point[0] / SCENE_GSD_M + self._size[0] / 2, point[1] / SCENE_GSD_M + self._size[1] / 2

    def _is_free(self, area: tuple[float, ...]) -> bool:
        return int(self._shown.crop(_whole(area)).getextrema()[1]) == 0  # type: ignore[arg-type]

    def _corners_within(self, area: tuple[float, ...]) -> tuple[int, int, int, int]:
        """Of the pixels that the last object has coloured: Pillow's polygons, not their corners, are the truth."""
        left, top, *_ = whole = _whole(area)
        shown = np.asarray(self._shown.crop(whole)) == len(self.classes)
        rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
        return left + int(columns[0]), top + int(rows[0]), left + int(columns[-1]) + 1, top + int(rows[-1]) + 1


def _whole(area: tuple[float, ...]) -> tuple[int, int, int, int]:
    left, top, right, bottom = map(math.floor, area)
    return left, top, right, bottom


@dataclass(frozen=True)
class Plot:
    """A square of ground, in metres around its centre, turned by `angle` against the canvas."""

    canvas: Canvas
    x: float
    y: float
    angle: float
    half_m: float

    @property
    def random(self) -> np.random.Generator:
        """The canvas's own generator."""
        return self.canvas.generator

    def rectangle(self, x: float, y: float, width: float, height: float, radiance: float) -> None:
        """Fill a rectangle of the plot from its corner (x, y)."""
        corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
        self.canvas.area([self.place(*corner) for corner in corners], radiance)

    def pad(self, radiance: float) -> None:
        """Fill the whole plot."""
        self.rectangle(-self.half_m, -self.half_m, 2 * self.half_m, 2 * self.half_m, radiance)

    def line(self, start: Point, end: Point, radiance: float, width_m: float) -> None:
        """Draw a line on the plot."""
        self.canvas.line([self.place(*start), self.place(*end)], radiance, width_m)

    def tree(self, x: float, y: float) -> None:
        """Draw a tree of 1.5 to 3.5 m radius."""
        self.canvas.tree(self.place(x, y), float(self.random.uniform(1.5, 3.5)))

    def put(self, kind: int, parts: list[Part], x: float, y: float, turned: float, height_m: float) -> bool:
        """Put an object at (x, y), turned against the plot; one that does not fit into the plot is left out."""
        own = turn(x, y, turned)
        points = np.array([own(*point) for polygon, _ in parts for point in polygon])
        if np.abs(points).max() > self.half_m:
            return False
        return self.canvas.put(kind, parts, lambda u, v: self.place(*own(u, v)), height_m)

    def scatter(self, count: int, put: Callable[[float, float], bool]) -> None:
        """Put several objects somewhere on the plot, each where it finds room."""
        for _ in range(count):
            any(put(*self.random.uniform(-self.half_m, self.half_m, 2)) for _ in range(TRIES))

    def place(self, x: float, y: float) -> Point:
        """Metres of the plot to metres of the canvas."""
        return turn(self.x, self.y, self.angle)(x, y)
