"""Training patches, simulated as they are needed from whole scenes.

A scene's spectrum is computed once; each visit blurs, samples and folds it anew with another sensor, scale, phase
and exposure. Visiting whole scenes yields many patches for one transform.
"""

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from beers_deploy.model.family import SensorFamily, sensor_vector
from beers_deploy.model.io.images import list_images, read_acquisition
from beers_deploy.model.simulator.acquire import acquire
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import Scene, crop_divisible, scene_spectrum
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.sensor import Instrument, Sensor, require_same_units


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
        family: draws the sensors instead of `degraded`; each patch then comes with the vector of its sensor.
    """

    degraded: Sensor
    reference: Sensor
    patch_px: int = 96
    oversamplings: tuple[int, ...] = (2, 3, 4, 5)
    exposures: tuple[float, float] = (0.5, 1.25)
    margin_px: int = 16
    family: SensorFamily | None = None

    def __post_init__(self) -> None:
        require_same_units(self.degraded, self.reference)


@dataclass(frozen=True)
class Visited:
    """A scene ready to be visited: its half spectrum and its width in pixels."""

    spectrum: np.ndarray
    width: int


class PatchSource:
    """Endless batches of (degraded, reference) patches, (N, 1, P, P) in [0, 1]; the same for the same seed.

    Where the recipe has a family of sensors, of (degraded, reference, sensor vectors (N, 4)).
    """

    SHARD_BATCHES = 16
    """Batches mixed together: enough scenes in one batch, little memory."""
    MOST_THREADS = 8
    """Shards are made ahead by so many: each is some tens of megabytes."""

    def __init__(
        self,
        scenes: list[Scene],
        recipe: PatchRecipe,
        batch: int,
        seed: int,
        rank: int = 0,
        workers: int = 1,
    ) -> None:
        self.recipe, self.batch, self.seed, self.rank, self.workers = recipe, batch, seed, rank, workers
        common = int(np.lcm.reduce(recipe.oversamplings))
        self._scenes = [prepare(scene, common) for scene in scenes]

    def batches(self, first: int = 0) -> Iterator[tuple[np.ndarray, ...]]:
        """Batch number `first` and all that follow, of (N, 1, P, P): a resumed run goes on where it stopped.

        The next shards are made while the present one is used, on half of the cores: a GPU waits for patches.
        """
        number, within = divmod(first, self.SHARD_BATCHES)
        threads = min(max((os.cpu_count() or 1) // 2, 1), self.MOST_THREADS)
        with ThreadPoolExecutor(threads) as ahead:
            waiting = deque(ahead.submit(self._shard, number + k) for k in range(threads))
            while True:
                shard = waiting.popleft().result()
                number += 1
                waiting.append(ahead.submit(self._shard, number + threads - 1))
                for k in range(within, self.SHARD_BATCHES):
                    part = slice(k * self.batch, (k + 1) * self.batch)
                    yield tuple(array[part] for array in shard)
                within = 0

    def _shard(self, number: int) -> tuple[np.ndarray, ...]:
        # Keyed by its number and not drawn in sequence: a resumed run makes the same shard.
        generator = Draw(self.seed, number * self.workers + self.rank).generator("shard")
        wanted, pieces, vectors, count = self.batch * self.SHARD_BATCHES, list[np.ndarray](), list[np.ndarray](), 0
        for _ in range(50 * wanted):
            piece, vector = visit(self._scenes[generator.integers(len(self._scenes))], self.recipe, generator)
            pieces.append(piece)
            vectors.append(np.broadcast_to(vector, (len(piece), len(vector))))
            count += len(piece)
            if count >= wanted:
                # Mixed, because neighbours of one scene would make a batch whose gradient knows one scene.
                order = generator.permutation(count)[:wanted]
                patches = np.concatenate(pieces)[order]
                pair = np.ascontiguousarray(patches[:, :1]), np.ascontiguousarray(patches[:, 1:])
                return (*pair, np.concatenate(vectors)[order]) if self.recipe.family else pair
        expected = f"scenes that hold a patch of {self.recipe.patch_px} target pixels"
        remedy = "give larger images or a smaller patch"
        raise ImageError("training images", expected=expected, got="none large enough", remedy=remedy)


def prepare(scene: Scene, multiple: int) -> Visited:
    """Crop a scene to multiples of every oversampling, and transform it once."""
    radiance = crop_divisible(scene.radiance, multiple)
    return Visited(scene_spectrum(radiance), radiance.shape[-1])


def visit(scene: Visited, recipe: PatchRecipe, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """All the patches of one simulated pass over a scene, (N, 2, P, P), and the vector (4,) of its sensor.

    The patches are degraded and reference in [0, 1].
    """
    ratio = int(generator.choice(recipe.oversamplings))
    room = min(scene.spectrum.shape[-2], scene.width) // ratio - 2 * recipe.margin_px
    if room < recipe.patch_px:
        return np.empty((0, 2, recipe.patch_px, recipe.patch_px), np.float32), np.empty(4, np.float32)
    images, sensor = _acquire_pair(scene, recipe, ratio, generator)
    patches = cut(images, recipe.patch_px, generator)
    # A conditioned network learns that a sensor's axes changed places, and is told so; a plain one cannot.
    mirrors, quarters = sensor.symmetry
    quarter, mirrored = draw_turn(generator, quarters or recipe.family is not None, mirrors)
    vector = np.array(sensor_vector(sensor).values, np.float32)
    return turned(patches, quarter, mirrored), vector[[1, 0, 2, 3]] if quarter % 2 else vector


def _acquire_pair(
    scene: Visited, recipe: PatchRecipe, ratio: int, generator: np.random.Generator
) -> tuple[np.ndarray, Instrument]:
    """Degraded and reference, (2, H, W), and the sensor of the degraded one."""
    # Exposure is linear, so it scales the spectrum that is already there.
    spectrum = scene.spectrum * float(generator.uniform(*recipe.exposures))
    # One phase for both images of a pair: restoring must not shift anything.
    phase_y, phase_x = (float(v) for v in generator.uniform(-ratio / 2, ratio / 2, 2))
    draw = Draw(int(generator.integers(2**31)))
    images, sensors = list[np.ndarray](), list[Instrument]()
    for profile, role in ((recipe.family or recipe.degraded, "degraded"), (recipe.reference, "reference")):
        sensor = profile.draw(generator)
        dn = acquire(spectrum, scene.width, sensor, ratio, draw, role, (phase_y, phase_x), recipe.margin_px)
        images.append(dn / sensor.max_dn)
        sensors.append(sensor)
    return np.stack(images), sensors[0]


def cut(images: np.ndarray, patch_px: int, generator: np.random.Generator) -> np.ndarray:
    """Cut (C, H, W) into as many whole patches as fit, from a random corner: (N, C, P, P)."""
    height, width = images.shape[-2:]
    top, left = (int(generator.integers(size % patch_px + 1)) for size in (height, width))
    windows = sliding_window_view(images[:, top:, left:], (patch_px, patch_px), (1, 2))[:, ::patch_px, ::patch_px]
    return windows.transpose(1, 2, 0, 3, 4).reshape(-1, images.shape[0], patch_px, patch_px)


def turn(
    patches: np.ndarray, generator: np.random.Generator, quarters: bool = True, mirrors: bool = True
) -> np.ndarray:
    """Patches (..., P, P) in one of the square's eight symmetries, the same for all; see `draw_turn`."""
    return turned(patches, *draw_turn(generator, quarters, mirrors))


