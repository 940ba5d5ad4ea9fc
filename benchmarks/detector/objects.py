"""Objects of synthetic scenes: polygons in metres around (0, 0), with the nose along x.

They have the sizes of common types: cars of 3.8 to 5.2 m, lorries and buses to 14 m, ships of 9 to
70 m, aircraft of 12 to 38 m span, tanks of 5 to 15 m radius.
"""

import math
from itertools import pairwise

import numpy as np

from beers_deploy.model.simulator import procedural as drawing
from beers_deploy.model.simulator.procedural import Point

PAINTS = [18.0, 60.0, 110.0, 190.0, 280.0]
"""Radiances of vehicles from black to white, the same as in the procedural scene."""


Part = tuple[list[Point], float]
"""A polygon in metres and its radiance. In a list of several, the first is the lowest."""


def vehicle(generator: np.random.Generator) -> list[Part]:
    """Draw a car, or with probability 1/5 a lorry or bus: the body, and for a car the
    windscreen.
    """
    paint = generator.choice(PAINTS)
    if generator.random() < 0.2:
        return [
            (drawing.rectangle(generator.uniform(4, 7), 1.25), paint),
            (_band(3.0, 3.5, 1.2), 0.5 * paint),
        ]
    body = drawing.rectangle(generator.uniform(1.9, 2.6), generator.uniform(0.85, 1.0))
    return [(body, paint), (_band(0.4, 1.1, 0.8), 20.0)]


def ship(generator: np.random.Generator) -> list[Part]:
    """Draw a ship: a hull with a bow, its hatches or a long deck, and the bridge astern."""
    half = 0.5 * math.exp(generator.uniform(math.log(9), math.log(70)))
    wide = half / generator.uniform(3, 5)
    hull = generator.uniform(50, 160)
    outline = [
        (x * half, y * wide) for x, y in ((-1, -0.8), (-0.9, -1), (0.5, -1), (0.8, -0.6), (1, 0))
    ]
    parts = [(outline + [(x, -y) for x, y in reversed(outline[:-1])], hull)]
    for start, end in pairwise(np.linspace(-0.45, 0.55, int(generator.integers(2, 6))) * half):
        parts.append(
            (_band(start + 0.04 * half, end, 0.7 * wide), hull * generator.uniform(0.4, 1.6))
        )
    return [*parts, (_band(-0.85 * half, -0.55 * half, 0.75 * wide), generator.uniform(170, 260))]


def aircraft(generator: np.random.Generator) -> list[Part]:
    """Draw an aircraft: swept wings, tailplane, engines and, on top, the fuselage."""
    half = 0.5 * math.exp(generator.uniform(math.log(12), math.log(38)))
    paint = generator.uniform(170, 270)
    long = half * generator.uniform(0.9, 1.15)
    sweep = half * generator.uniform(0.15, 0.6)
    thick = 0.11 * half
    chord = 0.32 * half
    fuselage = [(-long, 0.0), (-0.7 * long, thick), (0.8 * long, thick), (long, 0.0)]
    parts = [
        (_swept(0.25 * long, half, chord, sweep), 0.9 * paint),
        (_swept(-0.75 * long, 0.38 * half, 0.5 * chord, 0.4 * sweep), 0.9 * paint),
    ]
    for side in (-0.35 * half, 0.35 * half):
        engine = _band(0.1 * long, 0.1 * long + 0.8 * chord, 0.06 * half)
        parts.append(([(x, y + side) for x, y in engine], 0.6 * paint))
    return [*parts, (fuselage + [(x, -y) for x, y in reversed(fuselage[1:-1])], paint)]


def tank(radius_m: float, generator: np.random.Generator) -> list[Part]:
    """Draw a round tank with a rim, a slightly darker or brighter roof, and the hatch of the
    stair.
    """
    paint = generator.uniform(110, 250)
    angle = generator.uniform(0, math.tau)
    hatch = 0.6 * radius_m * math.cos(angle), 0.6 * radius_m * math.sin(angle)
    return [
        (_disc(0.0, 0.0, radius_m), paint),
        (_disc(0.0, 0.0, 0.88 * radius_m), paint * generator.uniform(0.75, 1.1)),
        (_disc(*hatch, 0.12 * radius_m), 0.6 * paint),
    ]


def _swept(front: float, half_span: float, chord: float, sweep: float) -> list[Point]:
    """Return the polygon of a wing from tip to tip. Its leading edge lies at x = front in the
    middle, and `sweep` further back at the tips.
    """
    tip = front - sweep
    return [
        (front, 0.0),
        (tip, half_span),
        (tip - 0.35 * chord, half_span),
        (front - chord, 0.0),
        (tip - 0.35 * chord, -half_span),
        (tip, -half_span),
    ]


def _band(start: float, end: float, half_wide: float) -> list[Point]:
    return [(start, -half_wide), (end, -half_wide), (end, half_wide), (start, half_wide)]


def _disc(x: float, y: float, radius: float, corners: int = 32) -> list[Point]:
    angles = np.arange(corners) * math.tau / corners
    return [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]
