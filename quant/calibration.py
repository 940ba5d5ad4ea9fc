"""Simulated patches for calibration, and for looking at what INT8 changes.

Patches are simulated anew for each pass over them, which costs a tenth of what the network does
with them. So memory grows neither with their number nor with their size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TypeVar

import numpy as np

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.simulator.acquire import MARGIN_PX, acquire
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.mtf import transfer_function
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.model.simulator.sampling import Scene, scene_spectrum
from beers_deploy.model.training.patches import PatchRecipe, turn
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.lighting import (
    CALIBRATION,
    JUDGING,
    Lighting,
    assign_lightings,
    full_scale_radiance,
)
from beers_deploy.quant.samples import PATCH_PX, Pair, Patches, Remade

VIEW_CANDIDATES = 8
"""Drawn for each that is wanted."""

Candidate = TypeVar("Candidate")

HELD_OUT_SEED = 1000
"""Added to a run's seed where patches must be others than calibration's."""
HELD_OUT_PATCHES = 32
TUNING_SEED = 2000
"""Added to a run's seed for the patches that the whole numbers are trained on."""
TUNING_PATCHES = 256


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
    def radiance(self) -> np.ndarray:
        """In W/m2/sr/um, on the scene's grid: a square of side_px * oversampling."""
        return self.exposure * self._part(1)

    @property
    def sampled_radiance(self) -> np.ndarray:
        """One scene pixel for each target pixel, in W/m2/sr/um."""
        return self.exposure * self._part(self.oversampling)

    @cached_property
    def brightness(self) -> float:
        """Its mean radiance in W/m2/sr/um, estimated from `sampled_radiance`."""
        return float(self.sampled_radiance.mean())

    def _part(self, step: int) -> np.ndarray:
        side = self.side_px * self.oversampling
        return self.scene.radiance[
            self.top : self.top + side : step, self.left : self.left + side : step
        ]


@dataclass(frozen=True)
class View:
    """One patch: the ground, and the two sensors that see it."""

    ground: Ground
    degraded: Instrument
    reference: Instrument


