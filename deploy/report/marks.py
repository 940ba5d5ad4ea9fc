"""Marks of a plot: a shape with a colour for each method, a filling for each precision.

The colours are Okabe and Ito's, darkened where white would swallow them; the shape says the same without colour.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Filling = Literal["solid", "half", "cored", "hollow"]
Polygon = tuple[tuple[float, float], ...]

LIGHT = ("#0072b2", "#d55e00", "#008a64", "#b4558d", "#a87000", "#1b1f24")
DARK = ("#56b4e9", "#e8711a", "#1fb88a", "#cc79a7", "#e69f00", "#e7eaee")
FILLINGS: dict[str, Filling] = {"INT8 legal": "solid", "INT8 free": "half", "bf16": "cored", "float32": "hollow"}
CORE = 0.45


def regular(corners: int, turn: float = 0.0) -> Polygon:
    """A regular polygon in the unit circle, one corner up; `turn` in parts of a full turn, clockwise."""
    angles = [2 * math.pi * (k / corners + turn) for k in range(corners)]
    return tuple((math.sin(a), -math.cos(a)) for a in angles)


def star(rays: int, inner: float) -> Polygon:
    """A star in the unit circle, one ray up."""
    return tuple((x, y) if k % 2 == 0 else (inner * x, inner * y) for k, (x, y) in enumerate(regular(2 * rays)))


def turned(polygon: Polygon, turn: float) -> Polygon:
    """Turned clockwise by a part of a full turn."""
    c, s = math.cos(2 * math.pi * turn), math.sin(2 * math.pi * turn)
    return tuple((c * x - s * y, s * x + c * y) for x, y in polygon)


def scaled(polygon: Polygon, factor: float) -> Polygon:
    """Larger or smaller about its middle."""
    return tuple((factor * x, factor * y) for x, y in polygon)


_W = 0.36
PLUS: Polygon = (
    (-_W, -1), (_W, -1), (_W, -_W), (1, -_W), (1, _W), (_W, _W), (_W, 1), (-_W, 1), (-_W, _W), (-1, _W), (-1, -_W),
    (-_W, -_W),
)  # fmt: skip
HOURGLASS: Polygon = ((-0.85, -0.95), (0.85, -0.95), (0.2, 0), (0.85, 0.95), (-0.85, 0.95), (-0.2, 0))
CHEVRON: Polygon = ((0, -1), (1, 0.1), (1, 0.95), (0, -0.05), (-1, 0.95), (-1, 0.1))
DOME: Polygon = tuple((math.cos(a), 0.5 - 1.1 * math.sin(a)) for a in (math.pi * k / 12 for k in range(13)))

SHAPES: tuple[Polygon, ...] = (
    regular(36),
    scaled(regular(4, 0.125), 1.15),
    scaled(regular(3), 1.2),
    scaled(regular(4), 1.15),
    scaled(star(5, 0.45), 1.25),
    PLUS,
    scaled(regular(3, 0.5), 1.2),
    scaled(regular(5), 1.05),
    turned(PLUS, 0.125),
    HOURGLASS,
    scaled(regular(3, 0.25), 1.2),
    DOME,
    scaled(star(4, 0.4), 1.3),
    CHEVRON,
    turned(HOURGLASS, 0.25),
    scaled(regular(3, 0.75), 1.2),
    turned(DOME, 0.5),
    turned(CHEVRON, 0.5),
)


@dataclass(frozen=True)
class Mark:
    """How a point looks: numbers of a shape and a colour, and a filling."""

    shape: int
    colour: int
    filling: Filling

    @property
    def outer(self) -> Polygon:
        """The outline, within about the unit circle."""
        return SHAPES[self.shape]

    @property
    def inner(self) -> Polygon:
        """What is painted inside the outline; nothing of a hollow mark, all of a solid one."""
        if self.filling == "half":
            return left_half(self.outer)
        return {"solid": self.outer, "cored": scaled(self.outer, CORE), "hollow": ()}[self.filling]


def marks_of(methods: Iterable[str]) -> dict[str, Mark]:
    """A solid mark for each method, no shape twice before all are used, no pair with a colour twice long after."""
    count, colours = len(SHAPES), len(LIGHT)
    names = dict.fromkeys(methods)
    return {name: Mark(k % count, (k + k // count) % colours, "solid") for k, name in enumerate(names)}


def filling_of(precision: str) -> Filling:
    """How a precision is filled; an unknown one is left hollow."""
    return FILLINGS.get(precision, "hollow")


def left_half(polygon: Polygon) -> Polygon:
    """What of a polygon lies left of its middle."""
    kept: list[tuple[float, float]] = []
    for (x0, y0), (x1, y1) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if x0 <= 0:
            kept.append((x0, y0))
        if (x0 <= 0) != (x1 <= 0):
            kept.append((0.0, y0 + (y1 - y0) * x0 / (x0 - x1)))
    return tuple(kept)
