"""Read the recipe next to a folder of pairs: the sensors that made them, and their scenes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beers_deploy.model.raster.images import site_of
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.reference import reference_for
from beers_deploy.profiles.sensor import Sensor, SensorLike, same_instrument
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.profiles.validation import validated


@dataclass(frozen=True)
class PairsRecipe:
    """The recipe next to a folder of simulated pairs: the sensors and scenes that made them.

    Attributes:
        degraded: the sensor of the images to restore.
        reference: the sensor of the reference images.
        scenes: the name of each scene's photograph by the number of the scene; None if it is
            drawn.
    """

    degraded: Sensor
    reference: Sensor
    # File names in their order, None for a drawn scene.
    scenes: tuple[str | None, ...]

    def site(self, stem: str) -> str:
        """Return the site of a pair by the stem of its file, NUMBER-SCENE or NUMBER-SCENE-PATCH.

        The recipe gives the photograph of NUMBER, whose name begins with its site. Every drawn
        scene is a site of its own, "NUMBER-drawn".
        """
        number = stem.split("-", 1)[0]
        is_number = number.isdecimal() and int(number) < len(self.scenes)
        scene = self.scenes[int(number)] if is_number else stem
        return f"{number}-drawn" if scene is None else site_of(scene)


def read_pairs_recipe(folder: Path) -> PairsRecipe | None:
    """Read the recipe next to a folder's pairs, or return None if there is none."""
    path = folder / "recipe.json"
    if not path.exists():
        return None
    try:
        raw: Any = read_json(path)
        scenes = tuple(str(s["name"]) if "sha256" in s else None for s in raw["scenes"])
        sensors = {role: dict(raw[role]) for role in ("degraded", "reference")}
    except (LookupError, OSError, TypeError, ValueError) as error:
        raise OptionError(
            f"{path} is not the recipe of a dataset. Simulate the pairs again, or remove the file "
            "and give `sensor`."
        ) from error
    profiles = {role: validated(Sensor, raw, f"{path} {role}") for role, raw in sensors.items()}
    return PairsRecipe(profiles["degraded"], profiles["reference"], scenes)


def profiles_for(
    sensor: SensorLike | None,
    reference: SensorLike | None,
    recipe: PairsRecipe | None,
) -> tuple[Sensor, Sensor]:
    """Return the profiles of the degraded and the reference images.

    Args:
        sensor: the sensor that the user names; None for that of the recipe, or the default one.
        reference: the reference sensor that the user names; None as for `sensor`.
        recipe: the recipe of the pairs; a named sensor must agree with it. None if there is none.
    """
    if recipe is None:
        degraded = Sensor.load(sensor or SENSOR)
        return degraded, reference_for(degraded, reference)
    if sensor:
        _require_made_by("sensor", Sensor.load(sensor), recipe.degraded)
    if reference:
        # A dataset's images are in the degraded sensor's units: so is its reference.
        profile = Sensor.load(reference).in_units_of(recipe.degraded)
        _require_made_by("reference", profile, recipe.reference)
    return recipe.degraded, recipe.reference


def _require_made_by(option: str, profile: Sensor, of_recipe: Sensor) -> None:
    if not same_instrument(profile, of_recipe):
        raise OptionError(
            f"`{option}` must be the sensor that made the pairs, {of_recipe.name} with the numbers "
            f"in recipe.json, but it is {profile.name} with other numbers. Leave it out."
        )
