"""Tile plans on a hard case: whatever they are, no bit of the result may depend on them."""

import numpy as np

from deploy.stress.cases import Case
from deploy.stress.checks import Measure, differing, refused
from deploy.stress.subject import Network, Subject

CORES_PX = (16, 29)
"""What a tile keeps beside its two halos."""
LARGE_CORE_PX = 250


def plans(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """Both networks, on several plans against the whole image; of unsound pixels every plan is refused."""
    networks = [network for network in (subject.float32, subject.int8) if network is not None]
    names = ("float32 plans differ", "INT8 plans differ")
    return [
        measure
        for network, name in zip(networks, names, strict=False)
        for measure in _one(network, name, case, image)
    ]


def _one(network: Network, name: str, case: Case, image: np.ndarray) -> list[Measure]:
    cores = (LARGE_CORE_PX,) if case.large else CORES_PX
    tiles = [2 * network.radius_px + core for core in cores]
    if case.pixels in ("infinite", "beyond"):
        return [refused(lambda tile=tile: network.restore(image, tile_px=tile)) for tile in tiles]  # type: ignore[misc]
    whole = network.restore(image)
    return [differing(name, network.restore(image, tile_px=tile), whole) for tile in tiles]
