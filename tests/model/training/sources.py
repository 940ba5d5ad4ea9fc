"""Patches of a small procedural scene, for the tests of training."""

from dataclasses import replace
from functools import cache

import numpy as np

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.patches import PatchRecipe
from beers_deploy.model.training.source import PatchSource
from beers_deploy.profiles.sensor import Sensor
from tests.model.simulator.stages import NOMINAL


@cache
def small_scene() -> Scene:
    return procedural_scene(420, 480, np.random.default_rng(2))


def source(
    scene: Scene | None = None,
    seed: int = 0,
    patch_px: int = 32,
    rank: int = 0,
    workers: int = 1,
    *,
    conditioned: bool = False,
) -> PatchSource:
    """Return a source of batches of three, of one variable sensor or of a family of sensors."""
    recipe = PatchRecipe(
        Sensor.load("pleiades-variable"), Sensor.load("pleiades-reference"), patch_px=patch_px
    )
    if conditioned:
        recipe = replace(recipe, family=SensorFamily(NOMINAL))
    return PatchSource(
        [scene or small_scene()], recipe, batch=3, seed=seed, rank=rank, workers=workers
    )
