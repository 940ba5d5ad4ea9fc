"""Define how training patches are drawn from scenes and turned, and find stored pairs; without
torch.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.training.looks import ORDINARY, Looks
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.sensor import Sensor


@dataclass(frozen=True)
class PatchRecipe:
    """The parameters by which patches are drawn from scenes.

    Attributes:
        degraded: the profile from which the sensor of each pass is drawn.
        reference: the profile from which the sensor of the target image is drawn, in the units of
            `degraded`.
        patch_px: the side of a patch in pixels.
        oversamplings: the numbers of scene pixels per pixel to draw from; each shows the same
            ground at another scale.
        looks: how light, contrast and softness of the ground are drawn.
        margin_px: the number of pixels that are cropped on each side of a simulated image.
        family: the sensors to draw from instead of `degraded`. Each patch then comes with the
            description of its sensor, and dark patches are brightened as in a restoration.
        noisy_reference: True if the target image has the noise of the reference.
    """

    degraded: Sensor
    reference: Sensor
    patch_px: int
    oversamplings: tuple[int, ...] = (2, 3, 4, 5)
    looks: Looks = ORDINARY
    margin_px: int = 16
    family: SensorFamily | None = None
    noisy_reference: bool = True


def turn(
    patches: np.ndarray, generator: np.random.Generator, quarters: bool = True, mirrors: bool = True
) -> np.ndarray:
    """Rotate patches (..., P, P) by random quarter turns, then mirror them or not, all in the same
    way; see `draw_turn`.
    """
    quarter, mirrored = draw_turn(generator, quarters, mirrors)
    rotated = np.rot90(patches, quarter, (-2, -1))
    return rotated[..., ::-1] if mirrored else rotated


def draw_turn(
    generator: np.random.Generator, quarters: bool, mirrors: bool = True
) -> tuple[int, bool]:
    """Draw the number of quarter turns, and whether to mirror afterwards.

    An odd number of quarter turns swaps rows and columns. A plain network learns one sensor. If its
    two axes differ, they must not be swapped: four symmetries remain.

    Args:
        generator: the generator of the draws.
        quarters: True if odd quarter turns are allowed.
        mirrors: False if the blur is asymmetric; patches are then not changed at all.
    """
    # Both are always drawn, so that the generator continues in the same way.
    quarter = int(generator.integers(4))
    mirrored = bool(generator.integers(2))
    if not mirrors:
        return 0, False
    return quarter if quarters else quarter - quarter % 2, mirrored


Files = tuple[Path, Path]
"""A degraded and a reference image."""


def pair_files(folder: Path) -> list[Files]:
    """List the pairs FOLDER/degraded/NAME and FOLDER/reference/NAME by name, or raise
    ImageError.
    """
    degraded, reference = (
        {p.stem: p for p in list_images(folder / role)} for role in ("degraded", "reference")
    )
    unpaired = sorted(degraded.keys() ^ reference.keys())
    if unpaired:
        raise ImageError(
            f"{folder} has {unpaired[0]!r} in only one of the folders degraded and reference. "
            "Complete the pairs; 'beers-deploy simulate' writes such folders."
        )
    return [(path, reference[name]) for name, path in degraded.items()]
