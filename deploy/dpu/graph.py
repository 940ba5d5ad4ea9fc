"""A network as the DPU sees it: a short list of operations, independent of the encoding of its ONNX
file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from beers_deploy.dpu.shapes import Kind, Shape
from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.graph.quantized import Scale
from beers_deploy.quant.onnx.window import Pair, Window

CONVOLUTIONS = frozenset({"conv", "grouped conv", "depthwise", "transposed"})


@dataclass(frozen=True)
class Operation:
    """One node: the operation, the activations that it reads and writes, and its numbers.

    `inputs` and `outputs` name activations. `integer` is True if the file already computes the node
    on integers.
    """

    name: str
    op_type: str
    kind: Kind
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    in_shapes: tuple[Shape | None, ...] = ()
    out_shape: Shape | None = None
    kernel: Pair = (1, 1)
    window: Window = field(default_factory=Window)
    channels: tuple[int, int] = (0, 0)  # input, output
    weight_bytes: int = 0
    constant_shape: tuple[int, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    follows: Kind | None = None  # what computes the first input
    integer: bool = False
    # The keys are "input 0", ..., "weight", "bias" and "output".
    scales: Mapping[str, Scale] = field(default_factory=dict)
    # The roles for which the file gives several scales.
    disputed: Mapping[str, tuple[Scale, ...]] = field(default_factory=dict)
    # None stands for a constant that other nodes compute.
    constants: Mapping[str, np.ndarray | None] = field(default_factory=dict, compare=False)

    @property
    def output(self) -> str:
        """Return the name of the first result."""
        return self.outputs[0]

    @property
    def operations(self) -> int:
        """Return the int8 operations for one image: 2 kh kw ic oc h w per group, or 0 if no
        products are summed.
        """
        if self.kind not in CONVOLUTIONS:
            return 0
        # A transposed convolution multiplies the weights with each pixel of its input.
        shape = self.in_shapes[0] if self.kind == "transposed" else self.out_shape
        # A weight has one byte and is used once a pixel: a product and a sum are two operations.
        return 2 * self.weight_bytes * _pixels(self.name, shape)

    @property
    def out_bytes(self) -> int:
        """Return the size of the result as int8."""
        return _pixels(self.name, self.out_shape) * (self.out_shape or (0,))[0]


@dataclass(frozen=True)
class SizedGraph:
    """Operations in order, the names and shapes of the inputs, and the names of the outputs."""

    operations: tuple[Operation, ...]
    inputs: Mapping[str, Shape]
    outputs: tuple[str, ...]
    quantized: bool


def _pixels(name: str, shape: Shape | None) -> int:
    if shape is None:
        raise ModelError(
            f"The shape of {printable(name)} cannot be computed from the shape of the input. "
            "Replace the node before it that hides the shape."
        )
    return shape[1] * shape[2]
