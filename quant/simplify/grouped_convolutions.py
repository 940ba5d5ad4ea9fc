"""Write convolutions of groups, and transposed ones with output padding, in forms that a DPU has.

1. Groups of several channels become one group, with weights of zero between them.
2. Output padding becomes rows and columns of zeros at the end of the kernel.

Both are exact. A DPU then multiplies by the zeros too.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import is_convolution


def without_groups(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Replace a convolution of groups or output padding by one without.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution; None if the node is something else, or depthwise.
    """
    if not is_convolution(graph, node):
        return None
    weight = graph.constants[node.inputs[1]]
    groups = node.attributes.get("group", 1)
    rows, columns, *_ = node.output_padding
    is_depthwise = node.op_type == "Conv" and weight.shape[1] == 1 and len(weight) == groups
    auto_pad = node.attributes.get("auto_pad", "NOTSET")
    states_pads = auto_pad == "NOTSET" and "output_shape" not in node.attributes
    is_dilated = set(node.attributes.get("dilations", [1])) != {1}
    if rows or columns:
        if not states_pads or is_dilated:
            return None
    elif groups == 1 or is_depthwise:
        return None
    # Both kinds have their groups along the first axis: (O, I / groups, kh, kw), or transposed
    # (I, O / groups, kh, kw).
    in_groups = np.arange(len(weight)) * groups // len(weight)
    dense = np.zeros((len(weight), groups, *weight.shape[1:]))
    dense[np.arange(len(weight)), in_groups] = weight
    dense = dense.reshape(len(weight), -1, *weight.shape[2:])
    dense = np.pad(dense, [(0, 0), (0, 0), (0, rows), (0, columns)])
    name = graph.add_constant(f"{node.name}.weight", dense)
    attributes = {
        **node.attributes,
        "group": 1,
        "kernel_shape": list(dense.shape[2:]),
        "output_padding": [0, 0],
    }
    if node.op_type == "Conv":
        del attributes["output_padding"]
    inputs = [node.source, name, *node.inputs[2:]]
    return [Node.new(node.op_type, inputs, node.result, node.proto.name, **attributes)]
