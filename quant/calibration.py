"""Calibration: what values each tensor takes, seen one patch at a time, so that memory does not grow with patches."""

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from model.simulator.scene import Scene
from model.training.patches import PatchRecipe, PatchSource
from profiles.sensor import SensorProfile
from quant.float_file import float_model
from quant.graph import Graph, tensors
from quant.planes import PLANES, POSITION, split
from quant.positions import CANDIDATES, coarsest_position, squared_errors
from quant.session import open_session

PATCH_PX = 128
REFERENCE = "pleiades-reference"


@dataclass(frozen=True)
class Patches:
    """Pairs of (degraded, reference), each (1, 1, P, P) float32 in [0, 1], and the digest of their bytes."""

    pairs: tuple[tuple[np.ndarray, np.ndarray], ...]
    digest: str


def draw_patches(
    scenes: list[Scene], degraded: SensorProfile, reference: SensorProfile, count: int, seed: int
) -> Patches:
    """Simulate patches by sensor profile and seed, over the profile's ranges, scales and exposures."""
    source = PatchSource(scenes, PatchRecipe(degraded, reference, patch_px=PATCH_PX), batch=1, seed=seed)
    pairs = tuple((d.numpy(), r.numpy()) for (d, r), _ in zip(source.batches(), range(count), strict=False))
    digest = hashlib.sha256()
    for pair in pairs:
        for image in pair:
            digest.update(image.tobytes())
    return Patches(pairs, digest.hexdigest())


def choose_positions(
    graph: Graph, images: Iterable[np.ndarray], tick: Callable[[], None], least_squares: bool = True
) -> dict[str, int]:
    """Least-squares position of every tensor of a plane-reading graph over images (1, 1, H, W) in [0, 1].

    Two passes: the largest values, then the squared errors of the positions around them. `tick` is called once per
    image and pass. Without `least_squares` the positions are those that clip nothing.
    """
    images = list(images)
    names = tensors(graph)
    session = open_session(float_model(graph, names))

    def passes() -> Iterable[list[np.ndarray]]:
        for image in images:
            yield session.run(names, {PLANES: split(image).astype(np.float32) * np.float32(2.0**-POSITION)})
            tick()

    largest = np.zeros(len(names))
    for results in passes():
        largest = np.maximum(largest, [float(np.abs(r).max()) for r in results])
    first = [coarsest_position(m) for m in largest]
    errors = np.zeros((len(names), CANDIDATES))
    for results in passes():
        errors += [squared_errors(r, f) for r, f in zip(results, first, strict=True)]
    moves = np.argmin(errors, axis=1) if least_squares else np.zeros(len(names), int)
    best = {name: f + int(move) for name, f, move in zip(names, first, moves, strict=True)}
    return {PLANES: POSITION, **best}
