"""The DPU's rules for pools, activations, element-wise operators and data movement operators, one
function for each rule.
"""

import math

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.conv_rules import alu_padding
from beers_deploy.dpu.checker.finding import Finding, beyond_range, shown
from beers_deploy.dpu.graph import CONVOLUTIONS, WINDOWED, Operation
from beers_deploy.profiles.errors import counted, sizes
from beers_deploy.quant.domains import SEPARATOR, foreign_remedy, is_foreign

# ruff: noqa: ARG001 - every rule takes the operation and the DPU


MANUAL = {
    "Relu": "ReLU",
    "Max": "ReLU",
    "Clip": "ReLU6",
    "LeakyRelu": "LeakyReLU",
    "QLinearLeakyRelu": "LeakyReLU",
    "PRelu": "PReLU",
    "HardSigmoid": "hard-sigmoid",
    "HardSwish": "hard-swish",
}
"""The names that manuals use for the activations of ONNX."""
PLACE = {
    "conv": "conv",
    "transposed": "conv",
    "depthwise": "depthwise",
    "pool": "pool",
    "add": "sum",
    "mul": "sum",
}
"""The operations after which an activation may be fused, and the key under which a profile lists
it.
"""
INSTEAD = {
    "Sub": "fold the minus sign into the weights before it, and add",
    "Neg": "fold the minus sign into the weights before it",
    "Div": (
        "fold the division into the weights of the convolution before it, or multiply by the "
        "reciprocal; in front of Erf it is a part of GELU, which 'quantize --adapt' replaces"
    ),
    "Exp": "leave it to the host, behind the network",
    "Sigmoid": (
        "use HardSigmoid, and HardSwish in place of SiLU, which is x * Sigmoid(x); 'quantize "
        "--adapt' replaces both"
    ),
    "Tanh": "use ReLU6 of a scaled and shifted input; 'quantize --adapt' replaces it so",
    "Log": "leave it to the host, in front of the network",
    "Sqrt": "leave it to the host, in front of the network",
    "Softmax": "leave it to the host, behind the network",
    "Erf": "use HardSwish in place of GELU; 'quantize --adapt' replaces it",
    "Gelu": "use HardSwish; 'quantize --adapt' replaces it",
    "Elu": "train with LeakyReLU of slope 26/256, or with ReLU",
    "Mish": "train with HardSwish",
    "Softplus": "train with ReLU; as a part of Mish, x * Tanh(Softplus(x)), with HardSwish",
    "Clip": "use ReLU, or ReLU6 (Clip from 0 to 6)",
    "ReduceSum": "use a 1 x 1 convolution of ones",
    "ReduceMean": "use GlobalAveragePool; 'quantize --adapt' replaces layer normalisation",
    "Transpose": "keep the layout (N, C, H, W) throughout",
    "Reshape": (
        "leave it to the host, or do without it; around InstanceNormalization it is a part of "
        "GroupNorm: train without normalisation"
    ),
    "Slice": "use a convolution that picks these channels or pixels",
    "Gather": (
        "to pick fixed channels, use a 1 x 1 convolution; what is picked by value stays "
        "with the host"
    ),
    "Gemm": "write it as a 1 x 1 convolution",
    "MatMul": (
        "write it as a 1 x 1 convolution where one factor is constant; else leave it to the host"
    ),
    "DFT": (
        "use a convolution of at most 16 x 16 where the filter is short; else leave it to the host"
    ),
    "TopK": "leave it to the host: the DPU does not compare values across a map",
    "LayerNormalization": (
        "train with batch normalisation, or without; 'quantize --adapt' replaces it"
    ),
    "InstanceNormalization": (
        "train with batch normalisation, or without; 'quantize --adapt' replaces it"
    ),
    "BatchNormalization": "fold it into the convolution before it",
}


def known_operator(op: Operation, dpu: Dpu) -> Finding | None:
    """Only operators of the supported list run on the DPU ({documents[operators]})."""
    # The rule `operator_domain` names a foreign operator: it would be reported twice.
    if is_foreign(op.op_type):
        return None
    remedy = INSTEAD.get(
        op.op_type, "leave it to the host before or behind the network, or do without it"
    )
    return Finding(f"{op.op_type} always runs on the CPU", remedy)


def operator_domain(op: Operation, dpu: Dpu) -> Finding | None:
    """An operator is ONNX's, or onnxruntime's on integers: its domain belongs to its name (ONNX IR,
    Operators).
    """
    if not is_foreign(op.op_type):
        return None
    domain, _, name = op.op_type.rpartition(SEPARATOR)
    return Finding(
        f"{op.op_type} is no operator of ONNX, whatever its name", foreign_remedy(domain, name)
    )


def int8_operator(op: Operation, dpu: Dpu) -> Finding | None:
    """The NPU computes an operator in INT8 unless it is one of {npu[no_int8]}
    ({npu[no_int8].source}).
    """
    if op.op_type not in dpu.target.npu["no_int8"].value:
        return None
    remedy = INSTEAD.get(
        op.op_type, "leave it to the host, or train with another, such as LeakyReLU for PReLU"
    )
    return Finding(
        f"AMD's table has N/A for {op.op_type} in INT8; left in float it would be BF16", remedy
    )


