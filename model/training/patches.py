"""How training patches are drawn from scenes and turned, and where stored pairs of them lie;
nothing needs torch.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.training.looks import ORDINARY, Looks
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.reference import require_same_units
from beers_deploy.profiles.sensor import Sensor


@dataclass(frozen=True)
class PatchRecipe:
    """How patches are drawn from scenes.

    Attributes:
        degraded: draws the sensor of each pass over a scene.
        reference: draws the sensor of the wanted image, in the units of `degraded`.
        patch_px: side of a patch.
        oversamplings: ratios to draw from; every ratio shows the same ground at another scale.
        looks: of the ground.
        margin_px: target pixels cropped on each side.
        family: draws the sensors instead of `degraded`; each patch then comes with what a network
            is told of its sensor, and dark patches are brightened as a restoration brightens them.
        noisy_reference: whether the wanted image has the reference's noise.
    """

    degraded: Sensor
    reference: Sensor
    patch_px: int = 96
    oversamplings: tuple[int, ...] = (2, 3, 4, 5)
    looks: Looks = ORDINARY
    margin_px: int = 16
    family: SensorFamily | None = None
    noisy_reference: bool = True

    def __post_init__(self) -> None:
        require_same_units(self.degraded, self.reference)


def turn(
    patches: np.ndarray, generator: np.random.Generator, quarters: bool = True, mirrors: bool = True
) -> np.ndarray:
    """Patches (..., P, P) in one of the square's eight symmetries, the same for all; see
    `draw_turn`.
    """
    return turned(patches, *draw_turn(generator, quarters, mirrors))


def draw_turn(
    generator: np.random.Generator, quarters: bool, mirrors: bool = True
) -> tuple[int, bool]:
    """Quarter turns, and whether to mirror afterwards; an odd number of quarters makes columns of
    rows.

    A plain network learns one sensor. Where its two axes differ they must not change places, and
    `quarters` is False: four symmetries are left. Where its blur is lopsided it stays as it is, and
    `mirrors` is False.
    """
    # Both are drawn whatever is allowed: the generator goes on in the same way.
    quarter = int(generator.integers(4))
    mirrored = bool(generator.integers(2))
    if not mirrors:
        return 0, False
    return quarter if quarters else quarter - quarter % 2, mirrored


def turned(patches: np.ndarray, quarter: int, mirrored: bool) -> np.ndarray:
    """Patches (..., P, P) turned by quarters, then mirrored."""
    rotated = np.rot90(patches, quarter, (-2, -1))
    return rotated[..., ::-1] if mirrored else rotated


Files = tuple[Path, Path]
"""A degraded and a reference image."""


def pair_files(folder: Path) -> list[Files]:
    """The pairs FOLDER/degraded/NAME and FOLDER/reference/NAME, by name."""
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
