"""Static INT8 in one call: float ONNX and calibration patches in, the two encodings of the integer core out."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
import onnx

from profiles.errors import OptionError
from profiles.figures import Row
from quant.calibration import Patches, Remade, choose_frac_bits
from quant.core import SHIFTS, IntCore, Shifts, build_core
from quant.encodings import board_model, host_model
from quant.ends import GAIN, Ends, ends_of
from quant.gate import compare, gate_row
from quant.graph import (
    CORRECTION,
    PLANES,
    Graph,
    channels_of,
    coarse_plane_only,
    graph_to_onnx,
    read_network,
    read_planes,
    relu_count,
    tensors,
)
from quant.graph.tail import Tail
from quant.onnx_file import fixed_tile_px, metadata
from quant.passes.equalise import (
    LEVELLING,
    Costs,
    Trial,
    channel_ranges,
    equalise,
    first_guess,
    search,
    search_steps,
    with_room,
)
from quant.passes.fit_weights import fit_weights, input_moments
from quant.passes.level import Chain, chain_ranges, level
from quant.passes.stream import (
    MAX_CHANNELS,
    STREAM_FRAC_BITS,
    Stream,
    common_frac_bits,
    half_lsb_pair,
    lone_tensors,
    share_stream_scale,
    streams,
    takes_gains,
    two_gains,
    window_offsets,
    windowed,
)
from quant.passes.tune import Tuning, tune
from quant.session import TILE_PX, crops, halo_of, open_any_size, open_session, result_of, tensor_values

SEARCH_CROPS = 16
"""What the equalisation is searched on, a quarter of them with the strongest edges: there int8 clips."""
MOST_CROPS = 64


FINER = GAIN.bit_length() - 1
"""Fractional bits by which a window is finer than the result's own scale."""


@dataclass(frozen=True)
class Passes:
    """What is done beyond rounding each tensor: see `quant.passes`, `quant.graph` and `quant.core`."""

    fine_planes: bool = True
    least_squares: bool = True
    shared_residual_scale: bool = True
    equalise: bool = True
    half_lsb_pair: bool = True
    fit_weights: bool = True
    dual_gain: bool = True


ALL = Passes()


@dataclass(frozen=True)
class Quantised:
    """One network in whole numbers, for the host and for the board; `graph` is the float one that was rounded."""

    host: onnx.ModelProto
    board: onnx.ModelProto
    core: IntCore
    relus: int
    graph: Graph


@dataclass(frozen=True)
class Plan:
    """What is to be quantised: the graph that reads the planes wanted, and that of all; the host's part; streams.

    `chain` is what is levelled besides the streams, or where there are none. What is calibrated and searched is the
    map in front of the network's `tail`, which is put behind it in the end: values of boxes that no object has would
    outweigh all others.
    """

    graph: Graph
    full: Graph
    ends: Ends
    streams: list[Stream]
    chain: Chain
    tail: Tail | None
    passes: Passes
    shifts: Shifts

    @property
    def takes_windows(self) -> bool:
        """Whether the result comes in windows: where nothing is added to it, and a convolution writes it."""
        room = self.ends.outputs <= MAX_CHANNELS // 2
        alone = self.ends.gains == 1 and not self.ends.adds_image
        return self.passes.dual_gain and alone and takes_gains(self.graph) and room

    def with_windows(self, frac_bits: int, low: np.ndarray, high: np.ndarray) -> "Plan":
        """The result in windows from low to high (C,), finer by GAIN than its own scale of so many bits."""
        offsets = window_offsets(low, high, 2.0 ** -(frac_bits + FINER))
        found = tuple(tuple(float(each) for each in window) for window in offsets)
        return replace(self, ends=replace(self.ends, offsets=found))

    @property
    def shares(self) -> bool:
        """Whether its streams have one scale."""
        return bool(self.streams) and (self.passes.shared_residual_scale or self.passes.equalise)

    def stream_step(self, frac_bits: Mapping[str, int]) -> float:
        """The value of one unit of the streams' tensors."""
        return 2.0 ** -self.stream_frac_bits(frac_bits)

    def stream_frac_bits(self, frac_bits: Mapping[str, int]) -> int:
        """The streams' fractional bits, where the tensors' own are these."""
        return STREAM_FRAC_BITS if self.passes.equalise else common_frac_bits(self.streams, frac_bits)

    def paired(self, graph: Graph, frac_bits: Mapping[str, int]) -> Graph:
        """The graph with the half-LSB pair where that is wanted and possible; else itself."""
        wanted = self.passes.half_lsb_pair and self.shares
        return half_lsb_pair(graph, self.stream_step(frac_bits)) if wanted else graph

    def ended(self, graph: Graph) -> Graph:
        """The graph with windows or two gains where they are wanted."""
        if self.ends.offsets:
            return windowed(graph, np.array(self.ends.offsets))
        return two_gains(graph) if self.ends.gains == 2 else graph

    def core(self, final: Graph, frac_bits: Mapping[str, int]) -> IntCore:
        """The integer core of a graph, paired and ended, whose tensors have these least-squares scales."""
        chosen = dict(frac_bits)
        if self.shares:
            found = streams(final)
            chosen = share_stream_scale(found, frac_bits, self.stream_frac_bits(frac_bits))
        if self.passes.equalise:
            chosen |= dict.fromkeys(self.chain.tensors, STREAM_FRAC_BITS)
        if self.ends.offsets:
            chosen[CORRECTION] += FINER
        elif self.ends.gains == 2:
            chosen[CORRECTION] += 1
        assert set(tensors(final)) <= set(chosen)  # noqa: S101
        return build_core(final, chosen, self.shifts, self.ends)


