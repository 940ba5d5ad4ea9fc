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
    """One operation of a network, as the checker and the cost model read it.

    An activation is a tensor that depends on the image, in contrast to weights and constants. A
    role is the use of a tensor by the node: "input 0", "input 1", ..., "weight", "bias", "output".

    Attributes:
        name: the name of the ONNX node.
        op_type: the ONNX operator, such as "QLinearConv".
        kind: the kind of operation, whatever the encoding of the file.
        inputs: the names of the activations that the node reads.
        outputs: the names of the activations that it writes.
        in_shapes: the shape (C, H, W) of each input; None if unknown.
        out_shape: the shape (C, H, W) of the first output; None if unknown.
        kernel: height and width of the kernel; (1, 1) without one.
        window: strides, pads and dilations of the kernel.
        channels: the numbers of input and output channels.
        weight_bytes: the number of weights, which have a byte each in int8.
        constant_shape: the shape of an element-wise operator's constant operand; None without one.
        attributes: the ONNX attributes.
        follows: the kind of the operation that writes the first input; None for the network's
            input.
        integer: True if the file computes the node on integers.
        scales: the number format (scale and zero point) of each quantised tensor, by role.
        disputed: the number formats of the roles for which the file states several.
        constants: the constants as stored, by role; None for one that other nodes compute.
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
    channels: tuple[int, int] = (0, 0)
    weight_bytes: int = 0
    constant_shape: tuple[int, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    follows: Kind | None = None
    integer: bool = False
    scales: Mapping[str, Scale] = field(default_factory=dict)
    disputed: Mapping[str, tuple[Scale, ...]] = field(default_factory=dict)
    constants: Mapping[str, np.ndarray | None] = field(default_factory=dict, compare=False)

    @property
    def output(self) -> str:
        """Return the name of the first activation that the node writes."""
        return self.outputs[0]

    @property
    def in_shape(self) -> Shape | None:
        """Return the shape (C, H, W) of the first input; None if unknown or without inputs."""
        return self.in_shapes[0] if self.in_shapes else None

    @property
    def kernel_area(self) -> int:
        """Return the number of positions of the kernel."""
        return self.kernel[0] * self.kernel[1]

    @property
    def operations(self) -> int:
        """Return the number of int8 operations for one image; 0 if the node is no convolution.

        It is 2 kh kw ic oc h w / groups, with the kernel (kh, kw), ic input and oc output channels,
        and h w pixels of the result (of the input for a transposed convolution). A multiplication
        and an addition count as two operations.
        """
        if self.kind not in CONVOLUTIONS:
            return 0
        # A transposed convolution multiplies the weights with each pixel of its input.
        shape = self.in_shape if self.kind == "transposed" else self.out_shape
        # A weight has one byte and is used once a pixel: a product and a sum are two operations.
        return 2 * self.weight_bytes * _pixels(self.name, shape)

    @property
    def out_bytes(self) -> int:
        """Return the size of the first output as int8 in bytes, for one image.

        Raises:
            ModelError: the shape of the output is unknown.
        """
        return _pixels(self.name, self.out_shape) * (self.out_shape or (0,))[0]


@dataclass(frozen=True)
class SizedGraph:
    """A network as a list of operations, with the shapes that follow from one image size.

    Attributes:
        operations: the operations, in the order in which they are computed.
        inputs: the shape (C, H, W) of each input of the network, by name.
        outputs: the names of the network's outputs.
        quantized: True if the file contains integers, False for a float file.
    """

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
