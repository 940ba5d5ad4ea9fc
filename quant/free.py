"""INT8 for boards that are not the DPU: what its rules cost shows against what goes without them.

Activations uint8 with float scales, weights int8 with a scale of each output channel, both by least squares;
written with the host file's integer kernels. What stays is the residual stream of 8 bits.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import onnx

from beers_deploy.model.progress import Log, no_log
from beers_deploy.quant.core import INT8_MAX
from beers_deploy.quant.encodings import MICROSOFT
from beers_deploy.quant.ends import ONE_CHANNEL, ZERO, Ends, HostWriter, ends_of, write_back, write_front
from beers_deploy.quant.graph import (
    CORRECTION,
    IMAGE,
    PLANES,
    PLANES_FRAC_BITS,
    Activation,
    Add,
    Conv,
    Graph,
    plain_network,
    read_planes,
    tensors,
)
from beers_deploy.quant.onnx_file import fixed_tile_px, image_info, make_model, metadata
from beers_deploy.quant.passes.equalise import Costs, channel_ranges, equalise, search
from beers_deploy.quant.passes.fit_weights import Moments, fit, input_moments
from beers_deploy.quant.passes.stream import half_lsb_pair, streams, two_gains
from beers_deploy.quant.quantise import STREAM_STEP, crop_costs, search_targets
from beers_deploy.quant.samples import Patches
from beers_deploy.quant.session import values_of

BINS = 4096
"""Sixteen and more a step of an 8-bit number."""

SHARES = np.linspace(0.3, 1.0, 71)
"""Scales tried, as shares of the one that clips nothing."""


def tensor_scales(
    graph: Graph, levels: Mapping[str, int], images: Iterable[np.ndarray], ends: Ends = ONE_CHANNEL
) -> dict[str, float]:
    """The least-squares scale of each named tensor of a plane-reading graph.

    Args:
        graph: that reads the planes.
        levels: names, and the largest whole number that the size of a value may take: 255, or 127 beside a sign.
        images: (1, 1, H, W) float32 in [0, 1], passed over twice; one is in memory at a time.
        ends: of the network.
    """
    names = list(levels)
    largest, counts = np.zeros(len(names)), np.zeros((len(names), BINS + 1))
    for results in values_of(graph, names, images, ends):
        largest = np.maximum(largest, [float(np.abs(r).max()) for r in results])
    largest[largest == 0] = 1  # a tensor that is always zero: any scale will do
    for results in values_of(graph, names, images, ends):
        counts += [_counts(np.abs(r), float(high)) for r, high in zip(results, largest, strict=True)]
    return {
        name: best_scale(count, float(high), levels[name])
        for name, count, high in zip(names, counts, largest, strict=True)
    }


def best_scale(counts: np.ndarray, largest: float, levels: int) -> float:
    """The scale of least squared error, of sizes counted at 0, largest / BINS, ... largest."""
    sizes = np.linspace(0, largest, BINS + 1)
    tried = SHARES * largest / levels
    errors = [np.dot(counts, (np.minimum(np.rint(sizes / s), levels) * s - sizes) ** 2) for s in tried]
    return float(tried[int(np.argmin(errors))])


def round_weight(weight: np.ndarray, finest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(O, I, kh, kw) int8 in [-127, 127] and the scale (O,) float32 of each output channel.

    The least-squares one, but none below `finest` (O,); of a channel of zeros 1.
    """
    rows = np.asarray(weight, np.float64).reshape(len(weight), -1)
    scales = np.maximum(_row_scales(rows), finest).astype(np.float32)
    return _whole(rows, scales).astype(np.int8).reshape(weight.shape), scales


def _row_scales(rows: np.ndarray) -> np.ndarray:
    """(O,) for rows (O, n): a share at a time for all rows, because a search asks for it at every trial."""
    largest = np.abs(rows).max(axis=1)
    best, least = np.ones(len(rows)), np.full(len(rows), np.inf)
    for share in SHARES:
        tried = np.where(largest > 0, share * largest / INT8_MAX, 1.0)
        error = np.square(_whole(rows, tried) * tried[:, None] - rows).sum(axis=1)
        best, least = np.where(error < least, tried, best), np.minimum(error, least)
    return best


def _whole(rows: np.ndarray, scales: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.rint(rows / scales[:, None]), -INT8_MAX, INT8_MAX))


def _counts(sizes: np.ndarray, largest: float) -> np.ndarray:
    places = np.rint(sizes.ravel() * np.float32(BINS / largest)).astype(np.int32)
    return np.bincount(np.minimum(places, BINS), minlength=BINS + 1)


MAX_BIAS = 2.0**30
"""A channel of tiny weights keeps a scale at which its bias fits int32, beside the products."""


@dataclass(frozen=True)
class Scale:
    """A uint8 tensor holds (value - zero_point) * unit."""

    unit: float
    zero_point: int = ZERO


