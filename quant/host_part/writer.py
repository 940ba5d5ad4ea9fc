"""The writer of the host's ONNX nodes, around which uint8 stands for int8."""

from collections.abc import Sequence

import numpy as np
from onnx import helper

from beers_deploy.quant.onnx_file import GraphWriter

ZERO = 128
"""The zero point of uint8 tensors: onnxruntime's fast integer kernels read uint8."""


class HostWriter(GraphWriter):
    """Writes nodes that state their domain, and uint8 with the zero point 128."""

    domain = ""

    def scalar(self, name: str, value: float) -> str:
        """Note a float32 constant, and return its name."""
        return self.constant(name, np.array(value, np.float32))

    def zero_point(self) -> str:
        """Return the name of the constant 128."""
        return self.constant("zero_point", np.array(ZERO, np.uint8))

    def split(self, source: str, sizes: str, names: Sequence[str]) -> None:
        """Append the node that splits the channels of `source` into tensors of these names.

        Args:
            source: the tensor.
            sizes: a constant, the number of channels of each part.
            names: the names of the parts.
        """
        node = helper.make_node("Split", [source, sizes], names, axis=1, name="host_back.split")
        self.nodes.append(node)
