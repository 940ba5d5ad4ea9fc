"""Small networks as exporters leave them, and what is left of each once it is folded."""

from collections.abc import Sequence
from functools import cache
from itertools import chain
from typing import Any

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper

from beers_deploy.quant.domains import OPSET

CHANNELS = 4
WEIGHTS: dict[str, tuple[int, ...]] = {
    "w": (4, 4, 3, 3),
    "up": (4, 2, 2, 2),
    "deep": (4, 1, 3, 3),
    "one": (1, 4, 3, 3),
    "b": (4,),
    "image": (4, 1, 1),
    "square": (4, 4),
    "wide": (24, 5),
}


@cache
def values() -> dict[str, np.ndarray]:
    """Numbers of no special value: none is 0 or 1."""
    rng = np.random.default_rng(3)
    tensors = {
        name: rng.uniform(0.3, 0.9, shape).astype(np.float32) for name, shape in WEIGHTS.items()
    }
    tensors |= {
        name: rng.uniform(0.5, 2, (4,)).astype(np.float32)
        for name in ("gain", "offset", "mean", "variance")
    }
    tensors |= {
        "six": np.array(6, np.float32),
        "zero": np.array(0, np.float32),
        "pads": np.array([0, 0, 1, 1, 0, 0, 1, 1]),
    }
    tensors |= {
        "around": np.array([0, 0, 1, 2, 0, 0, 2, 1]),
        "twice": np.array([1, 1, 2, 2], np.float32),
    }
    tensors |= {"small": np.array([2, 4, 2, 3]), "rows": np.array([0, -1])}
    tensors |= {"two": np.array([2]), "four": np.array([4])}
    tensors |= {"map again": np.array([-1, 4, 1, 1])}
    tensors |= {"three": np.array(3, np.float32), "sixth": np.array(1 / 6, np.float32)}
    tensors |= {"1 and 3": np.array([1, 3]), "channels": np.array([1]), "last": np.array([9])}
    tensors |= {"axes": np.array([2, 3]), "roi": np.zeros(0, np.float32)}
    return tensors


def made(
    nodes: Sequence[NodeProto],
    opset: int = OPSET,
    kind: int = TensorProto.FLOAT,
    outputs: Sequence[str] = ("y",),
) -> onnx.ModelProto:
    """A network from `x` (N, 4, H, W) to `y`, with the named numbers it reads as initializers of
    this kind.
    """
    inputs = set(chain.from_iterable(node.input for node in nodes))
    initializers = [
        numpy_helper.from_array(value, name) for name, value in values().items() if name in inputs
    ]
    if kind != TensorProto.FLOAT:
        initializers = [tensor_as(tensor, kind) for tensor in initializers]
    x = helper.make_tensor_value_info("x", kind, ["N", CHANNELS, "H", "W"])
    ends = [helper.make_tensor_value_info(name, kind, ["N", "C", "H2", "W2"]) for name in outputs]
    graph = helper.make_graph(list(nodes), "made", [x], ends, initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)


def tensor_as(tensor: TensorProto, kind: int) -> TensorProto:
    array = numpy_helper.to_array(tensor).astype(helper.tensor_dtype_to_np_dtype(kind))
    return numpy_helper.from_array(array, tensor.name)


def node(kind: str, *inputs: str, to: str = "y", **attributes: Any) -> NodeProto:
    return helper.make_node(kind, inputs, [to], name=f"{kind} {to}", **attributes)


def conv(
    source: str = "x", to: str = "c", weight: str = "w", pad_px: int = 1, group: int = 1
) -> NodeProto:
    return node("Conv", source, weight, to=to, pads=[pad_px] * 4, group=group)


def normal(source: str = "c", to: str = "y") -> NodeProto:
    return node("BatchNormalization", source, "gain", "offset", "mean", "variance", to=to)