def shuffle_place(op: Operation, dpu: Dpu) -> Finding | None:
    """A pixel shuffle or its inverse stands behind a convolution or its activation
    ({documents[operators]}).
    """
    if op.follows in CONVOLUTIONS or op.follows == "activation":
        return None
    other = (
        "a nearest Resize and a convolution"
        if op.op_type == "DepthToSpace"
        else "a strided convolution"
    )
    remedy = f"move it right behind a convolution, or use {other}"
    return Finding(f"{op.op_type} stands behind {op.follows or 'the input'}", remedy)


def shuffle_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """Its smaller map has at most {limits[channels]} channels ({documents[operators]}, reorg)."""
    channels = max(op.channels[0], op.out_shape[0] if op.out_shape else 0)
    return _too_many(channels, dpu.channels_max, "shuffle in two steps, each behind a convolution")


def argmax_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """ArgMax compares at most {argmax[channels_max]} channels ({argmax[channels_max].source})."""
    return _too_many(
        op.channels[0],
        dpu.whole("argmax", "channels_max"),
        "leave it to the host, behind the network",
    )


def elementwise_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """Maps have at most {limits[channels]} channels ({documents[operators]})."""
    remedy = "add or multiply parts of the channels, and join them behind"
    return _too_many(op.out_shape[0] if op.out_shape else 0, dpu.channels_max, remedy)


def _too_many(channels: int, most: int, remedy: str) -> Finding | None:
    return None if channels <= most else Finding(f"{channels} channels: at most {most}", remedy)


def pool_kernel(op: Operation, dpu: Dpu) -> Finding | None:
    """Pool kernel sides are {pool[kernel]} ({pool[kernel].source})."""
    remedy = "pool in two steps, or a smaller tile where the pool is global"
    return beyond_range("kernel", op.kernel, dpu.limit("pool", "kernel"), remedy)


def pool_stride(op: Operation, dpu: Dpu) -> Finding | None:
    """Pool strides are {pool[stride]} ({pool[stride].source})."""
    limit = dpu.limit("pool", "stride")
    return beyond_range("stride", op.window.strides, limit, "pool in two steps")


def pool_padding(op: Operation, dpu: Dpu) -> Finding | None:
    """Pool padding is {pool[pad_begin]} at top and left, {pool[pad_end]} at bottom and right.

    Those are the ALU's limits ({pool[pad_end].source}).
    """
    return alu_padding(op, dpu, "pool")


def activation_place(op: Operation, dpu: Dpu) -> Finding | None:
    """Activations that are fused behind a convolution: {activations[conv]}
    ({activations[conv].source}).

    Behind a depthwise one: {activations[depthwise]} ({activations[depthwise].source}). Behind a
    pool: {activations[pool]} ({activations[pool].source}). Allowed behind any operation:
    {activations[alone]} ({activations[alone].source}).
    """
    place = PLACE.get(op.follows or "")
    # If another operator than a convolution reads the image, `quantize` inserts a convolution that
    # copies the image, mirrored or not.
    if op.follows in (None, "pad") and not op.integer:
        place = "conv"
    fused = dpu.target.activations[place].value if place else ()
    # An activation after a sum is checked by `activation_of_sums`.
    if place == "sum" or MANUAL[op.op_type] in (*fused, *dpu.target.activations["alone"].value):
        return None
    remedy = (
        f"use {' or '.join(fused)} there"
        if fused
        else "move it right behind the convolution or add before"
    )
    return Finding(f"{op.op_type} stands behind {op.follows or 'the input'}", remedy)


def activation_of_sums(op: Operation, dpu: Dpu) -> Finding | None:
    """Activations that are fused behind an add or a mul: {activations[sum]}
    ({activations[sum].source}).

    Allowed behind any operation: {activations[alone]}.
    """
    fused, alone = (dpu.target.activations[place].value for place in ("sum", "alone"))
    if PLACE.get(op.follows or "") != "sum" or MANUAL[op.op_type] in (*fused, *alone):
        return None
    return Finding(f"{op.op_type} stands behind {op.follows}", f"use {' or '.join(fused)} there")


def leaky_relu_alpha(op: Operation, dpu: Dpu) -> Finding | None:
    """LeakyReLU has alpha = 26 / 256 = {leaky_relu[alpha].low} ({documents[operators]},
    leaky_relu).
    """
    # ONNX defines 0.01 as the default of LeakyRelu.
    alpha = op.attributes.get("alpha", 0.01)
    dpu_alpha = dpu.value("leaky_relu", "alpha")
    is_leaky = op.op_type in ("LeakyRelu", "QLinearLeakyRelu")
    if not is_leaky or (isinstance(alpha, int | float) and abs(alpha - dpu_alpha) < 1e-6):
        return None
    reason = f"its alpha is {alpha}, but the DPU supports only {dpu_alpha}"
    remedy = f"train with alpha = {dpu_alpha}, or ReLU, or use 'quantize --adapt'"
    return Finding(reason, remedy)


