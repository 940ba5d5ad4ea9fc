"""Pairs of a degraded and a reference image: simulated from scenes, or read from a folder that `simulate` wrote."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from deploy.restore import read_acquisition
from model.images import site_of
from model.simulator.acquire import MARGIN_PX, fitting_oversampling, simulate_pair
from model.simulator.draws import Draw
from model.simulator.scene import Scene
from model.training.stored_pairs import pair_files
from profiles.errors import ImageError
from profiles.sensor import Sensor

OVERSAMPLINGS = (4, 2)
MIN_SIDE_PX = 48


class Eye(Protocol):
    """What gives a sensor for each scene: a profile, or always the same one."""

    def draw(self, generator: np.random.Generator, /) -> Sensor:
        """One sensor."""
        ...


@dataclass(frozen=True)
class NamedPair:
    """Two acquisitions of one scene, (H, W) float32 digital numbers of 0..4095, and the scene's name."""

    name: str
    degraded: np.ndarray
    reference: np.ndarray

    @property
    def site(self) -> str:
        """The name without what tells frames of one site apart."""
        return site_of(self.name)


def simulate_pairs(
    scenes: list[Scene], degraded: Eye, reference: Eye, seed: int
) -> tuple[list[NamedPair], list[str]]:
    """Simulate a pair of each scene, at the larger oversampling that leaves enough of it.

    Returns:
        The pairs, and the names of scenes too small to use.

    Raises:
        ImageError: all are too small.
    """
    pairs, small = [], []
    for number, scene in enumerate(scenes):
        ratio = fitting_oversampling(scene.radiance, OVERSAMPLINGS, MIN_SIDE_PX)
        if ratio is None:
            small.append(scene.name)
            continue
        draw = Draw(seed, number)
        eyes = [profile.draw(draw.generator("sensor")) for profile in (degraded, reference)]
        pair = simulate_pair(scene.radiance, eyes[0], eyes[1], ratio, draw)
        pairs.append(NamedPair(scene.name, pair.degraded.numpy(), pair.reference.numpy()))
    if not pairs:
        least = OVERSAMPLINGS[-1] * (2 * MARGIN_PX + MIN_SIDE_PX)
        raise ImageError(
            "images",
            expected=f"scenes of {least} pixels a side or more",
            got=f"{len(small)} smaller ones",
            remedy="give larger images",
        )
    return pairs, small


def read_pairs(folder: Path) -> list[NamedPair]:
    """Read FOLDER/degraded/NAME.tif beside FOLDER/reference/NAME.tif, mono images of at most 12 bits.

    Raises:
        ImageError: a folder is missing, a name has no partner, or two images differ in size.
    """
    return list(_read_pairs(folder))


def _read_pairs(folder: Path) -> Iterator[NamedPair]:
    for degraded, reference in pair_files(folder):
        pair = NamedPair(degraded.stem, read_acquisition(degraded), read_acquisition(reference))
        if pair.degraded.shape != pair.reference.shape:
            sizes = " and ".join(f"{a.shape[1]} x {a.shape[0]}" for a in (pair.degraded, pair.reference))
            raise ImageError(
                f"pair {pair.name}", expected="two images of one size", got=sizes, remedy="crop them alike"
            )
        yield pair
