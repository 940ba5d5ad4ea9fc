"""Simulate training patches from whole scenes when they are needed, or cut them from stored pairs.

The spectrum of a scene is computed once. Each visit blurs, samples and folds it again with another
sensor, scale, phase and look. Visiting whole scenes yields many patches for one transform.
"""

import itertools
import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from beers_deploy.model.bank import Bank, network_bank
from beers_deploy.model.convbeers import Condition, vector_tensor
from beers_deploy.model.exposure import HEADROOM, factors_for
from beers_deploy.model.raster.images import image_size_px, read_acquisition
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.passes import (
    Pass,
    Visited,
    detected,
    folded_signals,
    noiseless,
    prepare,
)
from beers_deploy.model.training.patches import Files, PatchRecipe, draw_turn, turn
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor


class Batch(NamedTuple):
    """The patches of one training step.

    Attributes:
        degraded: the input of the network, (N, 1, P, P) in [0, 1] of full scale.
        reference: the result that the network should give, of the same shape.
        condition: the description of the sensor of each patch, turned as the patch is; None for a
            plain network.
    """

    degraded: Tensor
    reference: Tensor
    condition: Condition | None = None


Visit = tuple[Tensor, Condition | None]
"""The degraded and the reference image of each patch of one pass over a scene, (N, 2, P, P) in
[0, 1], and the description of the sensor of each; None without a family of sensors.
"""