CASES: dict[str, tuple[list[NodeProto], dict[str, int]]] = {
    "normalised and scaled again": (
        [normal("x", "n"), node("Mul", "n", "image", to="m"), node("Add", "m", "image")],
        {"Conv": 1},
    ),
    "scaled in front of two": (
        [node("Mul", "x", "six", to="m"), conv("m", "c"), conv("m", "d"), node("Add", "c", "d")],
        {"Conv": 2, "Add": 1},
    ),
    "scaled, and read elsewhere": (
        [node("Mul", "x", "image", to="m"), conv("m", "c"), node("Add", "c", "m")],
        {"Mul": 1, "Conv": 1, "Add": 1},
    ),
    "one channel times four constants": (
        [conv(weight="one"), node("Mul", "c", "image", to="m"), conv("m", "y")],
        {"Conv": 2, "Mul": 1},
    ),
    "a residual taken away": ([conv(), node("Sub", "x", "c")], {"Conv": 1, "Add": 1}),
    "a convolution less the image": ([conv(), node("Sub", "c", "x")], {"Conv": 2, "Add": 1}),
    "normalised, and read elsewhere": (
        [conv(), normal("c", "n"), node("Add", "c", "n")],
        {"Conv": 2, "Add": 1},
    ),
    "zeros around": ([node("Pad", "x", "pads", to="p"), conv("p", "y", pad_px=0)], {"Conv": 1}),
    "zeros around, lopsided": (
        [node("Pad", "x", "around", to="p"), conv("p", "y", pad_px=0)],
        {"Conv": 1},
    ),
    "a mirror around": (
        [node("Pad", "x", "pads", to="p", mode="reflect"), conv("p", "y", pad_px=0)],
        {"Pad": 1, "Conv": 1},
    ),
    "ReLU6": ([conv(), node("Clip", "c", "zero", "six")], {"Conv": 1, "Clip": 1}),
    "HardSwish": (
        [node("HardSigmoid", "x", to="h", alpha=1 / 6, beta=0.5), node("Mul", "h", "x")],
        {"HardSwish": 1},
    ),
    "ReLU, clipped on one side": ([conv(), node("Clip", "c", "zero")], {"Conv": 1, "Relu": 1}),
    "ReLU as the larger of two": ([conv(), node("Max", "zero", "c")], {"Conv": 1, "Relu": 1}),
    "HardSwish spelled out": (
        [
            conv(),
            node("Add", "c", "three", to="a"),
            node("Clip", "a", "zero", "six", to="k"),
            node("Div", "k", "six", to="h"),
            node("Mul", "c", "h"),
        ],
        {"Conv": 1, "HardSwish": 1},
    ),
    "HardSwish, its sixth at the end": (
        [
            conv(),
            node("Add", "three", "c", to="a"),
            node("Clip", "a", "zero", "six", to="k"),
            node("Mul", "k", "c", to="p"),
            node("Mul", "p", "sixth"),
        ],
        {"Conv": 1, "HardSwish": 1},
    ),
    "split behind a depthwise convolution": (
        [
            conv(),
            conv("c", "d", "deep", group=4),
            node("Relu", "d", to="r"),
            helper.make_node("Split", ["r", "1 and 3"], ["s", "t"], axis=1),
            node("Concat", "t", "s", axis=1),
        ],
        {"Conv": 4, "Relu": 2, "Concat": 1},
    ),
    "split, and read whole": (
        [
            conv(),
            helper.make_node("Split", ["c", "1 and 3"], ["s", "t"], axis=1),
            node("Concat", "t", "s", to="j", axis=1),
            node("Mul", "j", "c"),
        ],
        {"Conv": 3, "Concat": 1, "Mul": 1},
    ),
    "slices of channels": (
        [
            conv(),
            node("Slice", "c", "channels", "last", "channels", to="s"),
            node("Sigmoid", "s"),
        ],
        {"Conv": 1, "Sigmoid": 1},
    ),
    "a slice of the image": (
        [node("Slice", "x", "channels", "last", "channels")],
        {"Conv": 1},
    ),
    "a gate of another slope": (
        [node("HardSigmoid", "x", to="h", alpha=0.2, beta=0.5), node("Mul", "h", "x")],
        {"HardSigmoid": 1, "Mul": 1},
    ),
    "a mean over the image": ([node("ReduceMean", "x", axes=[-1, 2])], {"GlobalAveragePool": 1}),
    "the same, flat": (
        [node("ReduceMean", "x", to="m", axes=[2, 3], keepdims=0), node("Unsqueeze", "m", "axes")],
        {"GlobalAveragePool": 1, "Flatten": 1, "Unsqueeze": 1},
    ),
    "a mean, fully connected": (
        [
            node("ReduceMean", "x", to="m", axes=[2, 3], keepdims=0),
            node("Gemm", "m", "square", "b", to="g", transB=1),
            node("Unsqueeze", "g", "axes"),
        ],
        {"GlobalAveragePool": 1, "Conv": 1, "Flatten": 1, "Unsqueeze": 1},
    ),
    "a mean over channels": ([node("ReduceMean", "x", axes=[1])], {"ReduceMean": 1}),
    "three summed": ([conv(), conv("c", "d"), node("Sum", "x", "c", "d")], {"Conv": 2, "Add": 2}),
    "what does nothing": (
        [
            node("Identity", "x", to="i"),
            conv("i"),
            node("Dropout", "c", to="d"),
            helper.make_node("Cast", ["d"], ["y"], name="cast", to=TensorProto.FLOAT),
        ],
        {"Conv": 1},
    ),
    "sizes of constants": (
        [
            node(
                "ConstantOfShape",
                "two",
                to="none",
                value=numpy_helper.from_array(np.zeros(1, np.int64)),
            ),
            node("Slice", "around", "two", "four", to="end"),
            node("Concat", "none", "end", "none", "end", to="sizes", axis=0),
            node("Pad", "x", "sizes", to="p"),
            conv("p", "y", pad_px=0),
        ],
        {"Conv": 1},
    ),
    "fully connected": (
        [
            node("MaxPool", "x", to="m", kernel_shape=[9, 11]),
            node("GlobalAveragePool", "m", to="p"),
            node("Flatten", "p", to="f"),
            node("Gemm", "f", "square", "b", to="g", transB=1, alpha=0.5, beta=2.0),
            node("Relu", "g", to="r"),
            node("Gemm", "r", "square", to="h"),
            node("Unsqueeze", "h", "axes"),
        ],
        {"MaxPool": 1, "GlobalAveragePool": 1, "Conv": 2, "Relu": 1, "Flatten": 1, "Unsqueeze": 1},
    ),
    "fully connected to a map of known size": (
        [
            node("Resize", "x", "", "", "small", to="s"),
            node("Reshape", "s", "rows", to="f"),
            node("Gemm", "f", "wide", to="g"),
            node("Unsqueeze", "g", "axes"),
        ],
        {"Resize": 1, "Conv": 1, "Flatten": 1, "Unsqueeze": 1},
    ),
    "shares of classes": (
        [
            node("Mul", "x", "six", to="l"),
            node("MaxPool", "l", to="m", kernel_shape=[9, 11]),
            node("GlobalAveragePool", "m", to="p"),
            node("Flatten", "p", to="f"),
            node("Softmax", "f", to="s", axis=1),
            node("Reshape", "s", "map again"),
        ],
        {"Mul": 1, "MaxPool": 1, "GlobalAveragePool": 1, "Softmax": 1},
    ),
    "equal layers": ([conv(), conv(to="d"), node("Add", "c", "d")], {"Conv": 2, "Add": 1}),
}