def free_model(
    graph: Graph,
    scales: Mapping[str, Scale],
    ends: Ends = ONE_CHANNEL,
    about: Mapping[str, str] = MappingProxyType({}),
    tile_px: int | None = None,
    moments: Mapping[str, Moments] | None = None,
) -> onnx.ModelProto:
    """The network on stock onnxruntime, (N, 1, H, W) float32 in [0, 1] to the same.

    Args:
        graph: that reads the planes, its correction with two gains.
        scales: of every tensor, the planes included.
        ends: of the network.
        about: metadata.
        tile_px: side of a fixed tile, or None for any size.
        moments: of what each convolution reads, for `quant.passes.fit_weights`; None rounds to nearest.
    """
    writer, ends = HostWriter(), replace(ends, gains=2)
    write_front(writer, ends)
    for op in graph:
        if isinstance(op, Add):
            feeds = [feed for name in op.inputs for feed in (name, *_scale(writer, scales[name]))]
            feeds += _scale(writer, scales[op.output])
            writer.node("QLinearAdd", op.output, feeds, name=op.name, domain=MICROSOFT)
        else:
            assert isinstance(op, Conv)  # noqa: S101 - correction_graph has seen to it
            _conv(writer, op, scales, moments[op.name] if moments else None)
    write_back(writer, ends, [CORRECTION, *_scale(writer, scales[CORRECTION])], scales[CORRECTION].unit)
    sides = [image_info(IMAGE, 1, tile_px)], [image_info("restored", 1, tile_px)]
    return make_model(writer.graph("convbeers-int8-free", *sides), dict(about), microsoft=True)


def _conv(w: HostWriter, op: Conv, scales: Mapping[str, Scale], moments: Moments | None) -> None:
    whole, units = round_weight(op.weight, np.abs(op.bias) / (scales[op.input].unit * MAX_BIAS))
    whole, shifted = fit(op.weight, units, moments) if moments else (whole, np.zeros(1))
    products = np.float32(scales[op.input].unit) * units.astype(np.float64)
    bias = np.rint((op.bias - shifted) / products).astype(np.int32)
    feeds = [op.input, *_scale(w, scales[op.input])]
    feeds += [w.constant(f"{op.name}.weight", whole), w.constant(f"{op.name}.weight_scale", units)]
    feeds += [w.constant(f"{op.name}.weight_zero_point", np.zeros(len(op.weight), np.int8))]
    feeds += [*_scale(w, scales[op.output]), w.constant(f"{op.name}.bias", bias)]
    kernel, zero_point = list(op.weight.shape[2:]), scales[op.output].zero_point
    clipped = op.activation is Activation.relu and zero_point != 0
    result = f"{op.output}.linear" if clipped else op.output
    w.node("QLinearConv", result, feeds, name=op.name, pads=list(op.window.pads), kernel_shape=kernel)
    if clipped:
        w.node("Max", op.output, [result, _scale(w, scales[op.output])[1]], name=f"{op.name}.relu")


def _scale(w: HostWriter, scale: Scale) -> list[str]:
    unit = w.scalar(f"scale_{np.float32(scale.unit)!s}", scale.unit)
    return [unit, w.constant(f"zero_point_{scale.zero_point}", np.array(scale.zero_point, np.uint8))]


UINT8_MAX = 255
FINER = 2
"""The fine gain's unit is so much finer than what suits all corrections: the coarse one is there for the large."""


def quantise_free(
    model: onnx.ModelProto, patches: Patches, about: dict[str, str], log: Log = no_log
) -> onnx.ModelProto:
    """Quantise a float ConvBEERS to uint8 activations and int8 weights, with float scales, of weights per channel.

    Returns:
        The host file: `image` to `restored`, every convolution an integer kernel of onnxruntime.

    Raises:
        ModelError: not a graph of convolutions, ReLUs and adds that ends with the global add.
    """
    network = plain_network(model)
    graph, ends = read_planes(network.graph), ends_of(network)
    log("scale of each tensor")
    scales = _scales(graph, patches, ends)

    def written(tried: Graph, *more: Any) -> onnx.ModelProto:
        fine = _fine(tried)
        known = {name: scales.get(name, Scale(STREAM_STEP)) for name in (PLANES, *tensors(fine))}
        return free_model(fine, known, ends, *more)

    found = streams(graph)
    targets = search_targets(graph, ends, patches.degraded) if found else []

    def trial(tried: Graph) -> Costs:
        return crop_costs(written(tried), targets)

    for stream in found:
        log("equalising the channels of the residual stream")
        ranges = channel_ranges(graph, stream, patches.degraded, ends)
        graph = equalise(graph, stream, search(graph, stream, ranges, trial))
    about = {**metadata(model), "precision": "int8 free", "calibration_sha256": patches.digest, **about}
    log("rounding of the weights")
    return written(graph, about, fixed_tile_px(model), input_moments(_fine(graph), patches.degraded, ends))


def _scales(graph: Graph, patches: Patches, ends: Ends) -> dict[str, Scale]:
    """Least-squares scales of what is not the stream; that has any, because `equalise` scales its channels to it."""
    in_streams = {name for stream in streams(graph) for name in stream}
    convs = [op for op in graph if isinstance(op, Conv) and op.output not in in_streams]
    levels = {op.output: UINT8_MAX if op.activation is Activation.relu else INT8_MAX for op in convs}
    units = tensor_scales(graph, levels, patches.degraded, ends)
    units[CORRECTION] /= FINER
    found = {name: Scale(unit, 0 if levels[name] == UINT8_MAX else ZERO) for name, unit in units.items()}
    return {PLANES: Scale(2.0**-PLANES_FRAC_BITS), **found}


def _fine(graph: Graph) -> Graph:
    return two_gains(half_lsb_pair(graph, STREAM_STEP))
