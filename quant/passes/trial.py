"""Measure what a candidate costs: how far INT8 results lie from float ones on a few crops.

1. Restore all crops of the calibration images in float, and order them by their largest correction.
2. Keep the crops with the largest corrections, where int8 clips, and others of all sizes.
3. Run each candidate on these crops, and return its error on each.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import onnx

from beers_deploy.quant.graph import CORRECTION, Graph, graph_to_onnx
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.session import (
    TILE_PX,
    crops,
    halo_of,
    open_session,
    result_of,
    tensor_values,
)

SEARCH_CROPS = 16
"""What equalization is searched on, a quarter of them with the strongest edges: there int8 clips.
Small crops say less each, so more of them are taken.
"""
MOST_CROPS = 64
LEAST_CHANGE = 1e-4
"""Of full scale, added to what a network changes in a crop: a crop that it leaves as it is must not
decide alone.
"""

Costs = Callable[[np.ndarray | None], np.ndarray]
"""The cost of one graph in INT8 on the crops of given numbers, or on all of them: an error each."""
Trial = Callable[[Graph], Costs]
Targets = list[tuple[np.ndarray, np.ndarray]]
"""Degraded crops (1, C, h, w) and their float results, clipped to [0, 1]."""


def search_targets(graph: Graph, host_part: HostPart, images: Sequence[np.ndarray]) -> Targets:
    """Return the crops with the largest corrections, and others of all sizes.

    Only the sizes of corrections are stored; the images of the chosen are simulated once more.
    """
    session = open_session(graph_to_onnx(graph, [CORRECTION], host_part.planes))
    halo_px = 0 if halo_of(graph) is not None else None

    def restored(crop: np.ndarray) -> np.ndarray:
        (correction,) = next(tensor_values(session, [CORRECTION], crop, halo_px, host_part))
        return host_part.finish(crop, correction)

    def size(crop: np.ndarray) -> float:
        result = restored(crop)
        return float(np.abs(result - crop if result.shape == crop.shape else result).max())

    # 1.
    sizes = {}
    for k, image in enumerate(images):
        for n, crop in enumerate(crops(image, halo_px)):
            sizes[k, n] = size(crop)
    order = sorted(sizes, key=lambda place: sizes[place], reverse=True)
    height, width = map(int, crops(images[0], halo_px)[0].shape[2:])
    count = min(max(SEARCH_CROPS * TILE_PX**2 // (height * width), SEARCH_CROPS), MOST_CROPS)
    # 2. int8 clips the largest corrections, so a quarter of the crops are those that hold them.
    hard = count // 4
    others = order[hard :: max((len(order) - hard) // (count - hard), 1)]
    places = (*order[:hard], *others[: count - hard])
    # A copy, because a view would keep the whole image in memory.
    selection = [crops(images[k], halo_px)[n].copy() for k, n in places]
    return [(crop, restored(crop)) for crop in selection]


def crop_costs(model: onnx.ModelProto, targets: Targets) -> Costs:
    """Return a function for the root mean squared difference of an integer network from the float
    one, by crop.

    Squared, because clipping is rare and must count; its root, so that no single crop that clips
    decides alone. It is relative to what the float network changes in the crop: a loss of PSNR is
    relative too, and in absolute terms bright crops with large corrections would outweigh the dark
    ones, where the same step costs most.
    """
    # 3.
    session = open_session(model, threads=1)

    def cost(number: int) -> float:
        image, target = targets[number]
        return rms(result_of(session, image) - target) / changes[number]

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.square(values, dtype=np.float64).mean()))

    # Without an image of the result's size there is no change to compare with.
    same_size = all(image.shape == target.shape for image, target in targets)
    changes = [
        rms(target - image) + LEAST_CHANGE if same_size else 1.0 for image, target in targets
    ]

    def of(crops: np.ndarray | None) -> np.ndarray:
        # Small crops keep cores busier one to each than all on one: threads that share a crop wait
        # for each other.
        with ThreadPoolExecutor(os.cpu_count()) as cores:
            return np.array(list(cores.map(cost, range(len(targets)) if crops is None else crops)))

    return of
