"""Write a convolution of a large kernel as several of smaller ones, whose results are summed.

1. Each part has every m-th row of the kernel, so that it is dilated by m, with the smallest m that
   `MOST_POSITIONS` allows. Its padding is the rest of the whole kernel's padding in front of its
   first row and behind its last one.
2. A convolution of one pixel sums the parts, channel by channel. Behind a sum by Adds a DPU has no
   activation but ReLU, and as the network's last operation it would have 8 bits.

All of it is exact except for the rounding of float32. A kernel is not split if parts would begin
inside the map, as those of a kernel without padding do, or if one of its rows is too large.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import is_convolution

MOST_POSITIONS = 49
"""Height times width of a part, 7 x 7. Every target computes at most 53."""
LARGE_POSITIONS = 64
"""Height times width, 8 x 8, up to which a kernel is not split, because some targets compute it."""


def split_large_kernel(graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Replace a convolution of a large kernel by several of smaller ones, and the sum of their
    results.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        A convolution for each part, their Concat, and the convolution that sums them; None if the
        node is no convolution that is split.
    """
    if node.op_type != "Conv" or not is_convolution(graph, node):
        return None
    weight = graph.constants[node.inputs[1]]
    outputs, _, rows, columns = weight.shape
    states_pads = node.attributes.get("auto_pad", "NOTSET") == "NOTSET"
    one_group = node.attributes.get("group", 1) == 1
    is_large = rows * columns > LARGE_POSITIONS
    if not (is_large and states_pads and one_group and columns <= MOST_POSITIONS):
        return None
    # A part may have MOST_POSITIONS // columns rows, so this is the least number of parts.
    step = -(-rows // (MOST_POSITIONS // columns))
    pads = node.attributes.get("pads", [0, 0, 0, 0])
    dilations = node.attributes.get("dilations", [1, 1])
    name = node.proto.name or node.outputs[0]
    parts: list[Node] = []
    # 1.
    for first in range(step):
        kernel = weight[:, :, first::step]
        # The part's last row lies this many rows above the last one of the whole kernel.
        behind = (rows - 1 - first) % step
        part_pads = [
            pads[0] - first * dilations[0],
            pads[1],
            pads[2] - behind * dilations[0],
            pads[3],
        ]
        if min(part_pads) < 0:
            return None
        attributes = {
            **node.attributes,
            "kernel_shape": list(kernel.shape[2:]),
            "pads": part_pads,
            "dilations": [step * dilations[0], dilations[1]],
        }
        part = f"{name}.rows_{first}"
        parts.append(graph.convolution(node.inputs[0], part, part, kernel, **attributes))
    # 2.
    # The bias is added once, by the convolution that sums, so the parts have none.
    joined = Node.new(
        "Concat", [part.outputs[0] for part in parts], f"{name}.rows", f"{name}.rows", axis=1
    )
    ones = graph.add_constant(f"{name}.sum", np.tile(np.eye(outputs), step)[..., None, None])
    feeds = [joined.outputs[0], ones, *node.inputs[2:]]
    return [*parts, joined, Node.new("Conv", feeds, node.outputs[0], name, kernel_shape=[1, 1])]
