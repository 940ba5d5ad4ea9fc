"""Small networks as exporters write them, and the operators that remain after folding."""

from collections.abc import Mapping
from functools import cache
from itertools import chain
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper, parser

from beers_deploy.quant.domains import OPSET

CHANNELS = 4
WEIGHTS: dict[str, tuple[int, ...]] = {
    "w": (4, 4, 3, 3),
    "up": (4, 2, 2, 2),
    "deep": (4, 1, 3, 3),
    "halves": (6, 2, 3, 3),
    "twins": (8, 1, 1, 1),
    "one": (1, 4, 3, 3),
    "b": (4,),
    "image": (4, 1, 1),
    "square": (4, 4),
    "wide": (24, 5),
    "one_one": (1, 1, 3, 3),
    "taps": (1, 1, 3),
    "lengths": (4, 1, 1, 1),
    "matrix": (4, 36),
    "right": (36,),
    "left": (4,),
}
NUMBERS = {
    "zero": 0.0,
    "three": 3.0,
    "six": 6.0,
    "sixth": 1 / 6,
    "half": 0.5,
    "twice": [1.0, 1.0, 2.0, 2.0],
    "none": [],
    "pads": [0, 0, 1, 1, 0, 0, 1, 1],
    "around": [0, 0, 1, 2, 0, 0, 2, 1],
    "cropping": [0, 0, -1, -2, 0, 0, -1, -2],
    "small": [2, 4, 2, 3],
    "rows": [0, -1],
    "order": [2, 0, 3],
    "one_int": [1],
    "two": [2],
    "first": 0,
    "second": 1,
    "of_two": [2, 2, 2, 9, 11],
    "four": [4],
    "last": [9],
    "columns": [3],
    "one_three": [1, 3],
    "axes": [2, 3],
    "pixel": [[[[3.0]]]],
    "copies": [-1, 4, 0, 0],
    "starts": [0, 2, 1, 0],
    "stops": [2**31 - 1, -2, -1, 2**31 - 1],
    "four_axes": [0, 2, 3, 1],
    "map_again": [-1, 4, 1, 1],
    "copied": [0, 0],
    "again": [-1, 0, 1, 1],
    "four_channels": [1, 4, 1, 1],
}


@cache
def values() -> dict[str, np.ndarray]:
    """Return the constants of the networks; no random weight is 0 or 1."""
    rng = np.random.default_rng(3)
    tensors = {name: rng.uniform(0.3, 0.9, shape) for name, shape in WEIGHTS.items()}
    tensors |= {name: rng.uniform(0.5, 2, 4) for name in ("gain", "offset", "mean", "variance")}
    tensors |= {name: np.asarray(value) for name, value in NUMBERS.items()}
    return {name: single(value) for name, value in tensors.items()}


def single(value: ArrayLike) -> np.ndarray:
    """Return the value as an array, float32 if it is of any float type."""
    array = np.asarray(value)
    return array.astype(np.float32) if array.dtype.kind == "f" else array


def parsed(
    nodes: str, ends: str, opset: int = OPSET, constants: Mapping[str, Any] | None = None
) -> onnx.ModelProto:
    """Return a network from ONNX's own text format.

    Args:
        nodes: such as "y = Relu(x)"; a node without a name is named after its operator and
            result.
        ends: input and output, such as "float[N,4,H,W] x => float[N,4,H,W] y".
        opset: the version of ONNX's operators.
        constants: arrays that become initializers if a node reads them.
    """
    source, result = ends.split(" => ")
    domains = f'"": {opset}' + (', "com.microsoft": 1' if "com.microsoft" in nodes else "")
    model = parser.parse_model(
        f"<ir_version: 8, opset_import: [{domains}]> g ({source}) => ({result}) {{ {nodes} }}"
    )
    graph = model.graph
    for node in graph.node:
        node.name = node.name or f"{node.op_type} {node.output[0]}"
    reads = set(chain.from_iterable(node.input for node in graph.node))
    arrays = {name: single(value) for name, value in (constants or {}).items() if name in reads}
    graph.initializer.extend(numpy_helper.from_array(*item[::-1]) for item in arrays.items())
    return model


