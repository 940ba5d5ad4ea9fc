"""Which patches calibration looks at: light, blur and noise, each spread evenly over what may come.

Drawn one by one, a few dozen patches leave gaps, and INT8 fails where calibration never looked: at the brightest
ground, the strongest blur, the least noise. So many more candidates are drawn than wanted, put in order of one
property and cut into as many groups as there are patches; each group gives one. Light, blur and noise are matched at
random: a Latin hypercube, with the profile's own distribution along each of its sides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from torch import Tensor

from model.simulator.acquire import MARGIN_PX
from model.simulator.scene import Scene
from model.training.patches import PatchRecipe
from profiles.errors import ImageError
from profiles.sensor import Sensor

CANDIDATES = 8
"""Drawn for each that is wanted."""

T = TypeVar("T")


@dataclass(frozen=True)
class Ground:
    """A square of a scene, margin included, seen at one scale and in one light.

    Attributes:
        scene: it lies in.
        top: its first row in scene pixels.
        left: its first column.
        side_px: its rows and columns, in target pixels.
        oversampling: scene pixels per target pixel.
        exposure: factor on the scene's radiance.
    """

    scene: Scene
    top: int
    left: int
    side_px: int
    oversampling: int
    exposure: float

    @property
    def radiance(self) -> Tensor:
        """In W/m2/sr/um, on the scene's grid: a square of side_px * oversampling."""
        return self.exposure * self._part(1)

    @cached_property
    def brightness(self) -> float:
        """Its mean radiance, to within what one scene pixel in each target pixel tells."""
        return self.exposure * float(self._part(self.oversampling).mean())

    def _part(self, step: int) -> Tensor:
        side = self.side_px * self.oversampling
        return self.scene.radiance[self.top : self.top + side : step, self.left : self.left + side : step]


@dataclass(frozen=True)
class View:
    """One patch: the ground, and the two sensors that see it."""

    ground: Ground
    degraded: Sensor
    reference: Sensor


def draw_views(
    scenes: Sequence[Scene], recipe: PatchRecipe, count: int, generator: np.random.Generator
) -> list[View]:
    """So many views, spread over brightness, MTF and noise.

    A scene at a scale is drawn as often as it holds patches, as training sees it.

    Raises:
        ImageError: no scene holds a patch with its margin.
    """
    places = _places(scenes, recipe)
    room = np.array([_room_px(*place) for place in places])
    drawn = generator.choice(len(places), CANDIDATES * count, p=room / room.sum())
    grounds = [_ground(places[k], recipe, generator) for k in drawn]
    sensors = [recipe.degraded.draw(generator) for _ in range(CANDIDATES * count)]
    dark = recipe.degraded.radiance_0.low
    spread = zip(
        stratified(grounds, lambda ground: ground.brightness, count, generator),
        stratified(sensors, lambda sensor: sensor.mtf_nyquist, count, generator),
        stratified(sensors, lambda sensor: sensor.noise_sigma(dark), count, generator),
        strict=True,
    )
    return [
        View(ground, _blurred_as(noisy, blurred), recipe.reference.draw(generator))
        for ground, blurred, noisy in spread
    ]


def _blurred_as(sensor: Sensor, other: Sensor) -> Sensor:
    return replace(sensor, mtf_nyquist=other.mtf_nyquist, mtf_nyquist_along=other.mtf_nyquist_along)


def stratified(
    candidates: Sequence[T], key: Callable[[T], float], count: int, generator: np.random.Generator
) -> list[T]:
    """One of each of `count` equal groups of the candidates ordered by `key`, in random order."""
    ranked, size = sorted(candidates, key=key), len(candidates) // count
    chosen = [ranked[group * size + int(generator.integers(size))] for group in range(count)]
    return [chosen[k] for k in generator.permutation(count)]


def _places(scenes: Sequence[Scene], recipe: PatchRecipe) -> list[tuple[Scene, int]]:
    """Scenes, each with every oversampling at which it holds a patch."""
    side_px = recipe.patch_px + 2 * MARGIN_PX
    fitting = [
        (s, ratio) for s in scenes for ratio in recipe.oversamplings if min(s.radiance.shape) >= side_px * ratio
    ]
    if not fitting:
        expected = f"scenes that hold a patch of {recipe.patch_px} target pixels and {MARGIN_PX} around it"
        remedy = "give larger images or a smaller patch"
        raise ImageError("calibration images", expected=expected, got="none large enough", remedy=remedy)
    return fitting


def _room_px(scene: Scene, oversampling: int) -> int:
    """Target pixels of a scene within the margin."""
    height, width = (size // oversampling - 2 * MARGIN_PX for size in scene.radiance.shape)
    return height * width


def _ground(place: tuple[Scene, int], recipe: PatchRecipe, generator: np.random.Generator) -> Ground:
    scene, oversampling = place
    side_px = recipe.patch_px + 2 * MARGIN_PX
    top, left = (int(generator.integers(size - side_px * oversampling + 1)) for size in scene.radiance.shape)
    return Ground(scene, top, left, side_px, oversampling, float(generator.uniform(*recipe.exposures)))
