"""Write convolutions in forms that a DPU computes.

1. Groups of several channels become one group, with weights of zero between them.
2. Output padding of a transposed convolution becomes rows and columns of zeros at the end of the
   kernel.
3. A large kernel becomes several smaller ones, whose results are summed. Each part has every m-th
   row of the kernel, so that it is dilated by m, with the smallest m that `MOST_POSITIONS` allows.
   Its padding is the rest of the whole kernel's padding in front of its first row and behind its
   last one.
4. A convolution of one pixel sums the parts, channel by channel. Behind a sum by Adds a DPU has no
   activation but ReLU, and as the network's last operation it would have 8 bits.
5. A crop behind a transposed convolution becomes padding of that. TensorFlow crops the map that it
   enlarges to a multiple of its size.

All of it is exact except for the rounding of float32. A DPU also multiplies by the zeros of 1 and
2. Where a part of a large kernel would begin or end inside the map, as with a kernel without
padding, a depthwise convolution that reads one pixel crops the map first. A kernel is not split if
one of its rows is too large. It is not split either if it has a side without padding and is longer
than any target's kernels, because it may be as large as its map. Targets compute such a layer in
another way.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.fold_affine import is_convolution
from beers_deploy.quant.simplify.slices import TO_THE_END, slices_of

MOST_POSITIONS = 49
"""The maximum height times width of a part, 7 x 7. The smallest limit of a target is 53."""
LARGE_POSITIONS = 64
"""Kernels up to this height times width, 8 x 8, are not split, because some targets compute
them.
"""
LONGEST_SIDE = 16
"""The longest side of a kernel that is split although a side has no padding."""


def leaves_pads(node: Node) -> bool:
    """Return True if the pads of a strided convolution or pool follow from the size of its map."""
    is_same = str(node.attribute("auto_pad", "")).startswith("SAME")
    return is_same and any(stride > 1 for stride in node.attribute("strides", [1]))


def states_pads(node: Node) -> bool:
    """Return True if a transposed convolution states its pads, and no size of its result."""
    return node.attribute("auto_pad", "NOTSET") == "NOTSET" and not node.attribute("output_shape")


def without_groups(graph: OnnxGraph, node: Node) -> Replacement:
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
    groups = node.groups
    rows, columns, *_ = node.output_padding
    is_depthwise = node.op_type == "Conv" and weight.shape[1] == 1 and len(weight) == groups
    if rows or columns:
        if not states_pads(node) or set(node.attribute("dilations", [1])) != {1}:
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


def crop_by_pads(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a crop behind a transposed convolution by padding, which also cuts its result.

    Args:
        graph: the graph that the node belongs to.
        node: any node; the Slice is replaced.

    Returns:
        The convolution; None if the node is something else.
    """
    before = graph.sole_writer(node.source)
    if (node.op_type, before.op_type) != ("Slice", "ConvTranspose"):
        return None
    cuts = slices_of(graph, node)
    if not cuts or not cuts.keys() <= {2, 3} or not states_pads(before):
        return None
    pads = list(before.attribute("pads", [0] * 4))
    for axis, cut in cuts.items():
        # Stops count from the end.
        stop = 0 if cut.stop >= TO_THE_END else cut.stop
        if cut.step != 1 or cut.start < 0 or stop > 0:
            return None
        pads[axis - 2] += cut.start
        pads[axis] -= stop
    return [node.replaced_by("ConvTranspose", before.inputs, **{**before.attributes, "pads": pads})]


def split_large_kernel(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a convolution of a large kernel by several of smaller ones, and the sum of their
    results.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        A convolution for each part, some behind a crop, their Concat, and the convolution that sums
        them; None if the node is no convolution that is split.
    """
    if node.op_type != "Conv" or not is_convolution(graph, node):
        return None
    weight = graph.constants[node.inputs[1]]
    outputs, channels, rows, columns = weight.shape
    channels *= node.groups
    is_large = rows * columns > LARGE_POSITIONS and columns <= MOST_POSITIONS
    match = node.window((rows, columns))
    if not is_large or match is None or leaves_pads(node):
        return None
    pads = match[1].pads
    if min(pads) == 0 and max(rows, columns) > LONGEST_SIDE:
        return None
    # A part may have MOST_POSITIONS // columns rows, so this is the least number of parts.
    step = -(-rows // (MOST_POSITIONS // columns))
    dilations = node.attribute("dilations", [1, 1])
    name = node.proto.name or node.result
    nodes = []
    parts = []
    # 3.
    for first in range(step):
        kernel = weight[:, :, first::step]
        # The part's last row lies this many rows above the last one of the whole kernel.
        behind = (rows - 1 - first) % step
        above = pads[0] - first * dilations[0]
        below = pads[2] - behind * dilations[0]
        part = f"{name}.rows_{first}"
        source = node.source
        if min(above, below) < 0:
            tap = np.eye(max(-above, 0) + max(-below, 0) + 1)[max(-above, 0)]
            crop = np.tile(tap[:, None], (channels, 1, 1, 1))
            source = f"{part}.cropped"
            nodes.append(graph.convolution(node.source, source, source, crop, group=channels))
        attributes = {
            **node.attributes,
            "kernel_shape": list(kernel.shape[2:]),
            "auto_pad": "NOTSET",
            "pads": [max(above, 0), pads[1], max(below, 0), pads[3]],
            "dilations": [step * dilations[0], dilations[1]],
        }
        nodes.append(graph.convolution(source, part, part, kernel, **attributes))
        parts.append(part)
    # 4.
    # The bias is added once, by the convolution that sums, so the parts have none.
    joined = Node.new("Concat", parts, f"{name}.rows", axis=1)
    ones = graph.add_constant(f"{name}.sum", np.tile(np.eye(outputs), step)[..., None, None])
    feeds = [joined.result, ones, *node.inputs[2:]]
    return [*nodes, joined, Node.new("Conv", feeds, node.result, name, kernel_shape=[1, 1])]
