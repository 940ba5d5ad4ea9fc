"""Reading and checking takes a number of steps that is linear in the number of nodes, whatever way
it goes.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.verbs.check import check

TraceFunction = Callable[[FrameType, str, Any], Any]

FEWEST = 60
"""Nodes: the number is doubled twice."""
QUADRATIC = 2.5
"""A linear step takes twice as many more for the second doubling as for the first, a quadratic one
four times.
"""


CHANNELS = 8
WEIGHT = np.random.default_rng(0).normal(0, 0.05, (CHANNELS, CHANNELS, 3, 3)).astype(np.float32)
SHUFFLED = ((0, 2, 2, 2, 64, 64), (0, 2, 128, 128))
"""Two shapes by which exporters spell a pixel shuffle."""


class Chain:
    """A network under construction; `last` is the tensor that it has come to."""

    def __init__(self) -> None:
        self.last = "image"
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def then(
        self, op_type: str, *inputs: str, domain: str = "", **attributes: int | list[int]
    ) -> str:
        """Append a node of these inputs, or of the last tensor, and return its result."""
        sources = list(inputs or (self.last,))
        self.last = f"{op_type}{len(self.nodes)}"
        node = helper.make_node(op_type, sources, [self.last], name=self.last, domain=domain)
        node.attribute.extend(
            helper.make_attribute(key, value) for key, value in attributes.items()
        )
        self.nodes.append(node)
        return self.last

    def constant(self, value: object) -> str:
        """Add a constant and return its name."""
        name = f"constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def convolve(self) -> str:
        """Append a convolution with weights of its own."""
        return self.then("Conv", self.last, self.constant(WEIGHT), pads=[1] * 4)

    def model(self) -> onnx.ModelProto:
        """Return the network that ends with the last tensor."""
        image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["N", CHANNELS, "H", "W"])
        result = helper.make_tensor_value_info(self.last, TensorProto.FLOAT, ["N", "C", "H2", "W2"])
        graph = helper.make_graph(self.nodes, "chain", [image], [result], self.constants)
        opsets = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=8)


def residual(chain: Chain) -> None:
    """Add a convolution with a ReLU to what it reads."""
    before = chain.last
    chain.convolve()
    chain.then("Add", before, chain.then("Relu"))


def scaled(chain: Chain) -> None:
    """Scale each channel in front of a convolution, which takes the scale in."""
    chain.then("Relu")
    chain.then("Mul", chain.last, chain.constant(np.full((1, CHANNELS, 1, 1), 0.9, np.float32)))
    chain.convolve()


def pointwise(chain: Chain) -> None:
    """Change values by themselves, one node after the other."""
    chain.then("Relu")
    chain.then("Mul", chain.last, chain.constant(np.float32(0.99)))
    chain.then("Sigmoid")


def shuffled(chain: Chain) -> None:
    """Spell a pixel shuffle as exporters do, and take it back."""
    chain.then("Reshape", chain.last, chain.constant(np.array(SHUFFLED[0])))
    chain.then("Transpose", perm=[0, 1, 4, 2, 5, 3])
    chain.then("Reshape", chain.last, chain.constant(np.array(SHUFFLED[1])))
    chain.then("SpaceToDepth", blocksize=2)
    chain.convolve()


def integers(chain: Chain) -> None:
    """Convolve, rectify and add on integers."""
    if chain.last == "image":
        values: dict[str, np.ndarray] = {
            "scale": np.array(1 / 64, np.float32),
            "zero": np.array(64, np.uint8),
            "weight_zero": np.array(0, np.int8),
            "weight": np.clip(WEIGHT * 64, -127, 127).astype(np.int8),
            "bias": np.zeros(CHANNELS, np.int32),
        }
        chain.constants.extend(
            numpy_helper.from_array(value, name) for name, value in values.items()
        )
        chain.then("QuantizeLinear", "image", "scale", "zero")
    before = chain.last
    constants = ("scale", "zero")
    weights = ("weight", "scale", "weight_zero", *constants, "bias")
    chain.then("QLinearConv", before, *constants, *weights, pads=[1] * 4)
    chain.then("Max", chain.last, "zero")
    chain.then(
        "QLinearAdd", before, *constants, chain.last, *constants, *constants, domain="com.microsoft"
    )


KINDS: tuple[Callable[[Chain], None], ...] = (residual, scaled, pointwise, shuffled, integers)


def network(kind: Callable[[Chain], None], nodes: int) -> onnx.ModelProto:
    """Return a chain of blocks of a kind, with at least so many nodes."""
    chain = Chain()
    while len(chain.nodes) < nodes:
        kind(chain)
    return chain.model()


def steps(model: onnx.ModelProto, path: Path) -> int:
    """Count the instructions of Python that this package carries out; time would depend on the
    machine.
    """
    onnx.save_model(model, path)
    count = 0

    def step(_frame: FrameType, event: str, _argument: object) -> TraceFunction:
        nonlocal count
        count += event == "opcode"
        return step

    def called(frame: FrameType, _event: str, _argument: object) -> TraceFunction | None:
        if not str(frame.f_globals.get("__name__")).startswith("beers_deploy"):
            return None
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False
        return step

    before = sys.gettrace()
    sys.settrace(called)
    try:
        check(path)
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_steps_grow_with_the_nodes(kind: Callable[[Chain], None], tmp_path: Path) -> None:
    # The first call also counts what is read once a process.
    steps(network(kind, FEWEST), tmp_path / "a.onnx")
    few, more, most = (
        steps(network(kind, FEWEST * times), tmp_path / "a.onnx") for times in (1, 2, 4)
    )
    assert most - more < QUADRATIC * (more - few)
