"""The writer of the host's ONNX nodes, around which uint8 stands for int8."""

from collections.abc import Sequence

import numpy as np
from onnx import helper

from beers_deploy.quant.onnx_file import GraphWriter

ZERO = 128
"""The zero point of uint8 tensors: onnxruntime's fast integer kernels read uint8."""


class HostWriter(GraphWriter):
    """A graph under construction for the host's file, in which uint8 with the zero point 128 stands
    for int8.

    Its nodes state their domain, and onnxruntime has fast kernels for uint8.
    """

    domain = ""

    def scalar(self, name: str, value: float) -> str:
        """Store a float32 constant of one number under a name, and return its name in the file."""
        return self.constant(name, np.array(value, np.float32))

    def zero_point(self) -> str:
        """Store the uint8 zero point 128 as a constant, and return its name."""
        return self.constant("zero_point", np.array(ZERO, np.uint8))

    def split(self, source: str, sizes: str, names: Sequence[str]) -> None:
        """Append the node that splits a tensor along its channels.

        Args:
            source: the name of the tensor.
            sizes: the name of a constant, the number of channels of each part.
            names: the names of the parts.
        """
        node = helper.make_node("Split", [source, sizes], names, axis=1, name="host_back.split")
        self.nodes.append(node)
