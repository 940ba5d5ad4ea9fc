"""Pairs of a degraded and a reference image: simulated from scenes, or read from a folder that `simulate` wrote."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from model.io.images import MAX_DN, read_acquisition, site_of
from model.shipped import SENSOR
from model.simulator.acquire import (
    LEAST_SIDE_PX,
    MARGIN_PX,
    NOISE,
    acquire,
    fitting_oversampling,
    prepare_scene,
)
from model.simulator.detector import Draw
from model.simulator.sampling import Scene
from model.training.patches import pair_files
from profiles.errors import ImageError, OptionError
from profiles.sensor import Sensor, SensorProfile, same_instrument
from profiles.sensor_file import load_sensor, reference_beside, sensor_from_json
from profiles.toml import read_json


@dataclass(frozen=True)
class PairsRecipe:
    """The sensors that made a folder of pairs, and the scenes that they saw.

    Attributes:
        degraded: profile of the degraded images.
        reference: profile of the reference images.
        scenes: file names in their order; None for a drawn scene.
    """

    degraded: SensorProfile
    reference: SensorProfile
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
    """The recipe beside a folder's pairs; None where there is none.

    Raises:
        OptionError: a recipe that is none of ours.
        ProfileError: a sensor in it that cannot be.
    """
    path = folder / "recipe.json"
    if not path.exists():
        return None
    try:
        raw: Any = read_json(path)
        scenes = tuple(str(s["name"]) if "sha256" in s else None for s in raw["scenes"])
        sensors = {role: dict(raw[role]) for role in ("degraded", "reference")}
    except (LookupError, OSError, TypeError, ValueError) as error:
        remedy = "make the pairs anew, or remove it and say --sensor"
        raise OptionError(str(path), expected="a dataset's recipe", got="another file", remedy=remedy) from error
    profiles = {role: sensor_from_json(f"{path} {role}", raw) for role, raw in sensors.items()}
    return PairsRecipe(profiles["degraded"], profiles["reference"], scenes)


def profiles_for(
    sensor: str | None, reference: str | None, recipe: PairsRecipe | None, say: Callable[[str], None]
) -> tuple[SensorProfile, SensorProfile]:
    """The profiles of degraded and reference images: the recipe's where there is one, else those named.

    Raises:
        OptionError: a name that contradicts the recipe.
        ProfileError: no such profile, or a faulty one.
    """
    if recipe is None:
        degraded = load_sensor(sensor or SENSOR)
        return degraded, reference_beside(degraded, reference, say)
    named = sensor and load_sensor(sensor), reference and load_sensor(reference).in_units_of(recipe.degraded)
    _require_made_by("--sensor", named[0] or None, recipe.degraded)
    _require_made_by("--reference", named[1] or None, recipe.reference)
    return recipe.degraded, recipe.reference


def _require_made_by(option: str, named: SensorProfile | None, made: SensorProfile) -> None:
    if named is not None and not same_instrument(named, made):
        expected = f"the sensor that made the pairs, {made.name} with the numbers in recipe.json"
        raise OptionError(option, expected=expected, got=f"{named.name} with other numbers", remedy="leave it out")


OVERSAMPLINGS = (4, 2)


class SensorSource(Protocol):
    """What gives a sensor for each scene: a profile, or always the same one."""

    def draw(self, generator: np.random.Generator, /) -> Sensor:
        """One sensor."""
        ...


@dataclass(frozen=True)
class NamedPair:
    """Two acquisitions of one scene, (H, W) float32 digital numbers of the same units, and the scene's name.

    Attributes:
        place: its site, where one is known by more than the name.
        oversampling: scene pixels per pixel, where the pair was simulated here.
        noise_free: the reference without noise and rounding, (H, W) float32, where the pair was simulated here.
    """

    name: str
    degraded: np.ndarray
    reference: np.ndarray
    place: str | None = None
    oversampling: int | None = None
    noise_free: np.ndarray | None = None

    @property
    def site(self) -> str:
        """The place that is known; else the name without what tells frames of one site apart."""
        return self.place or site_of(self.name)


def simulate_pairs(
    scenes: list[Scene],
    degraded: SensorSource,
    reference: SensorSource,
    seed: int,
    oversamplings: Sequence[int] = OVERSAMPLINGS,
) -> tuple[list[NamedPair], list[str]]:
    """Simulate a pair of each scene, at the first of the oversamplings that leaves enough of it.

    Returns:
        The pairs, and the names of scenes too small to use.

    Raises:
        ImageError: all are too small.
    """
    pairs, small = [], []
    for number, scene in enumerate(scenes):
        ratio = fitting_oversampling(scene.radiance, oversamplings, LEAST_SIDE_PX)
        if ratio is None:
            small.append(scene.name)
            continue
        draw = Draw(seed, number)
        drawn = [profile.draw(draw.generator("sensor")) for profile in (degraded, reference)]
        pairs.append(_simulated(scene, drawn[0], drawn[1], ratio, draw))
    if not pairs:
        least = oversamplings[-1] * (2 * MARGIN_PX + LEAST_SIDE_PX)
        raise ImageError(
            "images",
            expected=f"scenes of {least} pixels a side or more",
            got=f"{len(small)} smaller ones",
            remedy="give larger images",
        )
    return pairs, small


def _simulated(scene: Scene, degraded: Sensor, reference: Sensor, ratio: int, draw: Draw) -> NamedPair:
    """Three acquisitions of one scene: the pair, and the reference once more without its noise."""
    prepared = prepare_scene(scene.radiance, ratio)
    spectrum, width = prepared.spectrum, prepared.radiance.shape[-1]
    seen, meant, clean = (
        acquire(spectrum, width, sensor, ratio, draw, role, skip=skip).numpy()
        for sensor, role, skip in (
            (degraded, "degraded", ()),
            (reference, "reference", ()),
            (reference, "reference", NOISE),
        )
    )
    return NamedPair(scene.name, seen, meant, oversampling=ratio, noise_free=clean)


def oversamplings_of(profile: SensorProfile) -> tuple[int, ...]:
    """The profile's oversampling, though no more than 4, and 2 for scenes too small for it.

    At more than 4 little would be left of a photograph, and the blur is sampled finely enough at 4.
    """
    own = int(profile.oversampling.low)
    return tuple(dict.fromkeys(min(own, ratio) for ratio in OVERSAMPLINGS))


def oversampling_note(pairs: Sequence[NamedPair], profile: SensorProfile) -> str:
    """A sentence where pairs were simulated at another oversampling than the profile's; else nothing."""
    own = int(profile.oversampling.low)
    counts = Counter(pair.oversampling for pair in pairs if pair.oversampling is not None)
    if not set(counts) - {own}:
        return ""
    used = " and ".join(f"{ratio} ({count} of {len(pairs)} images)" for ratio, count in sorted(counts.items())[::-1])
    return (
        f"scene pixels per pixel: {used}, where {profile.name} states {own}; at most {OVERSAMPLINGS[0]} are taken, "
        f"and {OVERSAMPLINGS[1]} of small images ('simulate' keeps the profile's)"
    )


def read_pairs(folder: Path, max_dn: int = MAX_DN, recipe: PairsRecipe | None = None) -> list[NamedPair]:
    """Read FOLDER/degraded/NAME.tif beside FOLDER/reference/NAME.tif, mono images of 0 to max_dn.

    With the recipe beside them, the sites are those of the scenes that it names.

    Raises:
        ImageError: a folder is missing, a name has no partner, or two images differ in size.
    """
    return list(_read_pairs(folder, max_dn, recipe))


def _read_pairs(folder: Path, max_dn: int, recipe: PairsRecipe | None) -> Iterator[NamedPair]:
    for degraded, reference in pair_files(folder):
        seen, meant = (read_acquisition(path, max_dn=max_dn) for path in (degraded, reference))
        pair = NamedPair(degraded.stem, seen, meant, recipe.site(degraded.stem) if recipe else None)
        if pair.degraded.shape != pair.reference.shape:
            sizes = " and ".join(f"{a.shape[1]} x {a.shape[0]}" for a in (pair.degraded, pair.reference))
            raise ImageError(
                f"pair {pair.name}", expected="two images of one size", got=sizes, remedy="crop them alike"
            )
        yield pair
