"""Draw a scene: fields, forest, streets, houses, cars and a resolution pattern, as radiance in
W/m2/sr/um.

It is the built-in input, so that everything runs without a single image file. Radiances are those
of a clear day: asphalt 30, grass 45, roofs 60 to 160, concrete 120, white paint 260.

Pillow draws it. scikit-image has no lines with a width and fills other pixels at the borders of
shapes (701 of the 118 000 of a parcel, measured), so every simulated pair would have other bytes.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy import fft

from beers_deploy.model.raster.images import list_images
from beers_deploy.model.simulator.sampling import Scene, read_scene
from beers_deploy.profiles.instrument import Instrument

SCENES = 3
SCENE_SIDE_PX = 2400
"""Side of the scenes that are drawn if no folder of images is given."""

Point = tuple[float, float]
"""(x, y) in pixels of the canvas."""

SHADOW = 12.0
ASPHALT = 30.0
GRASS = 45.0
SOIL = 75.0
CONCRETE = 120.0
WHITE = 260.0
WATER = 16.0


def procedural_scene(height_px: int, width_px: int, generator: np.random.Generator) -> Scene:
    """Draw a scene of this size, with pixels of 10 cm: a car is some 40 pixels long."""
    canvas = Image.new("F", (width_px, height_px), GRASS)
    draw = ImageDraw.Draw(canvas)
    _fields(draw, canvas.size, generator)
    _forest(draw, canvas.size, generator)
    _river(draw, canvas.size, generator)
    _town(draw, canvas.size, generator)
    radiance = np.asarray(canvas) * texture(height_px, width_px, generator)
    canvas = Image.fromarray(radiance.astype(np.float32))
    # The calibration site is drawn after the texture and has none.
    _pattern(ImageDraw.Draw(canvas), canvas.size)
    return Scene("procedural", np.array(canvas, dtype=np.float32))


def _fields(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], generator: np.random.Generator
) -> None:
    """Draw a patchwork of parcels, each with crop rows of its own direction."""
    width, height = size
    step = 700
    for top in range(-step, height + step, step):
        for left in range(-step, width + step, step):
            corner = (left + generator.uniform(-90, 90), top + generator.uniform(-90, 90))
            parcel = box(corner, step - 12, step - 12, generator.uniform(-0.06, 0.06))
            base = float(generator.choice([38, 55, 70, 88]))
            draw.polygon(parcel, fill=base)
            # Crop rows 6 to 14 pixels apart, between two opposite sides of the parcel.
            (ax, ay), (bx, by), (cx, cy), (dx, dy) = parcel
            count = int(step / generator.uniform(6, 14))
            contrast = generator.uniform(0.85, 1.2)
            for k in range(count):
                t = (k + 0.5) / count
                start = (ax + t * (bx - ax), ay + t * (by - ay))
                end = (dx + t * (cx - dx), dy + t * (cy - dy))
                draw.line([start, end], fill=base * contrast, width=3)


def _forest(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], generator: np.random.Generator
) -> None:
    """Draw tree crowns, each a shadow, a dark disc and a sunlit side, over the lower left."""
    width, height = size
    for _ in range(int(width * height / 2600)):
        x = generator.uniform(0, width * 0.42)
        y = generator.uniform(height * 0.55, height)
        if x > width * 0.36 and generator.random() < 0.6:
            continue
        tree(draw, x, y, generator.uniform(14, 34), generator)


def _river(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], generator: np.random.Generator
) -> None:
    """Draw a winding river along the left edge, with pale banks."""
    width, height = size
    phase = generator.uniform(0, math.tau)
    middle = [
        (width * (0.1 + 0.04 * math.sin(phase + 5 * y / height)), y)
        for y in range(-50, height + 51, 5)
    ]
    for half_width, value in ((width / 36, SOIL * 1.3), (width / 48, WATER)):
        for x, y in middle:
            draw.ellipse(around(x, y, half_width), fill=value)


def _town(draw: ImageDraw.ImageDraw, size: tuple[int, int], generator: np.random.Generator) -> None:
    """Draw blocks of houses along rotated streets, over the right part."""
    width, height = size
    angle = float(generator.uniform(-0.25, 0.25))
    place = turn(width * 0.72, height * 0.55, angle)
    reach_x = width * 0.3
    reach_y = height * 0.62
    for v in np.arange(-reach_y, reach_y, 420):
        _street(draw, place, [(-reach_x, v), (reach_x, v)], generator)
    for u in np.arange(-reach_x, reach_x + 1, 560):
        _street(draw, place, [(u, -reach_y), (u, reach_y)], generator)
    for v in np.arange(-reach_y, reach_y - 420, 420):
        for u in np.arange(-reach_x, reach_x - 180, 187):
            if (u + reach_x) % 560 < 400:
                _house(draw, place, u + 70, v + 70, generator)
                _house(draw, place, u + 70, v + 240, generator)


def _street(
    draw: ImageDraw.ImageDraw,
    place: Callable[[float, float], Point],
    ends: list[Point],
    generator: np.random.Generator,
) -> None:
    (u0, v0), (u1, v1) = ends
    draw.line([place(u0, v0), place(u1, v1)], fill=CONCRETE * 0.8, width=92)
    draw.line([place(u0, v0), place(u1, v1)], fill=ASPHALT, width=68)
    length = math.hypot(u1 - u0, v1 - v0)
    du = (u1 - u0) / length
    dv = (v1 - v0) / length
    for s in np.arange(20, length - 40, 80):
        dash = [place(u0 + du * t, v0 + dv * t) for t in (s, s + 34)]
        draw.line(dash, fill=WHITE * 0.7, width=4)
    for s in generator.uniform(40, max(length - 60, 41), int(length / 240)):
        side = 22 * float(generator.choice([-1, 1]))
        u = u0 + du * s - dv * side
        v = v0 + dv * s + du * side
        car = [place(u - du * a - dv * b, v - dv * a + du * b) for a, b in rectangle(20, 9)]
        draw.polygon([shift(point, 5) for point in car], fill=SHADOW)
        draw.polygon(car, fill=float(generator.choice([18, 60, 110, 190, 280])))


def _house(
    draw: ImageDraw.ImageDraw,
    place: Callable[[float, float], Point],
    u: float,
    v: float,
    generator: np.random.Generator,
) -> None:
    """Draw a gable roof with one slope in the sun, its shadow, a chimney and sometimes a tree."""
    length = generator.uniform(90, 130)
    width = generator.uniform(64, 92)
    sunlit = float(generator.uniform(60, 160))

    def across(top: float, bottom: float) -> list[Point]:
        corners = (u, top), (u + length, top), (u + length, bottom), (u, bottom)
        return [place(*corner) for corner in corners]

    # The shadow is drawn first, so that the house covers its beginning.
    draw.polygon([shift(point, 22) for point in across(v, v + width)], fill=SHADOW)
    ridge = v + width / 2
    draw.polygon(across(v, ridge), fill=sunlit)
    draw.polygon(across(ridge, v + width), fill=sunlit * 0.55)
    for k in np.arange(8, length, 11):
        draw.line([place(u + k, v), place(u + k, v + width)], fill=sunlit * 0.8, width=2)
    x, y = place(u + 0.3 * length, v + 0.3 * width)
    draw.rectangle((x, y, x + 9, y + 9), fill=CONCRETE)
    if generator.random() < 0.6:
        tree(draw, *place(u + length + 24, v + width), generator.uniform(12, 22), generator)


def _pattern(draw: ImageDraw.ImageDraw, size: tuple[int, int]) -> None:
    """Draw a calibration site at the top: a slanted edge, a Siemens star and bar groups on
    concrete.
    """
    side = min(size) * 0.22
    left = size[0] * 0.36
    top = size[1] * 0.08
    draw.rectangle((left, top, left + 2.6 * side, top + side), fill=CONCRETE)
    near = left + 0.1 * side
    far = left + 0.45 * side
    slant = 0.8 * side * math.tan(math.radians(5))
    upper = top + 0.1 * side
    lower = top + 0.9 * side
    edge = [(near, upper), (far, upper), (far + slant, lower), (near, lower)]
    draw.polygon(edge, fill=ASPHALT)
    star = around(left + 1.3 * side, top + 0.5 * side, 0.42 * side)
    draw.ellipse(star, fill=WHITE)
    for start in range(0, 360, 10):
        draw.pieslice(star, start, start + 5, fill=ASPHALT)
    x = left + 1.85 * side
    for bar in (16.0, 12.0, 8.0, 6.0, 4.0, 3.0):
        for k in range(3):
            draw.rectangle(
                (x + 2 * k * bar, top + 0.15 * side, x + (2 * k + 1) * bar, top + 0.85 * side),
                fill=ASPHALT,
            )
        x += 7 * bar


def texture(height_px: int, width_px: int, generator: np.random.Generator) -> np.ndarray:
    """Draw multiplicative 1/f texture around 1, some 12 % rms, because nothing on the ground is
    flat.
    """
    white = generator.standard_normal((height_px, width_px), dtype=np.float32)
    fy = np.fft.fftfreq(height_px)[:, None]
    fx = np.fft.rfftfreq(width_px)[None, :]
    radius = np.hypot(fx, fy)
    # 1 / f has no value at frequency 0: below 1 / 400 the spectrum stays as it is there.
    spectrum = fft.rfft2(white) / np.maximum(radius, 1 / 400).astype(np.float32)
    pattern = fft.irfft2(spectrum, s=(height_px, width_px))
    return np.asarray(np.exp(0.12 * pattern / pattern.std()))


def tree(
    draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, generator: np.random.Generator
) -> None:
    """Draw a shadow and a dark crown around (x, y) with sunlit and darker leaves."""
    draw.ellipse(around(x + 0.6 * radius, y + 0.6 * radius, radius), fill=SHADOW)
    draw.ellipse(around(x, y, radius), fill=float(generator.uniform(24, 34)))
    draw.ellipse(
        around(x - 0.25 * radius, y - 0.25 * radius, 0.65 * radius),
        fill=float(generator.uniform(36, 60)),
    )
    for _ in range(6):
        dx, dy = generator.uniform(-0.6, 0.4, 2) * radius
        draw.ellipse(around(x + dx, y + dy, 0.14 * radius), fill=float(generator.uniform(20, 80)))


def box(corner: Point, width: float, height: float, angle: float) -> list[Point]:
    """Return the corners of a rectangle, rotated about its first corner by `angle` radians."""
    place = turn(*corner, angle)
    return [place(0, 0), place(width, 0), place(width, height), place(0, height)]


def rectangle(half_long: float, half_wide: float) -> list[Point]:
    """Return the corners of a rectangle around (0, 0)."""
    return [
        (-half_long, -half_wide),
        (half_long, -half_wide),
        (half_long, half_wide),
        (-half_long, half_wide),
    ]


def turn(x: float, y: float, angle: float) -> Callable[[float, float], Point]:
    """Return a function that maps a rotated frame centred at (x, y) to the canvas."""
    cosine = math.cos(angle)
    sine = math.sin(angle)
    return lambda u, v: (x + cosine * u - sine * v, y + sine * u + cosine * v)


def shift(point: Point, by: float) -> Point:
    """Move a point right and down, to where the shadow of an object of that height falls."""
    return (point[0] + by, point[1] + by)


def around(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    """Return the square (left, top, right, bottom) around a circle."""
    return (x - radius, y - radius, x + radius, y + radius)


def load_scenes(
    folder: Path | None, sensor: Instrument, seed: int, most: int = SCENES
) -> list[Scene]:
    """Load the scenes of a folder of images, or draw scenes if there is no folder.

    Args:
        folder: the folder of images; None draws scenes, different ones for every seed.
        sensor: the sensor whose full scale is white in a photograph.
        seed: the seed of drawn scenes.
        most: the maximum number of drawn scenes.
    """
    if folder is not None:
        return [read_scene(path, sensor) for path in list_images(folder)]
    return draw_scenes(min(SCENES, most), seed)


def draw_scenes(count: int, seed: int) -> list[Scene]:
    """Draw `count` scenes, each with its own generator."""
    generators = np.random.default_rng(seed).spawn(count)
    return [procedural_scene(SCENE_SIDE_PX, SCENE_SIDE_PX, g) for g in generators]
