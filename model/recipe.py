"""The recipe that `simulate` leaves beside a folder of pairs: the sensors that made them, and the scenes they saw."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beers_deploy.model.io.images import site_of
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor, same_instrument
from beers_deploy.profiles.sensor_file import reference_beside, sensor_from_json
from beers_deploy.profiles.toml import read_json

SensorLike = Sensor | str | os.PathLike[str]


@dataclass(frozen=True)
class PairsRecipe:
    """The sensors that made a folder of pairs, and the scenes that they saw.

    Attributes:
        degraded: profile of the degraded images.
        reference: profile of the reference images.
        scenes: file names in their order; None for a drawn scene.
    """

    degraded: Sensor
    reference: Sensor
    scenes: tuple[str | None, ...]

    def site(self, stem: str) -> str:
        """The site of the pair NUMBER-SCENE or NUMBER-SCENE-PATCH: two frames of a site, or two patches, are one.

        A drawn scene is a site of its own.
        """
        number = stem.split("-", 1)[0]
        known = number.isdecimal() and int(number) < len(self.scenes)
        scene = self.scenes[int(number)] if known else stem
        return f"{number}-drawn" if scene is None else site_of(scene)


def read_pairs_recipe(folder: Path) -> PairsRecipe | None:
    """The recipe beside a folder's pairs; None where there is none."""
    path = folder / "recipe.json"
    if not path.exists():
        return None
    try:
        raw: Any = read_json(path)
        scenes = tuple(str(s["name"]) if "sha256" in s else None for s in raw["scenes"])
        sensors = {role: dict(raw[role]) for role in ("degraded", "reference")}
    except (LookupError, OSError, TypeError, ValueError) as error:
        remedy = "make the pairs anew, or remove it and give `sensor`"
        raise OptionError(str(path), expected="a dataset's recipe", got="another file", remedy=remedy) from error
    profiles = {role: sensor_from_json(f"{path} {role}", raw) for role, raw in sensors.items()}
    return PairsRecipe(profiles["degraded"], profiles["reference"], scenes)


def profiles_for(
    sensor: SensorLike | None, reference: SensorLike | None, recipe: PairsRecipe | None, say: Callable[[str], None]
) -> tuple[Sensor, Sensor]:
    """The profiles of degraded and reference images: the recipe's where there is one, else those named."""
    if recipe is None:
        degraded = Sensor.load(sensor or SENSOR)
        return degraded, reference_beside(degraded, reference, say)
    named = sensor and Sensor.load(sensor), reference and Sensor.load(reference).in_units_of(recipe.degraded)
    _require_made_by("sensor", named[0] or None, recipe.degraded)
    _require_made_by("reference", named[1] or None, recipe.reference)
    return recipe.degraded, recipe.reference


def _require_made_by(option: str, named: Sensor | None, made: Sensor) -> None:
    if named is not None and not same_instrument(named, made):
        expected = f"the sensor that made the pairs, {made.name} with the numbers in recipe.json"
        raise OptionError(option, expected=expected, got=f"{named.name} with other numbers", remedy="leave it out")