def draw_views(
    scenes: Sequence[Scene], recipe: PatchRecipe, count: int, generator: np.random.Generator
) -> list[View]:
    """So many views, spread over brightness, MTF and noise.

    A scene at a scale is drawn as often as it holds patches, as training sees it.
    """
    places = _places(scenes, recipe)
    sides = [
        [size // ratio - 2 * MARGIN_PX for size in scene.radiance.shape] for scene, ratio in places
    ]
    room = np.prod(sides, axis=1)  # target pixels within the margin
    # One generator draws all of this, so the order of the draws decides what a seed gives.
    indices = generator.choice(len(places), VIEW_CANDIDATES * count, p=room / room.sum())
    grounds = [_ground(places[k], recipe, generator) for k in indices]
    source = recipe.family or recipe.degraded
    sensors = [source.draw(generator) for _ in range(VIEW_CANDIDATES * count)]
    dark = recipe.degraded.radiance_0.low
    # Brightness, MTF and noise are each spread by themselves, in orders that do not depend on each
    # other.
    spread = zip(
        stratified(grounds, lambda ground: ground.brightness, count, generator),
        stratified(sensors, lambda sensor: sensor.mtf_nyquist, count, generator),
        stratified(sensors, lambda sensor: sensor.noise_sigma(dark), count, generator),
        strict=True,
    )
    views = []
    for ground, blurred, noisy in spread:
        # A view has the noise of one sensor and the blur of another, each from its own group.
        degraded = replace(
            noisy,
            mtf_nyquist=blurred.mtf_nyquist,
            mtf_nyquist_along=blurred.mtf_nyquist_along,
            response=blurred.response,
        )
        views.append(View(ground, degraded, recipe.reference.draw(generator)))
    return views


def stratified(
    candidates: Sequence[Candidate],
    key: Callable[[Candidate], float],
    count: int,
    generator: np.random.Generator,
) -> list[Candidate]:
    """One of each of `count` equal groups of the candidates ordered by `key`, in random order."""
    ranked = sorted(candidates, key=key)
    size = len(candidates) // count
    members = [ranked[group * size + int(generator.integers(size))] for group in range(count)]
    # In rank order the darkest ground would always meet the weakest MTF.
    return [members[k] for k in generator.permutation(count)]


def _places(scenes: Sequence[Scene], recipe: PatchRecipe) -> list[tuple[Scene, int]]:
    """Scenes, each with every oversampling at which it holds a patch."""
    side_px = recipe.patch_px + 2 * MARGIN_PX
    fitting = [
        (scene, ratio)
        for scene, ratio in product(scenes, recipe.oversamplings)
        if min(scene.radiance.shape) >= side_px * ratio
    ]
    if not fitting:
        raise ImageError(
            "None of the calibration images is large enough for a patch of "
            f"{recipe.patch_px} target pixels and {MARGIN_PX} around it. Give larger images or a "
            "smaller patch."
        )
    return fitting


def _ground(
    place: tuple[Scene, int], recipe: PatchRecipe, generator: np.random.Generator
) -> Ground:
    scene, oversampling = place
    # A Fourier transform wraps around; the margin keeps the far border out of the patch.
    side_px = recipe.patch_px + 2 * MARGIN_PX
    top, left = (
        int(generator.integers(size - side_px * oversampling + 1)) for size in scene.radiance.shape
    )
    exposure = float(generator.uniform(*recipe.looks.exposures))
    return Ground(scene, top, left, side_px, oversampling, exposure)


ROLES = "degraded", "reference"
"""Of the sensors of a pair, each with noise of its own: a degraded patch is the same in a pair and
alone.
"""


def draw_patches(
    scenes: list[Scene],
    degraded: Sensor,
    reference: Sensor,
    count: int,
    seed: int,
    patch_px: int = PATCH_PX,
    family: SensorFamily | None = None,
    lightings: Sequence[Lighting] = (),
) -> Patches:
    """Draw patches by sensor profile and seed, spread over the profile's ranges and over
    brightness.

    Args:
        scenes: that are seen.
        degraded: the sensors that see them, unless a family does.
        reference: the sensor of the wanted images.
        count: of patches.
        seed: of everything that is drawn.
        patch_px: side of a patch.
        family: of sensors with the gain and bits of `degraded`.
        lightings: how the ground is lit, so that the patches cover the sensor's range; without any
            it is as bright as the scenes show it.

    Raises:
        ImageError: no scene holds a patch.
        ProfileError: the two profiles differ in gain, bits or offset.
    """
    recipe = PatchRecipe(degraded, reference, patch_px=patch_px, family=family)
    # Each purpose has a generator of its own, so that lightings change no other draw.
    views = draw_views(scenes, recipe, count, Draw(seed).generator("views"))
    if lightings:
        views = relit(views, lightings, Draw(seed).generator("lighting"))

    def pair(number: int) -> Pair:
        view = views[number]
        # Keyed by the patch's number, because patches are simulated anew in any order.
        image, target = _simulate(view.ground, (view.degraded, view.reference), Draw(seed, number))
        return image, target

    def alone(number: int) -> np.ndarray:
        view = views[number]
        (image,) = _simulate(view.ground, (view.degraded,), Draw(seed, number))
        return image

    return Patches(views, Remade(pair, count), Remade(alone, count))


def relit(
    views: Sequence[View], lightings: Sequence[Lighting], generator: np.random.Generator
) -> list[View]:
    """Return the same views, their ground lit in the shares of the lightings."""
    assigned = assign_lightings(len(views), lightings, generator)
    result = []
    for view, lighting in zip(views, assigned, strict=True):
        full_scale = full_scale_radiance(view.degraded)
        factor = lighting.factor(view.ground.sampled_radiance, full_scale, generator)
        ground = replace(view.ground, exposure=factor * view.ground.exposure)
        result.append(replace(view, ground=ground))
    return result


def _simulate(ground: Ground, sensors: Sequence[Instrument], draw: Draw) -> list[np.ndarray]:
    """What the degraded sensor, and the reference if given, make of the same ground: patches (1, 1,
    P, P).
    """
    radiance = ground.radiance
    spectrum = scene_spectrum(radiance)
    width = radiance.shape[-1]
    images = [
        acquire(spectrum, width, sensor, ground.oversampling, draw, role) / sensor.max_dn
        for role, sensor in zip(ROLES, sensors, strict=False)
    ]
    # No two patches share a transfer function, and each is megabytes.
    transfer_function.cache_clear()
    mirrors, quarters = sensors[0].symmetry
    turned = turn(np.stack(images)[:, None], draw.generator("turn"), quarters, mirrors)
    return [np.ascontiguousarray(image[None]) for image in turned]


@dataclass(frozen=True)
class Calibration:
    """Where a run's patches come from."""

    sensor: Sensor
    images: Path | None
    patches: int
    patch_px: int
    seed: int

    @cached_property
    def drawn(self) -> Patches:
        """What the network is calibrated on."""
        return self._draw(self.patches, self.seed)

    @property
    def for_tuning(self) -> Patches:
        """Other patches of the same scenes, for what takes more of them."""
        return self._draw(TUNING_PATCHES, self.seed + TUNING_SEED)

    @property
    def unseen(self) -> Patches:
        """Patches of the same scenes, or of other drawn ones, that calibration does not see."""
        return unseen_patches(self.sensor, self.images, HELD_OUT_PATCHES, self.seed)

    @property
    def about(self) -> dict[str, str]:
        """What the file says of it."""
        return {"calibration_sensor": self.sensor.name, "calibration_seed": str(self.seed)}

    def _draw(self, count: int, seed: int) -> Patches:
        return draw_patches(
            self._scenes,
            self.sensor,
            self._reference,
            count,
            seed,
            self.patch_px,
            lightings=CALIBRATION,
        )

    @cached_property
    def _scenes(self) -> list[Scene]:
        return load_scenes(self.images, self._reference.nominal(), self.seed)

    @cached_property
    def _reference(self) -> Sensor:
        return self.sensor.reference


def unseen_patches(degraded: Sensor, images: Path | None, patches: int, seed: int) -> Patches:
    """Patches of 128 x 128 that calibration with the same seed does not draw.

    Args:
        degraded: the sensor's profile; the reference is the one that belongs to it.
        images: folder of scenes; None for drawn ones, which are others than calibration's.
        patches: how many.
        seed: of the calibration.
    """
    reference = degraded.reference
    # Another seed draws other scenes, and other patches of the same images.
    other = seed + HELD_OUT_SEED
    scenes = load_scenes(images, reference.nominal(), other, patches)
    return draw_patches(scenes, degraded, reference, patches, other, lightings=JUDGING)
