"""Static INT8 in one call: float ONNX and calibration patches in, the integer core and its file for
the host out.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import onnx

from beers_deploy.model.progress import step
from beers_deploy.quant.core import (
    CANDIDATES,
    SHIFTS,
    IntCore,
    Shifts,
    build_core,
    squared_errors,
    unclipped_frac_bits,
)
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    PLANES_FRAC_BITS,
    Conv,
    Graph,
    channels_of,
    graph_to_onnx,
    read_network,
    read_planes,
    tensors,
    tied,
)
from beers_deploy.quant.host_part import ONE_CHANNEL, DualRange, HostPart, OffsetWindows, Plain
from beers_deploy.quant.onnx_file import fixed_tile_px, metadata
from beers_deploy.quant.passes.equalise import (
    FULL,
    LEVELLING,
    Costs,
    Trial,
    channel_ranges,
    equalise,
    first_guess,
    search,
)
from beers_deploy.quant.passes.level import Chain, chain_ranges, largest_values, level
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.passes.stream import (
    MAX_CHANNELS,
    STREAM_FRAC_BITS,
    Stream,
    exceeds_six,
    in_copies,
    lone_tensors,
    streams,
    takes_gains,
    window_offsets,
)
from beers_deploy.quant.sample_range import KEY as CALIBRATION_RANGE
from beers_deploy.quant.sample_range import range_of
from beers_deploy.quant.samples import Patches, Remade
from beers_deploy.quant.session import (
    TILE_PX,
    crops,
    halo_of,
    open_session,
    result_of,
    tensor_values,
    values_of,
)

if TYPE_CHECKING:
    from beers_deploy.quant.passes.tune import Tuning

SEARCH_CROPS = 16
"""What the equalisation is searched on, a quarter of them with the strongest edges: there int8
clips. Small crops say less each, so more of them are taken.
"""
MOST_CROPS = 64
LEAST_CHANGE = 1e-4
"""Of full scale, added to what a network changes in a crop: a crop that it leaves as it is must not
decide alone.
"""

PASSES = "fine_planes, least_squares, shared_residual_scale, equalise, dual_gain"
"""What a file says was done beyond rounding each tensor: see `quant.passes`, `quant.graph` and
`quant.core`.
"""


@dataclass(frozen=True)
class Quantised:
    """One network in whole numbers, also as the host's file; `graph` is the float one that was
    rounded.
    """

    host: onnx.ModelProto
    core: IntCore
    graph: Graph


@dataclass(frozen=True)
class Plan:
    """What is to be quantised: the graph that reads the planes; the host's part; streams.

    `chain` is what is levelled besides the streams, or where there are none.
    """

    graph: Graph
    host_part: HostPart
    streams: list[Stream]
    chain: Chain
    shifts: Shifts
    passes: Passes = ALL

    def with_windows(self, frac_bits: int, images: Iterable[np.ndarray]) -> "Plan":
        """The result in windows over all that it is in float, finer by GAIN than its own scale of
        so many bits.

        Itself where something is added to the result, or no convolution writes it, or one of too
        many channels.
        """
        alone = self.host_part.decoding.copies == 1 and not self.host_part.adds_image
        finer = self.passes.dual_range and takes_gains(self.graph)
        # One convolution of the DPU has to write the coarse copy and a window at the least.
        if not (alone and finer and self.host_part.outputs <= MAX_CHANNELS // 2):
            return self
        low = np.array(np.inf)
        high = np.array(-np.inf)
        for (result,) in values_of(self.graph, [CORRECTION], images, self.host_part):
            low = np.minimum(low, result[0].min((1, 2)))
            high = np.maximum(high, result[0].max((1, 2)))
        offsets = window_offsets(low, high, 2.0 ** -(frac_bits + OffsetWindows.finer_bits))
        windows = tuple(tuple(float(offset) for offset in window) for window in offsets)
        return replace(self, host_part=replace(self.host_part, decoding=OffsetWindows(windows)))

    def without_large_sums(self, frac_bits: Mapping[str, int]) -> "Plan":
        """Without the streams in which sums exceed a ReLU6's six, where int8 could not end for
        both.
        """
        within = [
            stream for stream in self.streams if not exceeds_six(self.graph, stream, frac_bits)
        ]
        if len(within) == len(self.streams):
            return self
        return replace(self, streams=within, chain=_chain(self.graph, self.host_part, within))

    def ended(self, graph: Graph) -> Graph:
        """The graph with windows or two gains where the result has them."""
        return in_copies(graph, self.host_part.decoding)

    def core(self, final: Graph, frac_bits: Mapping[str, int]) -> IntCore:
        """The integer core of a graph, ended, whose tensors have these least-squares scales."""
        shared = [*chain.from_iterable(self.streams), *self.chain.tensors]
        scales = {**frac_bits, **dict.fromkeys(shared, STREAM_FRAC_BITS)}
        # A coarse copy holds what a finer scale clips.
        scales[CORRECTION] += self.host_part.decoding.finer_bits
        assert set(tensors(final)) <= set(scales)  # noqa: S101
        return build_core(final, scales, self.shifts, self.host_part)


def _chain(graph: Graph, host_part: HostPart, streams: list[Stream]) -> Chain:
    """What is levelled besides these streams: nothing where there are some, and no depthwise
    convolutions.
    """
    widths = channels_of(graph, {PLANES: host_part.planes})
    depthwise = any(isinstance(op, Conv) and op.groups > 1 for op in graph)
    # Beside a stream, levelling made no dense network for one sensor better: see `passes.level`.
    alone = lone_tensors(graph) if depthwise or not streams else []
    return Chain(tuple(alone), tuple(widths[name] for name in alone))


def quantize_model(
    model: onnx.ModelProto,
    patches: Patches,
    about: dict[str, str],
    shifts: Shifts = SHIFTS,
    tuning: "Tuning | None" = None,
    passes: Passes = ALL,
) -> Quantised:
    """Quantise a float network under the DPU's rules: int8, symmetric, per tensor, power-of-two
    scales.

    The global add, where there is one, stays on the host, in 12 bits: only the correction is
    computed in int8.

    Args:
        model: the float network.
        patches: that it is calibrated on.
        about: metadata of the files.
        shifts: the windows of the target.
        tuning: on what, how long and how fast the whole numbers are trained at last; None leaves
            them.
        passes: that reduce the error.

    Raises:
        ModelError: an operation that the DPU does not compute, or weights of no sensible size.
    """
    network = read_network(model)
    graph = read_planes(network.graph)
    finer = passes.dual_range and network.adds_image and takes_gains(graph)
    host_part = HostPart.of(network, DualRange() if finer else Plain())
    equalised = streams(graph)
    plan = Plan(graph, host_part, equalised, _chain(graph, host_part, equalised), shifts, passes)
    core, final = rounded(plan, patches.degraded)
    if tuning:
        # Imported here because it needs torch, which no other step does.
        from beers_deploy.quant.passes.tune import tune

        core, steps = tune(core, graph, tuning)
    about = {
        **metadata(model),
        "precision": "int8 legal",
        "calibration_sha256": patches.digest,
        CALIBRATION_RANGE: range_of(patches.degraded).to_words(),
        **about,
    }
    about["passes"] = PASSES
    if tuning:
        about["finetune"] = f"{steps} steps on {len(tuning.pairs)} patches"
    return Quantised(host_model(core, about, fixed_tile_px(model)), core, final)


def choose_frac_bits(
    graph: Graph,
    images: Iterable[np.ndarray],
    host_part: HostPart = ONE_CHANNEL,
    least_squares: bool = True,
) -> dict[str, int]:
    """Least-squares scale of every tensor of a plane-reading graph over images (1, C, H, W) in [0,
    1].

    Tensors that must share a scale (`quant.graph.tied`) get that of least error in all of them
    together.

    Two passes, so images that can be passed over twice: the largest values, then the squared errors
    of the scales around them. Without `least_squares` the scales of the first pass stay, in which
    nothing is clipped.
    """
    names = tensors(graph)
    shared = tied(graph)
    # The planes' scale is fixed; -1 stands for the group of what is tied to them.
    groups = np.array(
        [names.index(shared[name]) if shared[name] in names else -1 for name in names]
    )

    def together(of_each: np.ndarray, join: Callable[..., np.ndarray]) -> np.ndarray:
        return np.stack([join(of_each[groups == group], axis=0) for group in groups])

    largest = np.zeros(len(names))
    for results in values_of(graph, names, images, host_part):
        largest = np.maximum(largest, [float(np.abs(r).max()) for r in results])
    first = [unclipped_frac_bits(m) for m in together(largest, np.max)]
    if not least_squares:
        return {PLANES: PLANES_FRAC_BITS, **dict(zip(names, first, strict=True))}
    errors = np.zeros((len(names), CANDIDATES))
    for results in values_of(graph, names, images, host_part):
        errors += [_errors(r[0], f) for r, f in zip(results, first, strict=True)]
    moves = np.argmin(together(errors, np.sum), axis=1)
    best = {name: f + int(move) for name, f, move in zip(names, first, moves, strict=True)}
    return {PLANES: PLANES_FRAC_BITS, **best}


def _errors(tensor: np.ndarray, first: int) -> np.ndarray:
    """The squared errors of (C, H, W), a few channels at a time: within the cache it is three times
    faster.
    """
    parts = np.array_split(tensor, -(-len(tensor) // 4))
    return np.asarray(np.sum([squared_errors(part, first) for part in parts], axis=0))


def rounded(plan: Plan, images: Remade[np.ndarray]) -> tuple[IntCore, Graph]:
    """A plan's graph in whole numbers, and the float graph that was rounded."""
    step("scale of each tensor")
    frac_bits = choose_frac_bits(plan.graph, images, plan.host_part, plan.passes.least_squares)
    plan = plan.without_large_sums(frac_bits).with_windows(frac_bits[CORRECTION], images)
    final = plan.ended(_balanced(plan, frac_bits, images))
    return plan.core(final, frac_bits), final