def _plan(model: onnx.ModelProto, passes: Passes, shifts: Shifts = SHIFTS) -> Plan:
    network = read_network(model)
    full = read_planes(network.graph)
    gains = 2 if passes.dual_gain and network.adds_image and takes_gains(full) else 1
    graph = full if passes.fine_planes else coarse_plane_only(full)
    ends, found = ends_of(network, gains), streams(graph)
    widths = channels_of(graph, {PLANES: ends.planes * ends.channels})
    alone = [] if found else lone_tensors(graph)
    chain = Chain(tuple(alone), tuple(widths[name] for name in alone))
    return Plan(graph, full, ends, found, chain, network.tail, passes, shifts)


def quantise_model(
    model: onnx.ModelProto,
    patches: Patches,
    about: dict[str, str],
    tick: Callable[[], None],
    passes: Passes = ALL,
    shifts: Shifts = SHIFTS,
    tuning: Tuning | None = None,
) -> Quantised:
    """Quantise a float network under the DPU's rules: int8, symmetric, per tensor, power-of-two scales.

    The global add, where there is one, stays on the host, in 12 bits: only the correction is computed in int8. The
    rest is `passes`. `shifts` are the windows of the target. With `tuning` the whole numbers are trained at last.

    Raises:
        ModelError: an operation that the DPU does not compute, or weights of no sensible size.
    """
    plan = _plan(model, passes, shifts)
    core, final, last_sum = rounded(plan, patches.degraded, tick)
    core = replace(core, ends=replace(core.ends, tail=plan.tail))
    if tuning:
        # Patches that hold few roofs would train the last sum's room away.
        core = tune(core, final, plan.full, tuning, tick, still=last_sum)
    about = {**metadata(model), "precision": "int8 legal", "calibration_sha256": patches.digest, **about}
    about["passes"] = ", ".join(name for name, on in asdict(passes).items() if on)
    if tuning:
        about["finetune"] = f"{tuning.steps} steps on {len(tuning.pairs)} patches"
    tile_px = fixed_tile_px(model)
    return Quantised(
        host_model(core, about, tile_px), board_model(core, about, tile_px), core, relu_count(plan.graph), final
    )