def draw_turn(generator: np.random.Generator, quarters: bool, mirrors: bool = True) -> tuple[int, bool]:
    """Quarter turns, and whether to mirror afterwards; an odd number of quarters makes columns of rows.

    A plain network learns one sensor. Where its two axes differ they must not change places, and `quarters` is False:
    four symmetries are left. Where its blur is lopsided it stays as it is, and `mirrors` is False.
    """
    quarter, mirrored = int(generator.integers(4)), bool(generator.integers(2))
    if not mirrors:
        return 0, False
    return quarter if quarters else quarter - quarter % 2, mirrored


def turned(patches: np.ndarray, quarter: int, mirrored: bool) -> np.ndarray:
    """Patches (..., P, P) turned by quarters, then mirrored."""
    rotated = np.rot90(patches, quarter, (-2, -1))
    return rotated[..., ::-1] if mirrored else rotated


RESCALE = "rescale it to the digital numbers of the sensor that made the pairs"

Files = tuple[Path, Path]
"""A degraded and a reference image."""


def pair_files(folder: Path) -> list[Files]:
    """The pairs FOLDER/degraded/NAME and FOLDER/reference/NAME, by name."""
    degraded, reference = ({p.stem: p for p in list_images(folder / role)} for role in ("degraded", "reference"))
    alone = sorted(degraded.keys() ^ reference.keys())
    if alone:
        expected, got = "each name in degraded/ and in reference/", f"{alone[0]!r} in one of them only"
        remedy = "complete the pairs; 'beers-deploy simulate' writes such folders"
        raise ImageError(str(folder), expected=expected, got=got, remedy=remedy)
    return [(path, reference[name]) for name, path in degraded.items()]


@dataclass(frozen=True)
class StoredPairs:
    """Endless batches of (degraded, reference) patches, (N, 1, P, P) in [0, 1]; the same for the same seed.

    `max_dn` is the largest digital number of the sensor that made the pairs. Patches may be turned by `quarters`
    unless its two axes differ, and they have `mirrors` unless its blur is lopsided.
    """

    files: Sequence[Files]
    patch_px: int
    max_dn: int
    batch: int
    seed: int
    rank: int = 0
    workers: int = 1
    quarters: bool = True
    mirrors: bool = True

    def batches(self, first: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Batch number `first` and all that follow: (degraded, reference), (N, 1, P, P) in [0, 1] each."""
        number = first
        while True:
            generator = Draw(self.seed, number * self.workers + self.rank).generator("stored")
            patches = np.stack([self._patch(generator) for _ in range(self.batch)]) / np.float32(self.max_dn)
            yield np.ascontiguousarray(patches[:, :1]), np.ascontiguousarray(patches[:, 1:])
            number += 1

    def _patch(self, generator: np.random.Generator) -> np.ndarray:
        """One patch (2, P, P) of a random pair."""
        files = self.files[int(generator.integers(len(self.files)))]
        images = [read_acquisition(file, remedy=RESCALE, max_dn=self.max_dn) for file in files]
        height, width = images[0].shape
        if images[0].shape != images[1].shape or min(height, width) < self.patch_px:
            expected = f"a mono pair of one size, {self.patch_px} pixels a side or more"
            got = " and ".join(f"{image.shape[1]} x {image.shape[0]} pixels" for image in images)
            remedy = "choose a smaller `patch`, or simulate larger patches"
            raise ImageError(str(files[0]), expected=expected, got=got, remedy=remedy)
        top, left = (int(generator.integers(size - self.patch_px + 1)) for size in (height, width))
        window = slice(top, top + self.patch_px), slice(left, left + self.patch_px)
        both = np.stack([image[window] for image in images])
        return np.asarray(turn(both, generator, self.quarters, self.mirrors))
