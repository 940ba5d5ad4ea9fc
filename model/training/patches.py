"""Training patches, simulated as they are needed from whole scenes.

A scene's spectrum is computed once; each visit blurs, samples and folds it anew with another sensor, scale, phase
and exposure. Visiting whole scenes yields many patches for one transform.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from model.conditioning import SensorFamily, tell, transposed
from model.simulator.acquire import acquire
from model.simulator.draws import Draw
from model.simulator.sampling import crop_divisible, scene_spectrum
from model.simulator.scene import Scene
from model.training.workers import Worker
from profiles.errors import ImageError
from profiles.sensor import Sensor, SensorProfile, require_same_units


@dataclass(frozen=True)
class PatchRecipe:
    """How patches are drawn from scenes.

    Attributes:
        degraded: draws the sensor of each pass over a scene.
        reference: draws the sensor of the wanted image, in the units of `degraded`.
        patch_px: side of a patch.
        oversamplings: ratios to draw from; every ratio shows the same ground at another scale.
        exposures: darker and brighter days than the photograph's.
        margin_px: target pixels cropped on each side.
        told: draws the sensors instead of `degraded`; each patch then comes with the vector of its sensor.
    """

    degraded: SensorProfile
    reference: SensorProfile
    patch_px: int = 96
    oversamplings: tuple[int, ...] = (2, 3, 4, 5)
    exposures: tuple[float, float] = (0.5, 1.25)
    margin_px: int = 16
    told: SensorFamily | None = None

    def __post_init__(self) -> None:
        require_same_units(self.degraded, self.reference)


@dataclass(frozen=True)
class Visited:
    """A scene ready to be visited: its half spectrum and its width in pixels."""

    spectrum: Tensor
    width: int


class PatchSource:
    """Endless batches of (degraded, reference) patches, (N, 1, P, P) in [0, 1]; the same for the same seed.

    With sensors told, of (degraded, reference, sensor vectors (N, 4)).
    """

    SHARD_BATCHES = 16
    """Batches mixed together: enough scenes in one batch, little memory."""

    def __init__(
        self,
        scenes: list[Scene],
        recipe: PatchRecipe,
        batch: int,
        seed: int,
        worker: Worker | None = None,
        device: torch.device | None = None,
    ) -> None:
        self.recipe, self.batch, self.seed, self.worker = recipe, batch, seed, worker or Worker()
        common = int(np.lcm.reduce(recipe.oversamplings))
        self._scenes = [prepare(scene, common, device) for scene in scenes]

    def batches(self, first: int = 0) -> Iterator[tuple[Tensor, ...]]:
        """Batch number `first` and all that follow: a resumed run goes on where it stopped.

        The next shard is made while the present one is used.
        """
        number, within = divmod(first, self.SHARD_BATCHES)
        with ThreadPoolExecutor(1) as ahead:
            waiting = ahead.submit(self._shard, number)
            while True:
                shard = waiting.result()
                number += 1
                waiting = ahead.submit(self._shard, number)
                for k in range(within, self.SHARD_BATCHES):
                    part = slice(k * self.batch, (k + 1) * self.batch)
                    yield tuple(tensor[part] for tensor in shard)
                within = 0

    def _shard(self, number: int) -> tuple[Tensor, ...]:
        own = number * self.worker.count + self.worker.rank
        generator = Draw(self.seed, own).generator("shard")
        wanted, pieces, vectors, count = self.batch * self.SHARD_BATCHES, list[Tensor](), list[Tensor](), 0
        for _ in range(50 * wanted):
            piece, vector = visit(self._scenes[generator.integers(len(self._scenes))], self.recipe, generator)
            pieces.append(piece)
            vectors.append(vector.expand(len(piece), -1))
            count += len(piece)
            if count >= wanted:
                order = torch.from_numpy(generator.permutation(count)[:wanted])
                patches = torch.cat(pieces)
                patches = patches[order.to(patches.device)]
                pair = patches[:, :1].contiguous(), patches[:, 1:].contiguous()
                return (*pair, torch.cat(vectors)[order]) if self.recipe.told else pair
        raise ImageError(
            "training images",
            expected=f"scenes that hold a patch of {self.recipe.patch_px} target pixels",
            got="none large enough",
            remedy="give larger images or a smaller patch",
        )


def prepare(scene: Scene, multiple: int, device: torch.device | None = None) -> Visited:
    """Crop a scene to multiples of every oversampling, and transform it once, where the patches are wanted."""
    radiance = crop_divisible(scene.radiance, multiple).to(device or scene.radiance.device)
    return Visited(scene_spectrum(radiance), radiance.shape[-1])


def visit(scene: Visited, recipe: PatchRecipe, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
    """All the patches of one simulated pass over a scene, (N, 2, P, P), and the vector (4,) of its sensor.

    The patches are degraded and reference in [0, 1].
    """
    ratio = int(generator.choice(recipe.oversamplings))
    room = min(scene.spectrum.shape[-2], scene.width) // ratio - 2 * recipe.margin_px
    if room < recipe.patch_px:
        return scene.spectrum.real.new_empty(0, 2, recipe.patch_px, recipe.patch_px), torch.empty(4)
    images, sensor = _acquire_pair(scene, recipe, ratio, generator)
    patches = cut(images, recipe.patch_px, generator)
    alike = sensor.mtf_axes[0] == sensor.mtf_axes[1]
    quarter, mirrored = draw_turn(generator, quarters=alike or recipe.told is not None)
    vector = tell(sensor).vector
    return turned(patches, quarter, mirrored), transposed(vector) if quarter % 2 else vector


def _acquire_pair(
    scene: Visited, recipe: PatchRecipe, ratio: int, generator: np.random.Generator
) -> tuple[Tensor, Sensor]:
    """Degraded and reference, (2, H, W), and the sensor of the degraded one."""
    spectrum = scene.spectrum * float(generator.uniform(*recipe.exposures))
    phase_y, phase_x = (float(v) for v in generator.uniform(-ratio / 2, ratio / 2, 2))
    draw = Draw(int(generator.integers(2**31)))
    images, sensors = list[Tensor](), list[Sensor]()
    for profile, role in ((recipe.told or recipe.degraded, "degraded"), (recipe.reference, "reference")):
        sensor = profile.draw(generator)
        dn = acquire(spectrum, scene.width, sensor, ratio, draw, role, (phase_y, phase_x), recipe.margin_px)
        images.append(dn / sensor.max_dn)
        sensors.append(sensor)
    return torch.stack(images), sensors[0]


def cut(images: Tensor, patch_px: int, generator: np.random.Generator) -> Tensor:
    """Cut (C, H, W) into as many whole patches as fit, from a random corner: (N, C, P, P)."""
    height, width = images.shape[-2:]
    top, left = (int(generator.integers(size % patch_px + 1)) for size in (height, width))
    grid = images[:, top:, left:].unfold(1, patch_px, patch_px).unfold(2, patch_px, patch_px)
    return grid.permute(1, 2, 0, 3, 4).reshape(-1, images.shape[0], patch_px, patch_px)


def turn(patches: Tensor, generator: np.random.Generator, quarters: bool = True) -> Tensor:
    """One of the eight symmetries of the square, the same for all patches of a pass; of four without `quarters`."""
    return turned(patches, *draw_turn(generator, quarters))


def draw_turn(generator: np.random.Generator, quarters: bool) -> tuple[int, bool]:
    """Quarter turns, and whether to mirror afterwards; an odd number of quarters makes columns of rows.

    A blind network learns one sensor: where its two axes differ they must not change places, and `quarters` is False.
    """
    quarter = int(generator.integers(4))
    return quarter if quarters else quarter - quarter % 2, bool(generator.integers(2))


def turned(patches: Tensor, quarter: int, mirrored: bool) -> Tensor:
    """Patches (..., P, P) turned by quarters, then mirrored."""
    rotated = torch.rot90(patches, quarter, (-2, -1))
    return rotated.flip(-1) if mirrored else rotated
