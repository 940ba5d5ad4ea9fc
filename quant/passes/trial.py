"""Measure the cost of a candidate: the difference of INT8 results from float ones on a few crops.

1. Restore all crops of the calibration images in float, and order them by their largest correction.
2. Keep the crops with the largest corrections, where int8 clips, and others of all sizes.
3. Add some of them as bright as the sensor reads, if requested, because int8 must hold such ground
   even if no calibration image shows it.
4. Run each candidate on these crops, and return its error on each.
"""

import os
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np

from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings.host import live_tensors, part_model
from beers_deploy.quant.graph import CORRECTION, PLANES, Graph, graph_to_onnx, tensors
from beers_deploy.quant.host_part import ZERO, HostPart
from beers_deploy.quant.input_range import Ranges
from beers_deploy.quant.passes.effort import span
from beers_deploy.quant.session import (
    TILE_PX,
    crops,
    halo_of,
    open_session,
    tensor_values,
)

T = TypeVar("T")

SEARCH_CROPS = 16
"""The number of crops on which equalisation is searched. A quarter of them has the strongest edges,
where int8 clips. Small crops contain less information, so more of them are used.
"""
MOST_CROPS = 64
BRIGHT = 6
"""One of this number of images, and of their crops, is used once more, brightened to full scale."""
WEIGHT_OF_BRIGHT = 1 / 3
"""Of 1/4, 1/3, 1/2 and 1, 1/3 lost least in the mean of ten small networks on training places: 0.02
dB more than without bright crops, which lost 2 to 5 dB on brighter ground than calibration had.
"""
LEAST_CHANGE = 1e-4
"""Share of full scale that is added to the change that a network makes in a crop. Otherwise a crop
that it leaves unchanged would decide alone.
"""

Costs = Callable[[np.ndarray | None], np.ndarray]
"""A function that returns the error of one graph in INT8 on each of the crops with the given
numbers, or on all of them.
"""
Trial = Callable[[Graph], Costs]
Trials = Callable[[Graph, Collection[str]], Trial]
"""A function that returns a trial of candidates that differ from a graph only where these tensors
are written and read.
"""
Values = dict[str, np.ndarray]
"""Tensors (1, C, h, w) uint8 of an integer core, by name."""


class Target(NamedTuple):
    """A crop on which candidates are compared.

    Attributes:
        image: the degraded crop, (1, C, h, w).
        result: the float network's result, clipped to [0, 1].
        weight: the weight of the candidate's error.
    """

    image: np.ndarray
    result: np.ndarray
    weight: float