def rounded(
    plan: Plan, images: Remade[np.ndarray], tick: Callable[[], None]
) -> tuple[IntCore, Graph, frozenset[str]]:
    """A plan's graph in whole numbers, the float graph that was rounded, and the tensors of its last sum."""
    graph, passes = plan.graph, plan.passes
    frac_bits = choose_frac_bits(graph, images, tick, passes.least_squares, plan.ends)
    if plan.takes_windows:
        plan = plan.with_windows(frac_bits[CORRECTION], *_result_range(plan, images, tick))
    if passes.equalise:
        graph = _balanced(plan, frac_bits, images, tick)
    paired, last_sum = plan.paired(graph, frac_bits), frozenset[str]()
    if paired is not graph:
        paired = with_room(paired, plan.stream_step(frac_bits), images, tick, plan.ends)
        last_sum = frozenset(paired[-2].inputs)
    final = plan.ended(paired)
    core = plan.core(final, frac_bits)
    if passes.fit_weights:
        core = fit_weights(final, core, input_moments(final, images, tick, plan.ends), plan.shifts)
    return core, final, last_sum


def _result_range(plan: Plan, images: Remade[np.ndarray], tick: Callable[[], None]) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest value (C,) of each channel of the float network's result."""
    session = open_session(graph_to_onnx(plan.full, [CORRECTION], plan.ends.planes * plan.ends.channels))
    low, high = np.array(np.inf), np.array(-np.inf)
    for image in images:
        for (result,) in tensor_values(session, [CORRECTION], image, halo_of(plan.full), plan.ends):
            low, high = np.minimum(low, result[0].min((1, 2))), np.maximum(high, result[0].max((1, 2)))
        tick()
    return low, high


def _balanced(plan: Plan, frac_bits: dict[str, int], images: Remade[np.ndarray], tick: Callable[[], None]) -> Graph:
    """The plan's graph, its streams equalised and then its chain levelled."""
    graph = plan.chain.scaled(plan.graph, plan.chain.unscaled(frac_bits))
    if not (plan.streams or plan.chain.tensors):
        return graph
    trial = _trial(plan, frac_bits, images)
    graph = _equalised(graph, plan, trial, images, tick) if plan.streams else graph
    if plan.chain.tensors:
        ranges = chain_ranges(graph, plan.chain, images, tick, plan.ends)
        graph = plan.chain.scaled(graph, level(graph, plan.chain, ranges, np.ones(len(ranges)), trial, tick))
    return graph


def _equalised(graph: Graph, plan: Plan, trial: Trial, images: Remade[np.ndarray], tick: Callable[[], None]) -> Graph:
    """Stream after stream, the others levelled by a first guess until their turn comes."""
    ranges = {}
    for stream in plan.streams:
        ranges[stream] = channel_ranges(plan.graph, stream, images, tick, plan.ends)
    for stream in plan.streams[1:]:
        graph = equalise(graph, stream, first_guess(ranges[stream], LEVELLING[0], 1.0))
    for number, stream in enumerate(plan.streams):
        if number:
            graph = equalise(graph, stream, 1 / first_guess(ranges[stream], LEVELLING[0], 1.0))
        graph = equalise(graph, stream, search(graph, stream, ranges[stream], trial, tick))
    return graph


def _trial(plan: Plan, frac_bits: dict[str, int], images: Remade[np.ndarray]) -> Trial:
    """What a graph costs once it is rounded, on crops of the images."""
    targets = search_targets(plan.full, plan.ends, images)

    def costs_of(tried: Graph) -> Costs:
        final = plan.ended(plan.paired(tried, frac_bits))
        return crop_costs(host_model(plan.core(final, frac_bits), {}), targets)

    return costs_of


def ticks(model: onnx.ModelProto, patches: int, passes: Passes = ALL) -> int:
    """How often `quantise_model` will call `tick`."""
    return plan_ticks(_plan(model, passes), patches)


def plan_ticks(plan: Plan, patches: int) -> int:
    """As `ticks`, of a plan."""
    passes = plan.passes
    pairs = passes.half_lsb_pair and plan.shares and half_lsb_pair(plan.graph, 1.0) is not plan.graph
    passings = 2 + passes.fit_weights + plan.takes_windows + pairs
    if not passes.equalise:
        return passings * patches
    widths = channels_of(plan.graph, {PLANES: plan.ends.planes * plan.ends.channels})
    steps = sum(search_steps(widths[min(stream)]) for stream in plan.streams)
    levelled = bool(plan.chain.tensors)
    return (passings + len(plan.streams) + levelled) * patches + steps + levelled * plan.chain.steps