def _balanced(plan: Plan, frac_bits: dict[str, int], images: Remade[np.ndarray]) -> Graph:
    """The plan's graph, its streams equalised and its chain levelled."""
    if not (plan.streams or plan.chain.tensors):
        return plan.graph
    targets = search_targets(plan.graph, plan.host_part, images)

    def trial(candidate: Graph) -> Costs:
        core = plan.core(plan.ended(candidate), frac_bits)
        return crop_costs(host_model(core, {}), targets)

    graph = plan.chain.scaled(plan.graph, plan.chain.unscaled(frac_bits))
    if plan.streams:
        graph = _equalised(graph, plan, trial, images)
    if plan.chain.tensors:
        graph = _levelled(graph, plan, trial, images)
    return graph


def _levelled(graph: Graph, plan: Plan, trial: Trial, images: Remade[np.ndarray]) -> Graph:
    """The graph, its chain levelled; what the image itself passes through clips nothing that
    calibration sees.
    """
    step(f"equalising the channels of {len(plan.chain.tensors)} tensors")
    ranges = chain_ranges(graph, plan.chain, images, plan.host_part)
    factors = level(graph, plan.chain, ranges, np.ones(len(ranges)), trial)
    graph = plan.chain.scaled(graph, factors)
    if not plan.host_part.decoding.offsets:
        return graph
    # Here the image itself is in the tensors, with nothing on the host to make up for a clip.
    largest = largest_values(graph, plan.chain, images, plan.host_part)
    return plan.chain.scaled(graph, FULL / np.maximum(largest, FULL))