def crop_count(crop: np.ndarray, available: int) -> int:
    """Return the number of crops on which a search measures candidates: more if the crops are
    small.

    Args:
        crop: one of the crops, (1, C, h, w), whose size counts.
        available: the approximate number of crops; images of other sizes than the first may have
            more.
    """
    height, width = map(int, crop.shape[2:])
    count = max(SEARCH_CROPS * TILE_PX**2 // (height * width), SEARCH_CROPS)
    return min(count, MOST_CROPS, max(available, SEARCH_CROPS))


def search_targets(
    graph: Graph,
    host_part: HostPart,
    images: Sequence[np.ndarray],
    count: int,
    brightens: bool,
) -> list[Target]:
    """Choose crops of the images for a search, and restore them in float.

    A quarter of the crops are those with the largest corrections, where int8 clips. The others have
    corrections of all sizes. Images of the selected crops are simulated again, because only the
    sizes of corrections are stored.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.
        host_part: the host's pre- and post-processing around the graph.
        images: calibration images (1, C, H, W).
        count: the number of crops; fewer are returned if there are not enough.
        brightens: True to add some of the crops once more, brightened to full scale.

    Returns:
        The crops with their float results.
    """
    session = open_session(graph_to_onnx(graph, [CORRECTION], host_part.planes))
    halo_px = halo_of(graph)

    def restored(crop: np.ndarray) -> np.ndarray:
        (correction,) = next(tensor_values(session, [CORRECTION], crop, halo_px, host_part))
        return host_part.finish(crop, correction)

    def size(crop: np.ndarray) -> float:
        result = restored(crop)
        base = host_part.base(crop) if host_part.adds_image else crop
        return float(np.abs(result - base if result.shape == base.shape else result).max())

    # 1.
    sizes = {}
    for k, image in enumerate(images):
        for n, crop in enumerate(crops(image, halo_px)):
            sizes[k, n] = size(crop)
    order = sorted(sizes, key=lambda place: sizes[place], reverse=True)
    # 2.
    places = hardest_and_others(order, count)
    # A copy, because a view would keep the whole image in memory.
    selection = [crops(images[k], halo_px)[n].copy() for k, n in places]
    targets = [Target(crop, restored(crop), 1.0) for crop in selection]
    # 3.
    if brightens:
        # Those with the largest corrections already have the brightest edges.
        for crop in selection[count // 4 :: BRIGHT]:
            bright = brightened(crop, host_part.input_ranges)
            targets.append(Target(bright, restored(bright), WEIGHT_OF_BRIGHT))
    return targets


def brightened(crop: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return a crop of the same ground under a sensor that it nearly saturates: each channel's
    largest value lies at the end of its range.

    Args:
        crop: (1, C, h, w) as the network reads it. Constant channels, such as maps of a noise
            level, are not changed.
        ranges: the range of each channel; empty if all are in [0, 1].
    """
    largest = crop.max((2, 3), keepdims=True)
    ends = np.array([high for _, high in ranges] or [1.0], np.float32)
    varies = largest > crop.min((2, 3), keepdims=True)
    return np.asarray(crop + varies * (ends[:, None, None] - largest), np.float32)


def hardest_and_others(order: Sequence[T], count: int) -> list[T]:
    """Select the first quarter of `count` items from the beginning of a sequence, and spread the
    rest over it.

    Args:
        order: items, sorted from the largest value (the hardest crop) to the smallest.
        count: the number of items; fewer are returned if there are not enough.
    """
    hard = count // 4
    others = order[hard :: max((len(order) - hard) // (count - hard), 1)]
    return [*order[:hard], *others[: count - hard]]


class CropTrials:
    """Measures the error of candidate networks in INT8 on crops, and runs only the changed
    operations again.

    The results in front of the first changed operation are computed once. The operations behind the
    last one stay open in one session.
    """

    def __init__(self, core_of: Callable[[Graph], IntCore], targets: Sequence[Target]) -> None:
        """Prepare trials.

        Args:
            core_of: rounds a candidate, which is a float graph, to an integer core.
            targets: the crops on which INT8 results are compared with float ones.
        """
        self.core_of = core_of
        self.targets = targets
        # Without an image of the result's size there is no change to compare with.
        same_size = all(target.image.shape == target.result.shape for target in targets)
        self.changes = [
            _rms(target.result - target.image) + LEAST_CHANGE if same_size else 1.0
            for target in targets
        ]

    def __call__(self, graph: Graph, names: Collection[str]) -> Trial:
        """Return a function that measures candidates which differ from a graph in the scaling of
        some tensors.

        Args:
            graph: the float graph that candidates are derived from.
            names: the tensors at which they differ: only operations that write or read these are
                changed.

        Returns:
            A function of a candidate. It returns a function of crop numbers (None for all), which
            returns the error on each of these crops: root mean squared difference from the float
            result, relative to the change that the float network makes.
        """
        start, stop = span(graph, names)
        core = self.core_of(graph)
        encode = core.host_part.encode
        images = [
            {PLANES: (encode(target.image).astype(np.int16) + ZERO).astype(np.uint8)}
            for target in self.targets
        ]
        front = _Part(core, 0, start)
        values = _on_all_cores(lambda number: front(images[number]), range(len(images)))
        behind = _Part(core, stop, len(core.ops))
        within = {op.output for op in core.ops[start:stop]} - {*live_tensors(core, stop)}

        def trial(candidate: Graph) -> Costs:
            rounded = self.core_of(candidate)
            # Convolutions that were not rounded again are the same objects. If one scale has to
            # change, others may follow, also far from the change.
            same = [a is b for a, b in zip(core.ops, rounded.ops, strict=True)]
            moved = {name for name, _ in core.frac_bits.items() ^ rounded.frac_bits.items()}
            if all(same[:start]) and all(same[stop:]) and moved <= within:
                return self._costs([_Part(rounded, start, stop), behind], values, rounded)
            return self._costs([_Part(rounded, 0, len(rounded.ops))], images, rounded)

        return trial

    def error(self, graph: Graph) -> float:
        """Return the sum of a graph's errors in INT8 on all crops."""
        return float(self(graph, tensors(graph))(graph)(None).sum())

    def _costs(self, parts: "list[_Part]", values: list[Values], core: IntCore) -> Costs:
        """Return a function for the root mean squared difference of an integer network from the
        float one, by crop.

        The difference is squared because clipping is rare and must count. Its root prevents a
        single crop that clips from deciding alone. It is relative to the change that the float
        network makes in the crop, as a loss of PSNR is. In absolute terms bright crops with large
        corrections would outweigh the dark ones, where the same step costs most.
        """

        # 4.
        def cost(number: int) -> float:
            target = self.targets[number]
            outputs = values[number]
            for part in parts:
                outputs = part(outputs)
            result = (outputs[CORRECTION] - np.float32(ZERO)) * np.float32(core.scale(CORRECTION))
            restored = core.host_part.restore(target.image, result, core.scale(CORRECTION))
            return target.weight * _rms(restored - target.result) / self.changes[number]

        everything = np.arange(len(self.targets))
        return lambda crops: np.array(_on_all_cores(cost, everything if crops is None else crops))


class _Part:
    """Operations `start` to `stop` of a core, on uint8 tensors."""

    def __init__(self, core: IntCore, start: int, stop: int) -> None:
        self.passed_on = live_tensors(core, stop)
        self.session = open_session(part_model(core, start, stop), 1) if start < stop else None

    def __call__(self, values: Values) -> Values:
        """Return the tensors that are read behind the part."""
        if self.session is None:
            return values
        feeds = {each.name: values[each.name] for each in self.session.get_inputs()}
        names = [each.name for each in self.session.get_outputs()]
        results = values | dict(zip(names, self.session.run(names, feeds), strict=True))
        return {name: results[name] for name in self.passed_on}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values, dtype=np.float64).mean()))


def _on_all_cores(compute: Callable[[int], T], numbers: Iterable[int]) -> list[T]:
    """Compute a function for each crop, with the crops distributed over the cores.

    For small crops one core per crop is faster than all cores on one crop, because threads that
    share a crop wait for each other.
    """
    with ThreadPoolExecutor(os.cpu_count()) as cores:
        return list(cores.map(compute, numbers))