Targets = list[tuple[np.ndarray, np.ndarray]]
"""Degraded crops (1, C, h, w) and what the float network makes of them, clipped to [0, 1]."""


def search_targets(graph: Graph, ends: Ends, images: Remade[np.ndarray]) -> Targets:
    """Of all crops of the images, those with the largest corrections, and others of all sizes.

    Only their sizes are kept; the images of the chosen are made once more.
    """
    session = open_session(graph_to_onnx(graph, [CORRECTION], ends.planes * ends.channels))
    halo_px = 0 if halo_of(graph) is not None else None

    def restored(crop: np.ndarray) -> np.ndarray:
        (correction,) = next(tensor_values(session, [CORRECTION], crop, halo_px, ends))
        return ends.finished(crop, correction)

    def size(crop: np.ndarray) -> float:
        result = restored(crop)
        return float(np.abs(result - crop if result.shape == crop.shape else result).max())

    sizes = {(k, n): size(crop) for k, image in enumerate(images) for n, crop in enumerate(crops(image, halo_px))}
    order = sorted(sizes, key=lambda place: sizes[place], reverse=True)
    count = _crop_count(crops(images[0], halo_px)[0])
    hard = count // 4
    others = order[hard :: max((len(order) - hard) // (count - hard), 1)]
    chosen = [crops(images[k], halo_px)[n].copy() for k, n in (*order[:hard], *others[: count - hard])]
    return [(crop, restored(crop)) for crop in chosen]


def _crop_count(crop: np.ndarray) -> int:
    """How many crops like this one are searched on: small ones say less each."""
    height, width = map(int, crop.shape[2:])
    return min(max(SEARCH_CROPS * TILE_PX**2 // (height * width), SEARCH_CROPS), MOST_CROPS)


def crop_costs(model: onnx.ModelProto, targets: Targets) -> Costs:
    """Root mean squared difference of an integer network from the float one, by crop.

    Squared, because clipping is rare and must count; its root, so that no single crop that clips decides alone.
    """
    session = open_session(model, threads=1)

    def cost(number: int) -> float:
        image, wanted = targets[number]
        return float(np.sqrt(np.square(result_of(session, image) - wanted, dtype=np.float64).mean()))

    def of(crops: np.ndarray | None) -> np.ndarray:
        # Small crops keep cores busier one to each than all on one: threads that share a crop wait for each other.
        with ThreadPoolExecutor(os.cpu_count()) as cores:
            return np.array(list(cores.map(cost, range(len(targets)) if crops is None else crops)))

    return of


def ablation_rows(
    model: onnx.ModelProto, calibration: Patches, held_out: Patches, tick: Callable[[], None], shifts: Shifts = SHIFTS
) -> list[Row]:
    """The gate's figures with all passes, with each one left out, and with none."""
    session, rows = open_any_size(model), []
    for name, passes in ablations().items():
        made = quantise_model(model, calibration, {}, lambda: None, passes, shifts)
        row = gate_row(compare(session, open_any_size(made.host), held_out.pairs))
        rows.append(Row("ablation", name, row.figures))
        tick()
    return rows


def ablations() -> dict[str, Passes]:
    """All passes, all but one, none; without a shared residual scale there is nothing to equalise."""
    names = [field.name for field in fields(Passes)]
    found = {"all passes": ALL}
    for name in names:
        left_out = {name: False, "equalise": False} if name == "shared_residual_scale" else {name: False}
        found[f"without {name.replace('_', ' ')}"] = replace(ALL, **left_out)
    return {**found, "none": Passes(**dict.fromkeys(names, False))}


def passes_without(names: list[str]) -> Passes:
    """All passes but these.

    Raises:
        OptionError: no pass of that name.
    """
    known = [field.name for field in fields(Passes)]
    for name in names:
        if name.replace("-", "_") not in known:
            expected = ", ".join(known).replace("_", "-")
            raise OptionError("--without", expected=expected, got=repr(name), remedy="name one of these")
    return replace(ALL, **{name.replace("-", "_"): False for name in names})