def _equalised(graph: Graph, plan: Plan, trial: Trial, images: Remade[np.ndarray]) -> Graph:
    """Stream after stream, the others levelled by a first guess until their turn comes."""
    ranges = [channel_ranges(plan.graph, stream, images, plan.host_part) for stream in plan.streams]
    for stream, stream_ranges in list(zip(plan.streams, ranges, strict=True))[1:]:
        graph = equalise(graph, stream, first_guess(stream_ranges, LEVELLING[0], 1.0))
    for number, stream in enumerate(plan.streams):
        step(f"equalising the channels of residual stream {number + 1} of {len(plan.streams)}")
        # The search starts from the stream as it is in the float network.
        if number:
            graph = equalise(graph, stream, 1 / first_guess(ranges[number], LEVELLING[0], 1.0))
        factors = first_guess(ranges[number], 0.0, 1.0)
        if plan.passes.equalising:
            factors = search(graph, stream, ranges[number], trial)
        graph = equalise(graph, stream, factors)
    return graph


Targets = list[tuple[np.ndarray, np.ndarray]]
"""Degraded crops (1, C, h, w) and what the float network makes of them, clipped to [0, 1]."""


def search_targets(graph: Graph, host_part: HostPart, images: Remade[np.ndarray]) -> Targets:
    """Of all crops of the images, those with the largest corrections, and others of all sizes.

    Only their sizes are kept; the images of the chosen are made once more.
    """
    session = open_session(graph_to_onnx(graph, [CORRECTION], host_part.planes))
    halo_px = 0 if halo_of(graph) is not None else None

    def restored(crop: np.ndarray) -> np.ndarray:
        (correction,) = next(tensor_values(session, [CORRECTION], crop, halo_px, host_part))
        return host_part.finish(crop, correction)

    def size(crop: np.ndarray) -> float:
        result = restored(crop)
        return float(np.abs(result - crop if result.shape == crop.shape else result).max())

    sizes = {}
    for k, image in enumerate(images):
        for n, crop in enumerate(crops(image, halo_px)):
            sizes[k, n] = size(crop)
    order = sorted(sizes, key=lambda place: sizes[place], reverse=True)
    height, width = map(int, crops(images[0], halo_px)[0].shape[2:])
    count = min(max(SEARCH_CROPS * TILE_PX**2 // (height * width), SEARCH_CROPS), MOST_CROPS)
    # int8 clips the largest corrections, so a quarter of the crops are those that hold them.
    hard = count // 4
    others = order[hard :: max((len(order) - hard) // (count - hard), 1)]
    places = (*order[:hard], *others[: count - hard])
    # A copy, because a view would keep the whole image in memory.
    selection = [crops(images[k], halo_px)[n].copy() for k, n in places]
    return [(crop, restored(crop)) for crop in selection]


def crop_costs(model: onnx.ModelProto, targets: Targets) -> Costs:
    """Root mean squared difference of an integer network from the float one, by crop.

    Squared, because clipping is rare and must count; its root, so that no single crop that clips
    decides alone. It is relative to what the float network changes in the crop: a loss of PSNR is
    relative too, and in absolute terms bright crops with large corrections would outweigh the dark
    ones, where the same step costs most.
    """
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