def network_from(
    nodes: str,
    opset: int = OPSET,
    kind: str = "float",
    ends: str = "",
    **constants: Any,
) -> onnx.ModelProto:
    """Return a network from `x` (N, 4, H, W) to `y`, with the constants of `values` and others.

    Args:
        nodes: in ONNX's text format.
        opset: the version of ONNX's operators.
        kind: the type of image, weights and results.
        ends: as in `parsed`; by default those of `x` and `y`.
        constants: further constants, by name.
    """
    ends = ends or f"{kind}[N,{CHANNELS},H,W] x => {kind}[N,C,H2,W2] y"
    model = parsed(nodes, ends, opset, {**values(), **constants})
    if kind != "float":
        number = TensorProto.DataType.Value(kind.upper())
        dtype = helper.tensor_dtype_to_np_dtype(number)
        for tensor in model.graph.initializer:
            array = numpy_helper.to_array(tensor).astype(dtype)
            tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
    return model


CONV = "c = Conv<pads=[1,1,1,1]>(x, w) "
NORMAL = "= BatchNormalization(c, gain, offset, mean, variance) "
SAME = "Conv<pads=[1,1,1,1]>"
CASES: dict[str, tuple[str, dict[str, int]]] = {
    "normalised and scaled again": (
        """n = BatchNormalization(x, gain, offset, mean, variance)
        m = Mul(n, image)
        y = Add(m, image)""",
        {"Conv": 1},
    ),
    "scaled in front of two": (
        f"m = Mul(x, six) c = {SAME}(m, w) d = {SAME}(m, w) y = Add(c, d)",
        {"Conv": 2, "Add": 1},
    ),
    "scaled, and read elsewhere": (
        f"m = Mul(x, image) c = {SAME}(m, w) y = Add(c, m)",
        {"Mul": 1, "Conv": 1, "Add": 1},
    ),
    "divided, and read elsewhere": (
        f"m = Div(x, image) c = {SAME}(m, w) y = Add(c, m)",
        {"Conv": 2, "Add": 1},
    ),
    "one channel times four constants": (
        f"c = {SAME}(x, one) m = Mul(c, image) y = {SAME}(m, w)",
        {"Conv": 3},
    ),
    "maximum, minimum and absolute value": (
        f"{CONV} m = Max(x, c) n = Min(m, c) y = Abs(n)",
        {"Conv": 2, "Add": 5, "Mul": 3, "Relu": 4},
    ),
    "a lerp": (
        f"""{CONV} near = Less(half, sixth) d = Sub(c, x) e = Mul(d, half) f = Add(x, e)
        g = Mul(d, sixth) h = Sub(c, g) y = Where(near, f, h)""",
        {"Conv": 1, "Add": 2, "Mul": 3},
    ),
    "a partial convolution": (
        f"""k, l = Split<axis=1>(x, one_three) m = {SAME}(k, one_one) d = Concat<axis=1>(m, l)
        e = {SAME}(d, w) y = Add(e, x)""",
        {"Conv": 2, "Concat": 1, "Add": 1},
    ),
    "weights by their norm": (
        """n = ReduceL2<axes=[1,2,3]>(w) d = Div(w, n) v = Mul(d, lengths)
        y = Conv<pads=[1,1,1,1]>(x, v)""",
        {"Conv": 1},
    ),
    "weights without their mean": (
        """n = ReduceMean<axes=[1,2,3]>(w) d = Sub(w, n) s = Mul(d, d) t = ReduceSum(s) r = Sqrt(t)
        v = Div(d, r) y = Conv<pads=[1,1,1,1]>(x, v)""",
        {"Conv": 1},
    ),
    "weights by their spectral norm": (
        """m = MatMul(matrix, right) s = MatMul(left, m) v = Div(w, s)
        y = Conv<pads=[1,1,1,1]>(x, v)""",
        {"Conv": 1},
    ),
    "the negative of a map": (
        f"{CONV} n = Neg(x) m = Neg(c) a = Add(n, m) y = Mul(a, x)",
        {"Conv": 2, "Add": 1, "Mul": 1},
    ),
    "ReLU of the scaled image": (
        f"m = Mul(x, six) n = Sub(m, half) r = Relu(n) y = {SAME}(r, w)",
        {"Conv": 2, "Relu": 1},
    ),
    "activations behind sums and products": (
        """c = Clip(x, zero, six) a = Add(c, x) k = Clip(a, zero, six) d = Mul(k, x) e = Relu(d)
        y = Add(e, x)""",
        {"Clip": 2, "Add": 2, "Mul": 1, "Relu": 1, "Conv": 2},
    ),
    "depthwise, with two results a channel": ("y = Conv<group=4>(x, twins)", {"Conv": 1}),
    "channels in another order": (f"{CONV} y = Gather<axis=1>(c, order)", {"Conv": 1}),
    "ReLU6 in two steps": (
        f"{CONV} k = Max(c, zero) l = Min(six, k) y = {SAME}(l, w)",
        {"Conv": 2, "Clip": 1},
    ),
    "clipped at the end": (f"{CONV} k = Max(c, half) y = Min(k, pixel)", {"Conv": 1, "Clip": 1}),
    "scaled behind such a clip": (
        f"{CONV} k = Min(c, three) l = Max(k, half) y = Mul(l, six)",
        {"Conv": 1, "Clip": 1},
    ),
    "two groups": ("y = Conv<pads=[1,1,1,1], group=2>(x, halves)", {"Conv": 1}),
    "two groups, enlarged with output padding": (
        """y = ConvTranspose<strides=[2,3], group=2, pads=[0,1,0,1],
        output_padding=[1,2]>(x, up)""",
        {"ConvTranspose": 1},
    ),
    "a residual subtracted": (f"{CONV} y = Sub(x, c)", {"Conv": 1, "Add": 1}),
    "the image subtracted from a convolution": (
        f"{CONV} y = Sub(c, x)",
        {"Conv": 1, "Mul": 1, "Add": 1},
    ),
    "normalised, and read elsewhere": (f"{CONV} n {NORMAL} y = Add(c, n)", {"Conv": 2, "Add": 1}),
    "added to the normalised image": (
        f"""m = Mul(x, image) n = Sub(m, half) c = {SAME}(n, w) a = Add(n, c)
        p = Add(a, half) y = Div(p, image)""",
        {"Mul": 1, "Sub": 1, "Conv": 1, "Add": 1},
    ),
    "subtracted from the normalised image": (
        f"""m = Mul(x, six) n = Sub(m, half) c = {SAME}(n, w) a = Sub(n, c)
        p = Add(a, half) y = Div(p, six)""",
        {"Mul": 1, "Sub": 1, "Conv": 1, "Add": 1},
    ),
    "clipped, and subtracted from 3": (
        f"{CONV} a = Add(c, x) k = Clip(a, zero, half) y = Sub(three, k)",
        {"Mul": 1, "Conv": 1, "Add": 2, "Clip": 1},
    ),
    "added to the normalised image, without scaling back": (
        f"m = Mul(x, six) n = Sub(m, half) c = {SAME}(n, w) a = Add(n, c) y = Add(a, half)",
        {"Mul": 1, "Sub": 1, "Conv": 1, "Add": 2},
    ),
    "clipped in another range": (
        f"m = Mul(x, six) c = {SAME}(m, w) a = Add(c, m) k = Clip(a, zero, six) y = Div(k, six)",
        {"Conv": 1, "Add": 1, "Clip": 1},
    ),
    "one channel times four": (
        f"c = {SAME}(x, one) d = {SAME}(x, w) y = Mul(c, d)",
        {"Conv": 3, "Mul": 1},
    ),
    "four channels subtracted from one": (
        f"c = {SAME}(x, one) r = Relu(x) d = Sub(c, r) y = Mul(d, r)",
        {"Conv": 2, "Relu": 1, "Add": 1, "Mul": 2},
    ),
    "one channel plus four": (
        f"c = {SAME}(x, one) d = {SAME}(x, w) y = Add(c, d)",
        {"Conv": 3, "Add": 1},
    ),
    "added, clipped and scaled again": (
        f"""m = Mul(x, six) n = Sub(m, half) c = {SAME}(n, w) a = Add(n, c) p = Add(a, half)
        k = Clip(p, zero, six) y = Mul(k, six)""",
        {"Mul": 2, "Sub": 1, "Conv": 1, "Add": 2, "Clip": 1},
    ),
    "one channel four times": (
        f"c = {SAME}(x, one) t = Tile(c, four_channels) y = Mul(t, x)",
        {"Conv": 2, "Mul": 1},
    ),
    "a square": (f"{CONV} y = Pow(c, two)", {"Conv": 1, "Mul": 1}),
    "zero padding": ("p = Pad(x, pads) y = Conv(p, w)", {"Conv": 1}),
    "uneven zero padding": ("p = Pad(x, around) y = Conv(p, w)", {"Conv": 1}),
    "mirrored padding": ('p = Pad<mode="reflect">(x, pads) y = Conv(p, w)', {"Pad": 1, "Conv": 1}),
    "ReLU6": (f"{CONV} y = Clip(c, zero, six)", {"Conv": 1, "Clip": 1}),
    "HardSwish": (
        "h = HardSigmoid<alpha=0.16666667, beta=0.5>(x) y = Mul(h, x)",
        {"HardSwish": 1},
    ),
    "ReLU, clipped on one side": (f"{CONV} y = Clip(c, zero)", {"Conv": 1, "Relu": 1}),
    "ReLU as a maximum": (f"{CONV} y = Max(zero, c)", {"Conv": 1, "Relu": 1}),
    "HardSwish spelled out": (
        f"{CONV} a = Add(c, three) k = Clip(a, zero, six) h = Div(k, six) y = Mul(c, h)",
        {"Conv": 1, "HardSwish": 1},
    ),
    "HardSwish that divides last": (
        f"{CONV} a = Add(three, c) k = Clip(a, zero, six) p = Mul(k, c) y = Mul(p, sixth)",
        {"Conv": 1, "HardSwish": 1},
    ),
    "split behind a depthwise convolution": (
        f"""{CONV}
        d = Conv<pads=[1,1,1,1], group=4>(c, deep)
        r = Relu(d)
        s, t = Split<axis=1>(r, one_three)
        y = Concat<axis=1>(t, s)""",
        {"Conv": 4, "Relu": 2, "Concat": 1},
    ),
    "split, and read whole": (
        f"{CONV} s, t = Split<axis=1>(c, one_three) j = Concat<axis=1>(t, s) y = Mul(j, c)",
        {"Conv": 3, "Concat": 1, "Mul": 1},
    ),
    "slices of channels": (
        f"{CONV} s = Slice(c, one_int, last, one_int) y = Sigmoid(s)",
        {"Conv": 1, "Sigmoid": 1},
    ),
    "a slice of the image": ("y = Slice(x, one_int, last, one_int)", {"Conv": 1}),
    "a gate of another slope": (
        "h = HardSigmoid<alpha=0.2, beta=0.5>(x) y = Mul(h, x)",
        {"HardSigmoid": 1, "Mul": 1},
    ),
    "a mean over the image": ("y = ReduceMean<axes=[-1,2]>(x)", {"GlobalAveragePool": 1}),
    "a mean, fully connected": (
        """m = ReduceMean<axes=[2,3], keepdims=0>(x)
        g = Gemm<transB=1>(m, square, b)
        u = Unsqueeze(g, two)
        y = Unsqueeze(u, columns)""",
        {"GlobalAveragePool": 1, "Conv": 1},
    ),
    "a mean, scaled and restored to a map": (
        """m = ReduceMean<axes=[2,3], keepdims=0>(x)
        d = Mul(m, six)
        y = Reshape(d, map_again)""",
        {"GlobalAveragePool": 1, "Mul": 1},
    ),
    "a mean, fully connected, of copied sizes": (
        "m = GlobalAveragePool(x) f = Reshape(m, copied) g = Gemm(f, square) y = Reshape(g, again)",
        {"GlobalAveragePool": 1, "Conv": 1},
    ),
    "a mean over channels": ("y = ReduceMean<axes=[1]>(x)", {"Conv": 1}),
    "cropped by negative pads": (
        "p = Pad(x, cropping) y = Conv(p, w)",
        {"Conv": 2},
    ),
    # CBAM's spatial attention.
    "the largest channel, whose axis is dropped": (
        "m = ReduceMax<axes=[1], keepdims=0>(x) y = Unsqueeze(m, one_int)",
        {"Conv": 4, "Relu": 2, "Add": 2},
    ),
    "the largest channel": ("y = ReduceMax<axes=[1]>(x)", {"Conv": 4, "Relu": 2, "Add": 2}),
    "the largest of three channels": (
        "s = Slice(x, one_int, last, one_int) y = ReduceMax<axes=[-3]>(s)",
        {"Conv": 4, "Relu": 2, "Add": 2},
    ),
    "the largest pixel": (
        "s = Resize(x, , , small) m = ReduceMax<axes=[2,3]>(s) g = GlobalMaxPool(s) y = Add(m, g)",
        {"Resize": 1, "MaxPool": 2, "Add": 1},
    ),
    "attention of neighbouring channels": (
        """p = GlobalAveragePool(x)
        q = Squeeze(p, columns)
        t = Transpose<perm=[0,2,1]>(q)
        c = Conv<pads=[1,1]>(t, taps)
        r = HardSwish(c)
        s = Transpose<perm=[0,2,1]>(r)
        u = Unsqueeze(s, columns)
        y = Mul(u, x)""",
        {"GlobalAveragePool": 1, "Conv": 1, "HardSwish": 1, "Mul": 1},
    ),
    "a soft threshold": (
        """s = Sign(x)
        a = Abs(x)
        d = Sub(a, half)
        r = Relu(d)
        y = Mul(r, s)""",
        {"Conv": 2, "Mul": 1, "Relu": 2, "Add": 1},
    ),
    "a Reshape that copies": (f"{CONV} r = Reshape(c, copies) y = {SAME}(r, w)", {"Conv": 2}),
    "a crop that names all axes": (
        f"{CONV} s = Slice(c, starts, stops, four_axes) y = Relu(s)",
        {"Conv": 2, "Relu": 1},
    ),
    "three summed": (f"{CONV} d = {SAME}(c, w) y = Sum(x, c, d)", {"Conv": 2, "Add": 2}),
    "operators without an effect": (
        f"i = Identity(x) c = {SAME}(i, w) d = Dropout(c) y = Cast<to=1>(d)",
        {"Conv": 1},
    ),
    "a Reshape to the same size": (
        f"s = Resize(x, , , small) r = Reshape(s, small) y = {SAME}(r, w)",
        {"Resize": 1, "Conv": 1},
    ),
    "sizes computed from constants": (
        """z = ConstantOfShape<value = int64[1] {0}>(two)
        e = Slice(around, two, four)
        sizes = Concat<axis=0>(z, e, z, e)
        p = Pad(x, sizes)
        y = Conv(p, w)""",
        {"Conv": 1},
    ),
    "fully connected": (
        """m = MaxPool<kernel_shape=[9,11]>(x)
        p = GlobalAveragePool(m)
        f = Flatten(p)
        g = Gemm<transB=1, alpha=0.5, beta=2.0>(f, square, b)
        r = Relu(g)
        h = Gemm(r, square)
        y = Unsqueeze(h, axes)""",
        {"MaxPool": 1, "GlobalAveragePool": 1, "Conv": 2, "Relu": 1},
    ),
    "fully connected to a map of known size": (
        "s = Resize(x, , , small) f = Reshape(s, rows) g = Gemm(f, wide) y = Unsqueeze(g, axes)",
        {"Resize": 1, "Conv": 1},
    ),
    "probabilities of classes": (
        """l = Mul(x, six)
        m = MaxPool<kernel_shape=[9,11]>(l)
        p = GlobalAveragePool(m)
        f = Flatten(p)
        s = Softmax<axis=1>(f)
        y = Reshape(s, map_again)""",
        {"Mul": 1, "MaxPool": 1, "GlobalAveragePool": 1, "Softmax": 1},
    ),
    "equal layers": (f"{CONV} d = {SAME}(x, w) y = Add(c, d)", {"Conv": 2, "Add": 1}),
}
