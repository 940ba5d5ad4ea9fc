"""Simulate patches for calibration, and to judge the effect of INT8.

Patches are simulated again for each pass over them, which costs a tenth of the network's own time.
Memory therefore grows neither with their number nor with their size.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.simulator.acquire import acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.mtf import transfer_function
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.patches import PatchRecipe, turn
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.samples.patches import PATCH_PX, Pair, Patches, Regenerated
from beers_deploy.quant.samples.views import (
    CALIBRATION,
    JUDGING,
    Ground,
    Lightings,
    draw_views,
    relit,
)

HELD_OUT_SEED = 1000
"""Added to the seed of a run for patches that must differ from those of calibration."""
HELD_OUT_PATCHES = 32
TUNING_SEED = 2000
"""Added to a run's seed for the patches that the integers are trained on."""
TUNING_PATCHES = 256
ROLES = "degraded", "reference"
"""The sensors of a pair, each with its own noise, so that a degraded patch is the same in a pair
and alone.
"""
NO_LIGHTING: Lightings = {}


def draw_patches(
    scenes: list[Scene],
    degraded: Sensor,
    reference: Sensor,
    count: int,
    seed: int,
    patch_px: int = PATCH_PX,
    family: SensorFamily | None = None,
    lightings: Lightings = NO_LIGHTING,
) -> Patches:
    """Draw patches of scenes as a sensor would acquire them, spread over its properties and over
    brightness.

    The patches are simulated when they are read.

    Args:
        scenes: the scenes whose ground is shown.
        degraded: the profile from whose ranges the sensor of each patch is drawn, unless there is a
            family.
        reference: the profile of the better sensor that acquires the target images.
        count: the number of patches.
        seed: the seed of all random draws.
        patch_px: side of a patch in pixels.
        family: sensors of many blurs and noise levels to draw from instead, which have the gain and
            bits of `degraded`.
        lightings: the ways in which the ground is lit, each with its share of the patches, so that
            the patches cover the sensor's range. Without any the ground is as bright as in the
            scenes.

    Raises:
        ImageError: no scene is large enough for a patch.
        ProfileError: the two profiles differ in gain, bits or offset.
    """
    recipe = PatchRecipe(degraded, reference, patch_px=patch_px, family=family)
    # Each purpose has a generator of its own, so that lightings change no other draw.
    views = draw_views(scenes, recipe, count, Draw(seed).generator("views"))
    if lightings:
        views = relit(views, lightings, Draw(seed).generator("lighting"))

    # Keyed by the patch's number, because patches are simulated in any order.
    def pair(number: int) -> Pair:
        view = views[number]
        image, target = _simulate(view.ground, (view.degraded, view.reference), Draw(seed, number))
        return image, target

    def alone(number: int) -> np.ndarray:
        view = views[number]
        return _simulate(view.ground, (view.degraded,), Draw(seed, number))[0]

    return Patches(Regenerated(pair, count), Regenerated(alone, count), views=views)


def _simulate(ground: Ground, sensors: Sequence[Instrument], draw: Draw) -> list[np.ndarray]:
    """Simulate patches (1, 1, P, P) of the same ground by the degraded sensor and, if given, the
    reference.
    """
    scene = prepare_scene(ground.radiance, ground.oversampling)
    images = [
        acquire(scene, sensor, draw, role) / sensor.max_dn
        for role, sensor in zip(ROLES, sensors, strict=False)
    ]
    # No two patches share a transfer function, and each is megabytes.
    transfer_function.cache_clear()
    mirrors, quarters = sensors[0].symmetry
    turned = turn(np.stack(images)[:, None], draw.generator("turn"), quarters, mirrors)
    return [np.ascontiguousarray(image[None]) for image in turned]


@dataclass(frozen=True)
class Calibration:
    """The simulated patches of one run of the quantiser, drawn from a sensor's profile and a seed.

    Attributes:
        sensor: the profile of the sensor whose images the network restores.
        images: the folder of scenes; None for scenes that are drawn at random.
        patches: the number of patches that the network is calibrated on.
        patch_px: side of these patches in pixels.
        seed: the seed of all random draws.
    """

    sensor: Sensor
    images: Path | None
    patches: int
    patch_px: int
    seed: int

    @cached_property
    def drawn(self) -> Patches:
        """The patches that the network is calibrated on."""
        return self._draw(self.patches, self.seed)

    @property
    def for_tuning(self) -> Patches:
        """The patches that the integers are fine-tuned on: TUNING_PATCHES others of the same
        scenes.
        """
        return self._draw(TUNING_PATCHES, self.seed + TUNING_SEED)

    @property
    def unseen(self) -> Patches:
        """Patches for judging the INT8 network, which calibration does not use.

        They show other places of the scenes, or other scenes if these are drawn.
        """
        return unseen_patches(self.sensor, self.images, HELD_OUT_PATCHES, self.seed)

    @property
    def about(self) -> dict[str, str]:
        """The metadata by which an INT8 file describes its calibration: the sensor's name, and the
        seed.
        """
        return {"calibration_sensor": self.sensor.name, "calibration_seed": str(self.seed)}

    def _draw(self, count: int, seed: int) -> Patches:
        reference = self.sensor.reference
        return draw_patches(
            self._scenes,
            self.sensor,
            reference,
            count,
            seed,
            self.patch_px,
            lightings=CALIBRATION,
        )

    @cached_property
    def _scenes(self) -> list[Scene]:
        return load_scenes(self.images, self.sensor.reference.nominal(), self.seed)


def unseen_patches(degraded: Sensor, images: Path | None, patches: int, seed: int) -> Patches:
    """Draw patches of 128 x 128 pixels, to judge a network, that calibration with the same seed
    does not use.

    Args:
        degraded: the sensor's profile; the reference is the one that belongs to it.
        images: the folder of scenes; None for drawn scenes, which differ from those of calibration.
        patches: the number of patches.
        seed: the seed of the calibration.
    """
    reference = degraded.reference
    # Another seed draws other scenes, and other patches of the same images.
    other = seed + HELD_OUT_SEED
    scenes = load_scenes(images, reference.nominal(), other, patches)
    return draw_patches(scenes, degraded, reference, patches, other, lightings=JUDGING)
