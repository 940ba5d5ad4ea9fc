"""Static INT8 in one call: float ONNX and calibration patches in, the two encodings of the integer core out."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
import onnx

from profiles.errors import OptionError
from profiles.figures import Row
from quant.calibration import Patches, Remade, choose_frac_bits
from quant.core import SHIFTS, IntCore, Shifts, build_core
from quant.encodings import board_model, host_model
from quant.gate import compare, gate_row
from quant.graph import (
    CORRECTION,
    Conv,
    Graph,
    coarse_plane_only,
    correction_graph,
    graph_to_onnx,
    read_planes,
    relu_count,
    tensors,
)
from quant.onnx_file import fixed_tile_px, metadata
from quant.passes.equalise import Costs, channel_ranges, equalise, search, search_steps
from quant.passes.fit_weights import fit_weights, input_moments
from quant.passes.stream import (
    STREAM_FRAC_BITS,
    common_frac_bits,
    half_lsb_pair,
    share_stream_scale,
    stream_tensors,
    two_gains,
)
from quant.session import crops, open_any_size, open_session, run, tensor_values

SEARCH_CROPS = 16
"""What the equalisation is searched on, a quarter of them with the strongest edges: there int8 clips."""


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


def quantise_model(
    model: onnx.ModelProto,
    patches: Patches,
    about: dict[str, str],
    tick: Callable[[], None],
    passes: Passes = ALL,
    shifts: Shifts = SHIFTS,
) -> Quantised:
    """Quantise a float ConvBEERS under the DPU's rules: int8, symmetric, per tensor, power-of-two scales.

    The global add stays on the host, in 12 bits: only the correction is computed in int8. The rest is `passes`.
    `shifts` are the windows of the target.

    Raises:
        ModelError: not a graph of convolutions, ReLUs and adds that ends with the global add, or with weights of no
            sensible size.
    """
    graph = _reads_planes(model, passes)
    frac_bits = choose_frac_bits(graph, patches.degraded, tick, passes.least_squares)
    if passes.equalise and stream_tensors(graph):
        ranges = channel_ranges(graph, patches.degraded, tick)
        targets = search_targets(read_planes(correction_graph(model)), patches.degraded)

        def trial(tried: Graph) -> Costs:
            return crop_costs(host_model(_core(tried, frac_bits, passes, shifts), {}), targets)

        factors = search(graph, ranges, trial, tick)
        graph = equalise(graph, factors)
    final, core = _final(graph, frac_bits, passes), _core(graph, frac_bits, passes, shifts)
    if passes.fit_weights:
        core = fit_weights(final, core, input_moments(final, patches.degraded, tick), shifts)
    about = {**metadata(model), "precision": "int8 legal", "calibration_sha256": patches.digest, **about}
    about["passes"] = ", ".join(name for name, on in asdict(passes).items() if on)
    tile_px = fixed_tile_px(model)
    return Quantised(
        host_model(core, about, tile_px), board_model(core, about, tile_px), core, relu_count(graph), final
    )


def ticks(model: onnx.ModelProto, patches: int, passes: Passes = ALL) -> int:
    """How often `quantise_model` will call `tick`."""
    graph = _reads_planes(model, passes)
    passings = 2 + passes.fit_weights
    if not (passes.equalise and stream_tensors(graph)):
        return passings * patches
    first = graph[0]
    assert isinstance(first, Conv)  # noqa: S101 - correction_graph has seen to it
    return (passings + 1) * patches + search_steps(len(first.weight))


def _reads_planes(model: onnx.ModelProto, passes: Passes) -> Graph:
    graph = read_planes(correction_graph(model))
    return graph if passes.fine_planes else coarse_plane_only(graph)


def _core(graph: Graph, frac_bits: dict[str, int], passes: Passes, shifts: Shifts) -> IntCore:
    """The integer core of a graph whose tensors have these least-squares scales, the passes applied."""
    chosen, final = dict(frac_bits), _final(graph, frac_bits, passes)
    if passes.shared_residual_scale or passes.equalise:
        chosen = share_stream_scale(final, frac_bits, _stream_frac_bits(graph, frac_bits, passes))
    if passes.dual_gain:
        chosen[CORRECTION] += 1
    assert set(tensors(final)) <= set(chosen)  # noqa: S101
    return build_core(final, chosen, shifts)


def _final(graph: Graph, frac_bits: dict[str, int], passes: Passes) -> Graph:
    """The graph that is rounded: with the half-LSB pair and two gains where wanted."""
    if passes.half_lsb_pair and (passes.shared_residual_scale or passes.equalise):
        graph = half_lsb_pair(graph, 2.0 ** -_stream_frac_bits(graph, frac_bits, passes))
    return two_gains(graph) if passes.dual_gain else graph


def _stream_frac_bits(graph: Graph, frac_bits: dict[str, int], passes: Passes) -> int:
    return STREAM_FRAC_BITS if passes.equalise else common_frac_bits(graph, frac_bits)


Targets = list[tuple[np.ndarray, np.ndarray]]
"""Degraded crops (1, 1, h, w) and what the float network makes of them, clipped to [0, 1]."""


def search_targets(graph: Graph, images: Remade[np.ndarray]) -> Targets:
    """Of all crops of the images, those with the largest corrections, and others of all sizes.

    Only their sizes are kept; the images of the chosen are made once more.
    """
    session = open_session(graph_to_onnx(graph, [CORRECTION]))

    def restored(crop: np.ndarray) -> np.ndarray:
        (correction,) = next(tensor_values(session, [CORRECTION], crop, halo_px=0))
        return np.asarray(np.clip(crop + correction, 0, 1))

    sizes = {
        (k, n): float(np.abs(restored(crop) - crop).max())
        for k, image in enumerate(images)
        for n, crop in enumerate(crops(image))
    }
    order = sorted(sizes, key=lambda place: sizes[place], reverse=True)
    hard = SEARCH_CROPS // 4
    others = order[hard :: max((len(order) - hard) // (SEARCH_CROPS - hard), 1)]
    chosen = [crops(images[k])[n].copy() for k, n in (*order[:hard], *others[: SEARCH_CROPS - hard])]
    return [(crop, restored(crop)) for crop in chosen]


def crop_costs(model: onnx.ModelProto, targets: Targets) -> Costs:
    """Root mean squared difference of an integer network from the float one, by crop.

    Squared, because clipping is rare and must count; its root, so that no single crop that clips decides alone.
    """
    session = open_session(model, threads=1)

    def cost(number: int) -> float:
        image, wanted = targets[number]
        return float(np.sqrt(np.square(run(session, image) - wanted, dtype=np.float64).mean()))

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
