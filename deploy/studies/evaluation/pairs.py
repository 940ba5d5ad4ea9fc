"""Pairs of a degraded and a reference image: simulated from scenes, or read from a folder that
`simulate` wrote.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beers_deploy.model.pairs_recipe import PairsRecipe
from beers_deploy.model.raster.images import read_acquisition, site_of
from beers_deploy.model.simulator import acquire
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.patches import pair_files
from beers_deploy.pairs import Pair
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.instrument import MAX_DN, Instrument
from beers_deploy.profiles.sensor import Sensor

OVERSAMPLINGS = (4, 2)


@dataclass(frozen=True)
class NamedPair:
    """A pair of images of one scene, on which methods are compared.

    Attributes:
        name: the name of the scene.
        degraded: the image of the sensor, which methods restore, (H, W) float32 digital numbers.
        reference: the image of the better sensor that restorations aim at, (H, W) float32 digital
            numbers of the degraded sensor.
        place: the site of the scene, if the recipe of the pairs states it; None derives it from the
            name.
        oversampling: scene pixels per pixel along either side, if the pair was simulated from a
            scene here; else None.
        noise_free: the reference without noise and rounding, (H, W) float32; None if it is not
            known.
    """

    name: str
    degraded: np.ndarray
    reference: np.ndarray
    place: str | None = None
    oversampling: int | None = None
    noise_free: np.ndarray | None = None

    @property
    def site(self) -> str:
        """The site, by which images of one place are grouped: `place` if it is stated, else the
        name without the number of the frame.
        """
        return self.place or site_of(self.name)

    @property
    def truth(self) -> np.ndarray:
        """The reference without noise if it is known, else the reference."""
        return self.reference if self.noise_free is None else self.noise_free


def pairs_of_scenes(
    images: Path | None, degraded: Sensor, reference: Sensor, seed: int, brightness: float = 1.0
) -> tuple[list[NamedPair], list[str]]:
    """Simulate a pair of images from each scene of a folder, or from each of some drawn scenes.

    Args:
        images: the folder of photographs or radiances that are the scenes; None draws scenes.
        degraded: the profile of the sensor of the degraded images.
        reference: the profile of the sensor of the reference images.
        seed: the seed of every random draw.
        brightness: the factor by which the radiance of the scenes is multiplied.

    Returns:
        The pairs, and sentences for the reader of the results: on scenes that were too small, and
        on an oversampling other than the profile's.

    Raises:
        ImageError: all scenes are too small.
    """
    scenes = scenes_at(brightness, load_scenes(images, reference.nominal(), seed))
    pairs, small = simulate_pairs(scenes, degraded, reference, seed, oversamplings_of(degraded))
    left_out = f"Left out, too small: {', '.join(small)}." if small else ""
    return pairs, [note for note in (oversampling_note(pairs, degraded), left_out) if note]


def scenes_at(brightness: float, scenes: Iterable[Scene]) -> list[Scene]:
    """Return scenes whose radiance is multiplied by the factor `brightness`."""
    factor = np.float32(brightness)
    return [replace(scene, radiance=scene.radiance * factor) for scene in scenes]


def table_at(brightness: float, name: str) -> str:
    """Return the name of a table on dimmed scenes: `name` with the factor of their radiance.

    Args:
        brightness: the factor by which the radiance of the scenes was multiplied; 1 adds nothing.
        name: the name of the same table on scenes that are not dimmed.
    """
    return name if brightness == 1 else f"{name}, radiance x {brightness:g}"


def simulate_pairs(
    scenes: list[Scene],
    degraded: Sensor | Instrument,
    reference: Sensor | Instrument,
    seed: int,
    oversamplings: Sequence[int] = OVERSAMPLINGS,
) -> tuple[list[NamedPair], list[str]]:
    """Simulate a pair of images from each scene.

    Args:
        scenes: the radiances that the sensors acquire.
        degraded: the sensor of the degraded images: one instrument for all scenes, or a profile
            from which one is drawn for each scene.
        reference: the sensor of the reference images, an instrument or a profile, too.
        seed: the seed of every random draw.
        oversamplings: numbers of scene pixels per pixel, in the order of preference. Each scene is
            acquired at the first at which its pair is large enough.

    Returns:
        The pairs, and the names of scenes that are too small to use.

    Raises:
        ImageError: all scenes are too small.
    """
    pairs = []
    small = []
    for number, scene in enumerate(scenes):
        ratio = acquire.fitting_oversampling(scene.radiance, oversamplings, acquire.LEAST_SIDE_PX)
        if ratio is None:
            small.append(scene.name)
            continue
        # A scene that is left out has a number too, so the draws of the others do not change.
        draw = Draw(seed, number)
        camera, aim = (
            source if isinstance(source, Instrument) else source.draw(draw.generator("sensor"))
            for source in (degraded, reference)
        )
        # Both sensors and the reference without noise share the spectrum of the scene.
        ready = acquire.prepare_scene(scene.radiance, ratio)
        degraded_dn, reference_dn, clean = acquire.acquire_three(ready, camera, aim, draw)
        pairs.append(
            NamedPair(scene.name, degraded_dn, reference_dn, oversampling=ratio, noise_free=clean)
        )
    if not pairs:
        least = acquire.scene_side_px(acquire.LEAST_SIDE_PX, oversamplings[-1])
        raise ImageError(
            f"The scenes in `images` must have {least} pixels a side or more, but none "
            f"of {len(small)} has. Give larger images."
        )
    return pairs, small


def oversamplings_of(profile: Sensor) -> tuple[int, ...]:
    """Return the numbers of scene pixels per pixel at which pairs are simulated for a sensor, in
    the order of preference.

    The first is that of the profile, but at most 4: at more than 4 little would be left of a
    photograph, and at 4 the blur is sampled finely enough. The second, at most 2, is for scenes
    that are too small for the first.
    """
    own = int(profile.oversampling.low)
    return tuple(dict.fromkeys(min(own, ratio) for ratio in OVERSAMPLINGS))


def oversampling_note(pairs: Sequence[NamedPair], profile: Sensor) -> str:
    """Return a sentence for the reader of the results if some pairs were simulated at another
    number of scene pixels per pixel than the profile states; else an empty text.
    """
    own = int(profile.oversampling.low)
    ratios = {pair.oversampling for pair in pairs if pair.oversampling is not None}
    if ratios <= {own}:
        return ""
    return (
        f"Scene pixels per pixel: {' and '.join(map(str, sorted(ratios)))}, where {profile.name} "
        f"states {own}; at most {OVERSAMPLINGS[0]} are taken, and {OVERSAMPLINGS[1]} of small "
        "images ('simulate' keeps the profile's)."
    )


def numbered_pairs(given: Iterable[Pair]) -> list[NamedPair]:
    """Return pairs in memory, each named by its number.

    Raises:
        OptionError: there is none.
        ImageError: a pixel is NaN or infinite, of which no score can be computed.
    """
    pairs = []
    for number, pair in enumerate(given):
        degraded, reference, clean = (
            np.asarray(image, np.float32) for image in (*pair, pair.clean)
        )
        if not all(np.isfinite(image).all() for image in (degraded, reference, clean)):
            raise ImageError(
                f"Pair {number} of `pairs` has pixels that are NaN or infinite. Crop them off, or "
                "leave the pair out."
            )
        pairs.append(NamedPair(f"pair{number}", degraded, reference, noise_free=clean))
    if not pairs:
        raise OptionError("There are no `pairs`. Give at least one.")
    return pairs


def read_pairs(
    folder: Path, max_dn: int = MAX_DN, recipe: PairsRecipe | None = None
) -> list[NamedPair]:
    """Read stored pairs of images, such as `simulate` writes.

    Args:
        folder: the folder with degraded/NAME.tif and reference/NAME.tif, images of one band.
        max_dn: the largest digital number; by default that of 12 bits.
        recipe: the recipe that `simulate` wrote next to the pairs, which names the site of each
            scene; None derives sites from the names of the files.

    Raises:
        ImageError: an image cannot be read or has values outside 0 to `max_dn`, or the two images
            of a pair differ in size.
    """
    pairs = []
    for degraded, reference in pair_files(folder):
        degraded_dn, reference_dn = (
            read_acquisition(path, max_dn=max_dn) for path in (degraded, reference)
        )
        if degraded_dn.shape != reference_dn.shape:
            raise ImageError(
                f"The two images of the pair {degraded.stem} must have one size, but they have "
                "{1} x {0} and {3} x {2} px. Crop them alike.".format(
                    *degraded_dn.shape, *reference_dn.shape
                )
            )
        place = recipe.site(degraded.stem) if recipe else None
        pairs.append(NamedPair(degraded.stem, degraded_dn, reference_dn, place))
    return pairs