def mul_constant(op: Operation, dpu: Dpu) -> Finding | None:
    """A constant factor is one number a channel, a 1 x 1 depthwise convolution
    ({documents[operators]}, mul).
    """
    shape = op.constant_shape or ()
    if sum(size > 1 for size in shape) <= 1 and (len(shape) < 2 or max(shape[-2:]) == 1):
        return None
    return Finding(
        f"a constant factor of shape {shape}", "use one factor a channel, shape (1, C, 1, 1)"
    )


CORNERS = "coordinate_transformation_mode"


def pad_mode(op: Operation, dpu: Dpu) -> Finding | None:
    """Padding is constant or symmetric; reflect runs on the CPU ({documents[operators]}, pad)."""
    mode = op.attributes.get("mode", "constant")
    if mode == "constant":
        return None
    return Finding(
        f"pad mode {mode}", "use zero padding inside the convolution, or pad the image on the host"
    )


def resize_mode(op: Operation, dpu: Dpu) -> Finding | None:
    """Resize is nearest without align_corners, or bilinear ({documents[operators]}, resize)."""
    mode = op.attributes.get("mode", "nearest")
    corners = op.attributes.get(CORNERS, "half_pixel")
    if mode == "linear" or (mode == "nearest" and corners != "align_corners"):
        return None
    return Finding(
        f"resize mode {mode} with {corners}", "use nearest with coordinate mode asymmetric"
    )


def resize_scale(op: Operation, dpu: Dpu) -> Finding | None:
    """Bilinear scales are one power of two, {resize[bilinear_scale]}
    ({resize[bilinear_scale].source}).

    With half-pixel centres {resize[half_pixel_scale]} ({resize[half_pixel_scale].source}).
    """
    before = op.in_shape
    after = op.out_shape
    if op.attributes.get("mode") != "linear" or before is None or after is None:
        return None
    # ONNX defines half_pixel as the default of Resize.
    half = op.attributes.get(CORNERS, "half_pixel") == "half_pixel"
    limit = dpu.limit("resize", "half_pixel_scale" if half else "bilinear_scale")
    scales = {after[1] / before[1], after[2] / before[2]}
    if scales <= {2.0, 4.0, 8.0} and len(scales) == 1 and limit.low <= min(scales) <= limit.high:
        return None
    reason = (
        f"bilinear scale {' x '.join(f'{s:g}' for s in sorted(scales))}, the DPU's are "
        f"powers of two, {limit}"
    )
    return Finding(reason, "scale by 2 several times, or use nearest")


def resize_channels(op: Operation, dpu: Dpu) -> Finding | None:
    """Resize takes at most {limits[channels]} channels ({documents[operators]})."""
    return _too_many(
        op.channels[0], dpu.channels_max, "reduce them with a 1 x 1 convolution before"
    )


def map_exists(op: Operation, dpu: Dpu) -> Finding | None:
    """The tile is large enough for every window: each map keeps at least one pixel (ONNX 1.17, Conv
    and MaxPool).
    """
    if op.kind not in WINDOWED or op.in_shape is None or op.out_shape is not None:
        return None
    window = f"a kernel of {shown(op.kernel)}, stride {shown(op.window.strides)}"
    reason = f"nothing is left of a map of {shown(op.in_shape[1:])} under {window}"
    return Finding(reason, "use a larger tile, or fewer strides before it")


def maps_aligned(op: Operation, dpu: Dpu) -> Finding | None:
    """Maps that meet in an add, mul or concat have one height and width, or 1 x 1 (ONNX 1.17, Add
    and Concat).
    """
    sizes = {(shape[1], shape[2]) for shape in op.in_shapes if shape is not None}
    # ONNX broadcasts a map of 1 x 1 over a larger one.
    if op.kind not in ("add", "mul", "concat") or len(sizes - {(1, 1)}) < 2:
        return None
    # Maps that are joined along their height or width may differ in it.
    if op.attributes.get("axis", 1) % 4 != 1:
        return None
    remedy = (
        "use a tile whose side is a multiple of the network's total stride, or pad the smaller map"
    )
    return Finding(" and ".join(map(shown, sorted(sizes))) + " meet", remedy)


def map_in_memory(op: Operation, dpu: Dpu) -> Finding | None:
    """A map, for all images of a batch, fits {tile[memory_bytes].low:.0f} bytes
    ({tile[memory_bytes].source}).
    """
    most = dpu.value("tile", "memory_bytes")
    size = math.prod(op.out_shape) * dpu.batch if op.out_shape else 0
    if size <= most:
        return None
    size_text, most_text = sizes(size, most)
    reason = f"{size_text} for {counted(dpu.batch, 'image')}, of {most_text}"
    # The size of a map grows with the square of the tile's side.
    return Finding(reason, f"use a tile of at most {math.sqrt(most / size):.2f} times this side")
