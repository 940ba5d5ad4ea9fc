"""The network in free INT8 as ONNX: the host file's integer kernels, with whatever float scales suit.

    image -> [scale to DN, split into planes] -> uint8 core -> [dequantise, add to the image, clip] -> restored

What boards that are not the DPU allow, and it does not: a float scale for each tensor and for each output channel of
a weight, int32 bias, and a zero point of 0 behind a ReLU: nothing is below zero there, so all 256 values serve, and
clipping at them is the ReLU.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import onnx
from onnx import helper

from quant.free_scales import round_weight
from quant.graph import CORRECTION, IMAGE, Add, Conv, Graph
from quant.host_file import MICROSOFT, ZERO, _merge_gains, _split_planes, _Writer
from quant.moments import Moments
from quant.onnx_file import image_info, make_model
from quant.passes.fit_weights import fit

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
    about: dict[str, str],
    tile_px: int | None = None,
    moments: Mapping[str, Moments] | None = None,
) -> onnx.ModelProto:
    """The network on stock onnxruntime, (N, 1, H, W) float32 in [0, 1] to the same.

    Args:
        graph: that reads the planes, its correction with two gains.
        scales: of every tensor, the planes included.
        about: metadata.
        tile_px: side of a fixed tile, or None for any size.
        moments: of what each convolution reads, for `quant.passes.fit_weights`; None rounds to nearest.
    """
    writer = _Writer()
    _split_planes(writer)
    for op in graph:
        if isinstance(op, Add):
            feeds = [feed for name in op.inputs for feed in (name, *_scale(writer, scales[name]))]
            feeds += _scale(writer, scales[op.output])
            writer.node("QLinearAdd", op.output, feeds, name=op.name, domain=MICROSOFT)
        else:
            _conv(writer, op, scales, moments[op.name] if moments else None)
    both = [CORRECTION, *_scale(writer, scales[CORRECTION])]
    writer.node("DequantizeLinear", "host_back.both", both)
    _merge_gains(writer, scales[CORRECTION].unit)
    writer.node("Add", "host_back.add", [IMAGE, "host_back.correction"])
    limits = [writer.scalar("zero", 0), writer.scalar("one", 1)]
    writer.node("Clip", "restored", ["host_back.add", *limits], name="host_back.clip")
    ends = [image_info(IMAGE, 1, tile_px)], [image_info("restored", 1, tile_px)]
    whole = helper.make_graph(writer.nodes, "convbeers-int8-free", *ends, list(writer.weights.values()))
    return make_model(whole, about, microsoft=True)


def _conv(w: _Writer, op: Conv, scales: Mapping[str, Scale], moments: Moments | None) -> None:
    weight = round_weight(op.weight, np.abs(op.bias) / (scales[op.input].unit * MAX_BIAS))
    values, shifted = fit(op.weight, weight.values, weight.scales, moments) if moments else (weight.values, 0.0)
    products = np.float32(scales[op.input].unit) * weight.scales.astype(np.float64)
    bias = np.rint((op.bias - shifted) / products).astype(np.int32)
    feeds = [op.input, *_scale(w, scales[op.input])]
    feeds += [w.constant(f"{op.name}.weight", values), w.constant(f"{op.name}.weight_scale", weight.scales)]
    feeds += [w.constant(f"{op.name}.weight_zero_point", np.zeros(len(op.weight), np.int8))]
    feeds += [*_scale(w, scales[op.output]), w.constant(f"{op.name}.bias", bias)]
    kernel, zero_point = list(op.weight.shape[2:]), scales[op.output].zero_point
    clipped = op.relu and zero_point != 0
    result = f"{op.output}.linear" if clipped else op.output
    w.node("QLinearConv", result, feeds, name=op.name, pads=[op.pad_px] * 4, kernel_shape=kernel)
    if clipped:
        w.node("Max", op.output, [result, _scale(w, scales[op.output])[1]], name=f"{op.name}.relu")


def _scale(w: _Writer, scale: Scale) -> list[str]:
    unit = w.scalar(f"scale_{np.float32(scale.unit)!s}", scale.unit)
    return [unit, w.constant(f"zero_point_{scale.zero_point}", np.array(scale.zero_point, np.uint8))]
