"""Calibration: what values each tensor takes, seen one piece of a patch at a time.

Patches are simulated anew for each pass over them, which costs a tenth of what the network does with them. So memory
grows neither with their number nor with their size.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
import torch

from model.simulator.acquire import acquire
from model.simulator.draws import Draw
from model.simulator.mtf import transfer_function
from model.simulator.sampling import scene_spectrum
from model.simulator.scene import Scene
from model.training.patches import PatchRecipe, turn
from profiles.sensor import Sensor, SensorProfile
from quant.float_file import float_model
from quant.graph import Graph, tensors
from quant.pieces import halo_of, tensor_values
from quant.planes import PLANES, POSITION
from quant.positions import CANDIDATES, coarsest_position, squared_errors
from quant.session import open_session
from quant.strata import Ground, View, draw_views

PATCH_PX = 128
DEGRADED = "degraded"
"""The role whose noise a patch carries: the same in a pair and alone."""

T = TypeVar("T")
Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Remade(Generic[T]):
    """A sequence whose items are made each time they are asked for: none is kept."""

    make: Callable[[int], T]
    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> T:
        if not 0 <= number < self.count:
            raise IndexError(number)
        return self.make(number)

    def __iter__(self) -> Iterator[T]:
        return map(self.make, range(self.count))


@dataclass(frozen=True)
class Patches:
    """Simulated patches, each (1, 1, P, P) float32 in [0, 1].

    Attributes:
        views: what each shows, and the sensors that saw it.
        pairs: (degraded, reference) of each.
        degraded: the same degraded patches alone, for half the work.
    """

    views: list[View]
    pairs: Remade[Pair]
    degraded: Remade[np.ndarray]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the bytes of all pairs."""
        digest = hashlib.sha256()
        for pair in self.pairs:
            for image in pair:
                digest.update(image.tobytes())
        return digest.hexdigest()


def draw_patches(
    scenes: list[Scene],
    degraded: SensorProfile,
    reference: SensorProfile,
    count: int,
    seed: int,
    patch_px: int = PATCH_PX,
) -> Patches:
    """Patches by sensor profile and seed, spread over the profile's ranges and over brightness: see `quant.strata`.

    Raises:
        ImageError: no scene holds a patch.
        ProfileError: the two profiles differ in gain, bits or offset.
    """
    recipe = PatchRecipe(degraded, reference, patch_px=patch_px)
    views = draw_views(scenes, recipe, count, Draw(seed).generator("views"))

    def pair(number: int) -> Pair:
        view = views[number]
        seen, meant = _simulate(
            view.ground, {DEGRADED: view.degraded, "reference": view.reference}, Draw(seed, number)
        )
        return seen, meant

    def alone(number: int) -> np.ndarray:
        return _simulate(views[number].ground, {DEGRADED: views[number].degraded}, Draw(seed, number))[0]

    return Patches(views, Remade(pair, count), Remade(alone, count))


def _simulate(ground: Ground, sensors: dict[str, Sensor], draw: Draw) -> list[np.ndarray]:
    """What each sensor, by its role, makes of the same ground: patches (1, 1, P, P)."""
    radiance = ground.radiance
    spectrum, width = scene_spectrum(radiance), radiance.shape[-1]
    images = [
        acquire(spectrum, width, sensor, ground.oversampling, draw, role) / sensor.max_dn
        for role, sensor in sensors.items()
    ]
    transfer_function.cache_clear()  # no two patches share one, and each is megabytes
    turned = turn(torch.stack(images)[:, None], draw.generator("turn"))
    return [np.ascontiguousarray(image[None]) for image in turned.numpy()]


def choose_positions(
    graph: Graph, images: Iterable[np.ndarray], tick: Callable[[], None], least_squares: bool = True
) -> dict[str, int]:
    """Least-squares position of every tensor of a plane-reading graph over images (1, 1, H, W) in [0, 1].

    Two passes, so images that can be passed over twice: the largest values, then the squared errors of the positions
    around them. `tick` is called once per
    image and pass. Without `least_squares` the positions are those that clip nothing.
    """
    names, halo_px = tensors(graph), halo_of(graph)
    session = open_session(float_model(graph, names))

    def values() -> Iterator[list[np.ndarray]]:
        for image in images:
            yield from tensor_values(session, names, image, halo_px)
            tick()

    largest = np.zeros(len(names))
    for results in values():
        largest = np.maximum(largest, [float(np.abs(r).max()) for r in results])
    first = [coarsest_position(m) for m in largest]
    errors = np.zeros((len(names), CANDIDATES))
    for results in values():
        errors += [_errors(r[0], f) for r, f in zip(results, first, strict=True)]
    moves = np.argmin(errors, axis=1) if least_squares else np.zeros(len(names), int)
    best = {name: f + int(move) for name, f, move in zip(names, first, moves, strict=True)}
    return {PLANES: POSITION, **best}


def _errors(tensor: np.ndarray, first: int) -> np.ndarray:
    """The squared errors of (C, H, W), a few channels at a time: within the cache it is three times faster."""
    parts = np.array_split(tensor, -(-len(tensor) // 4))
    return np.asarray(np.sum([squared_errors(part, first) for part in parts], axis=0))