class PatchSource:
    """A source of endless batches of simulated patches, which are the same for the same seed."""

    SHARD_BATCHES = 16
    """The number of batches that are shuffled together: enough scenes in one batch,
    little memory.
    """
    MOST_THREADS = 8
    """The maximum number of shards prepared in advance; each takes some tens of megabytes."""

    def __init__(
        self,
        scenes: list[Scene],
        recipe: PatchRecipe,
        batch: int,
        seed: int,
        rank: int = 0,
        workers: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        self.recipe = recipe
        self.batch = batch
        self.seed = seed
        self.rank = rank
        self.workers = workers
        common = int(np.lcm.reduce(recipe.oversamplings))
        self._scenes = [prepare(scene, common, device) for scene in scenes]
        self.unused = [
            scene.name
            for scene, visited in zip(scenes, self._scenes, strict=True)
            if _room_px(visited, recipe, min(recipe.oversamplings)) < recipe.patch_px
        ]

    def batches(self, first: int = 0) -> Iterator[Batch]:
        """Yield batch number `first` and all that follow, so that a resumed run continues where it
        stopped.

        The next shards are prepared while the present one is used, on half of the cores, because a
        GPU waits for patches.
        """
        number, within = divmod(first, self.SHARD_BATCHES)
        threads = min(max((os.cpu_count() or 1) // 2, 1), self.MOST_THREADS)
        # One core per thread: otherwise each would start as many threads as there are cores. A
        # thread that has not read its number before uses the last one that any thread has set, so
        # this one must read it first.
        torch.get_num_threads()
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as ahead:
            waiting = deque(ahead.submit(self._shard, number + k) for k in range(threads))
            while True:
                shard = waiting.popleft().result()
                number += 1
                waiting.append(ahead.submit(self._shard, number + threads - 1))
                for k in range(within, self.SHARD_BATCHES):
                    part = slice(k * self.batch, (k + 1) * self.batch)
                    condition = None if shard.condition is None else shard.condition.some(part)
                    yield Batch(shard.degraded[part], shard.reference[part], condition)
                within = 0

    def _shard(self, number: int) -> Batch:
        # Keyed by its number and not drawn in sequence: a resumed run makes the same shard.
        generator = Draw(self.seed, number * self.workers + self.rank).generator("shard")
        shard_size = self.batch * self.SHARD_BATCHES
        parts = list[Tensor]()
        conditions = list[Condition]()
        count = 0
        for _ in range(50 * shard_size):
            scene_visit = visit(
                self._scenes[generator.integers(len(self._scenes))], self.recipe, generator
            )
            if scene_visit is None:
                continue
            scene_patches, scene_condition = scene_visit
            parts.append(scene_patches)
            if scene_condition is not None:
                conditions.append(scene_condition)
            count += len(scene_patches)
            if count >= shard_size:
                break
        else:
            raise ImageError(
                "None of the training images is large enough for a patch of "
                f"{self.recipe.patch_px} target pixels. Give larger images or a smaller patch."
            )
        # Patches are mixed, because a batch of neighbours would have a gradient for one scene.
        places = torch.from_numpy(generator.permutation(count)[:shard_size])
        patches = torch.cat(parts)
        patches = patches[places.to(patches.device)]
        condition = None
        if conditions:
            columns = zip(*conditions, strict=True)
            condition = Condition(*(torch.cat(column)[places] for column in columns))
        return Batch(patches[:, :1].contiguous(), patches[:, 1:].contiguous(), condition)


def visit(scene: Visited, recipe: PatchRecipe, generator: np.random.Generator) -> Visit | None:
    """Simulate one pass over a scene and return all its patches, or None if none fits."""
    ratio = int(generator.choice(recipe.oversamplings))
    if _room_px(scene, recipe, ratio) < recipe.patch_px:
        return None
    look = recipe.looks.draw(generator)
    phase_y, phase_x = (float(v) for v in generator.uniform(-ratio / 2, ratio / 2, 2))
    sensor = (recipe.family or recipe.degraded).draw(generator)
    target = recipe.reference.draw(generator)
    passage = Pass(ratio, (phase_y, phase_x), look, recipe.margin_px)
    signals = folded_signals(scene, (sensor, target), passage)
    degraded = detected(signals[0], sensor, "degraded", generator)
    if recipe.noisy_reference:
        reference = detected(signals[1], target, "reference", generator)
    else:
        reference = noiseless(signals[1], target)
    patches = cut(torch.stack([degraded, reference]), recipe.patch_px, generator)
    # A conditioned network is given the swapped axes of a sensor; a plain one cannot learn them.
    mirrors, quarters = sensor.symmetry
    quarter, mirrored = draw_turn(generator, quarters or recipe.family is not None, mirrors)
    if recipe.family is None:
        return turned(patches, quarter, mirrored), None
    return _conditioned(turned(patches, quarter, mirrored), sensor, quarter, mirrored)


def _room_px(scene: Visited, recipe: PatchRecipe, ratio: int) -> int:
    """Return the side within the margins of an image of a scene, in pixels."""
    return min(scene.sides) // ratio - 2 * recipe.margin_px


def _conditioned(patches: Tensor, sensor: Instrument, quarter: int, mirrored: bool) -> Visit:
    """Brighten dark patches (N, 2, P, P) as a restoration does, and add the description of their
    sensors.
    """
    factors = np.ones(len(patches), np.int64)
    brightest = patches[:, 0].amax((1, 2)).cpu().numpy()
    for factor in factors_for(sensor):
        factors[brightest * factor <= HEADROOM] = factor
    distinct, places = np.unique(factors, return_inverse=True)
    vectors = []
    banks = []
    for factor in distinct.tolist():
        brighter = replace(sensor, gain_dn_per_radiance=sensor.gain_dn_per_radiance * factor)
        vector = vector_tensor(brighter)
        # A quarter turn swaps the axes, whose MTFs are the first two values.
        vectors.append(vector[[1, 0, 2, 3]] if quarter % 2 else vector)
        bank = network_bank(brighter)
        details = turned(torch.from_numpy(bank.details), quarter, mirrored)
        banks.append(Bank(details.numpy(), bank.sigma))
    condition = Condition.of(torch.stack(vectors), banks)
    scale = torch.from_numpy(factors).to(patches)[:, None, None, None]
    return patches * scale, condition.some(torch.from_numpy(places))


def cut(images: Tensor, patch_px: int, generator: np.random.Generator) -> Tensor:
    """Cut (C, H, W) into the largest number of whole patches, from a random corner:
    (N, C, P, P).
    """
    top, left = (int(generator.integers(size % patch_px + 1)) for size in images.shape[-2:])
    windows = images[:, top:, left:].unfold(1, patch_px, patch_px).unfold(2, patch_px, patch_px)
    return windows.permute(1, 2, 0, 3, 4).reshape(-1, len(images), patch_px, patch_px)


def turned(patches: Tensor, quarter: int, mirrored: bool) -> Tensor:
    """Rotate patches (..., P, P) by quarter turns, then mirror them."""
    rotated = torch.rot90(patches, quarter, (-2, -1))
    return rotated.flip(-1) if mirrored else rotated


RESCALE = "Rescale it to the digital numbers of the sensor that made the pairs."


@dataclass(frozen=True)
class StoredPairs:
    """Endless batches of (degraded, reference) patches, (N, 1, P, P) in [0, 1]; the same for the
    same seed.

    `sensor` made the pairs.
    """

    files: Sequence[Files]
    sensor: Sensor
    patch_px: int
    batch: int
    seed: int
    rank: int = 0
    workers: int = 1

    def __post_init__(self) -> None:
        # A step may come late at a pair, so all headers are read before the first one.
        for files in self.files:
            degraded, reference = map(image_size_px, files)
            if degraded != reference or min(degraded) < self.patch_px:
                px = " and ".join(f"{w} x {h} pixels" for h, w in (degraded, reference))
                raise ImageError(
                    f"{files[0]} and its reference must be mono images of one size, "
                    f"{self.patch_px} pixels a side or more, but they have {px}. Choose a "
                    "smaller `patch`, or simulate larger patches."
                )

    @property
    def symmetry(self) -> tuple[bool, bool]:
        """Two flags: whether patches may be mirrored, and whether turned by 90 degrees."""
        mirrors, quarters = self.sensor.nominal().symmetry
        # Axes that are drawn from two ranges differ, even where the middles of the ranges agree.
        drawn_apart = self.sensor.mtf_nyquist_along is not None and self.sensor.response is None
        return mirrors, quarters and not drawn_apart

    def batches(self, first: int = 0) -> Iterator[Batch]:
        """Yield batch number `first` and all that follow."""
        max_dn = self.sensor.nominal().max_dn
        mirrors, quarters = self.symmetry
        for number in itertools.count(first):
            # Keyed by the batch's number and not drawn in sequence: a resumed run draws the same.
            generator = Draw(self.seed, number * self.workers + self.rank).generator("stored")
            pairs = []
            for _ in range(self.batch):
                # One patch (2, P, P) at a random place of a random pair.
                files = self.files[int(generator.integers(len(self.files)))]
                images = [read_acquisition(file, remedy=RESCALE, max_dn=max_dn) for file in files]
                top, left = (
                    int(generator.integers(px - self.patch_px + 1)) for px in images[0].shape
                )
                window = slice(top, top + self.patch_px), slice(left, left + self.patch_px)
                both = np.stack([np.float32(image[window]) for image in images])
                turned = turn(both, generator, quarters, mirrors)
                pairs.append(torch.from_numpy(np.ascontiguousarray(turned)))
            patches = torch.stack(pairs) / max_dn
            yield Batch(patches[:, :1].contiguous(), patches[:, 1:].contiguous())
