"""Split and repeat the channels of maps by convolutions, so that nothing else does.

A Split, Slice or Gather along the channels has parts, each a list of channels:

1. If only such nodes read a map, and a convolution writes it, each part becomes a convolution with
   the weights of its channels. Activations and depthwise convolutions in between are divided with
   it. The amount of computation does not change.
2. In front of any other operation, a convolution of one pixel selects the channels.
3. Behind a concat that has such a selection of most channels, as partial convolutions have, a
   convolution reads the whole map, with zeros for the channels that are not selected. The selection
   would round the map once more, to a scale that equalisation does not reach.

4. A write into some channels, as in x[:, :8] = y, is a concat of the others with what is written.

A DPU adds and multiplies maps of one number of channels:

5. A map of one channel that meets several is repeated first, as a Tile along the channels does.

All of it is exact. The divided nodes remain, and are removed if nothing reads them.
"""

from dataclasses import replace

import numpy as np

from beers_deploy.quant.onnx.graph import NO_NODE, Node, OnnxGraph, Replacement
from beers_deploy.quant.onnx.window import Window
from beers_deploy.quant.simplify.fold_affine import is_convolution
from beers_deploy.quant.simplify.slices import slices_of

POINTWISE = {"HardSigmoid", "HardSwish", "LeakyRelu", "Relu", "Sigmoid", "Tanh"}
CHANNEL_AXIS = (1, -3)
Part = tuple[str, np.ndarray]
"""The name of a part, and the numbers of its channels."""
HOST = {"Clip", "DepthToSpace"}
"""Operators that the host computes behind the sum with the image."""


def join_written(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a write into channels that follow each other by a concat (point 4 of the module).

    torch exports it as a ScatterND; its newer exporter, between Transposes of batch and channels.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The selections of the other channels, and the concat; None if the node is something else.
    """
    is_swapped = _is_swap(node)
    scatter = graph.writer(node.source) if is_swapped else node
    places = graph.value(scatter, 1) if scatter.op_type == "ScatterND" else None
    if places is None or not places.size or scatter.attribute("reduction", "none") != "none":
        return None
    whole, _, written = scatter.inputs
    if is_swapped:
        swaps = graph.writer(whole), graph.writer(written)
        if not all(map(_is_swap, swaps)):
            return None
        whole, written = (swap.source for swap in swaps)
    *images, channels = places.reshape(-1, places.shape[-1]).T
    first = channels[0]
    last = channels[-1] + 1
    numbers = np.arange(graph.channels(whole))
    follows = np.array_equal(channels, numbers[first:last])
    # A place is a channel of the first image, or of swapped axes a channel alone.
    is_of_channels = len(images) == 1 - is_swapped and not np.any(images)
    if not follows or not is_of_channels or graph.channels(written) != len(channels):
        return None
    names = [written]
    selections = []
    for place, chosen in ((0, numbers[:first]), (2, numbers[last:])):
        if len(chosen):
            name = f"{node.result}.part_{place}"
            order = graph.add_constant(f"{name}.order", chosen, np.int64)
            selections.append(Node.new("Gather", [whole, order], name, axis=1))
            names.insert(place, name)
    return [*selections, node.replaced_by("Concat", names, axis=1)]


def _is_swap(node: Node) -> bool:
    """Return True if a node swaps the axes of batch and channels."""
    return node.op_type == "Transpose" and node.attribute("perm") == [1, 0, 2, 3]


def split_channels(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a Split, Slice or Gather of channels by operations that compute each part by itself
    (points 1 and 2 of the module).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The operations that replace the node; None if it does not split channels.
    """
    parts = _parts(graph, node)
    source = node.source if parts else ""
    only_parts = all(_parts(graph, reader) for reader in graph.readers[source])
    divides = source not in graph.outputs and only_parts
    nodes = []
    for name, channels in parts:
        nodes += _compute(graph, source, channels, name, divides)
    return nodes or None


def _parts(graph: OnnxGraph, node: Node) -> list[Part]:
    """Return the parts of a map of known channels that a node selects; none for another node.

    Args:
        graph: the graph that the node belongs to.
        node: any node.
    """
    numbers = np.arange(graph.channels(node.source))
    if not len(numbers):
        return []
    if node.op_type == "Split" and node.attribute("axis", 0) in CHANNEL_AXIS:
        widths = [graph.channels(name) for name in node.outputs]
        if not all(widths):
            return []
        return list(zip(node.outputs, np.split(numbers, np.cumsum(widths[:-1])), strict=True))
    chosen = graph.value(node, 1) if node.op_type == "Gather" else None
    if chosen is not None and chosen.ndim == 1 and node.attribute("axis", 0) in CHANNEL_AXIS:
        return [(node.result, numbers[chosen])]
    cuts = slices_of(graph, node) if node.op_type == "Slice" else {}
    return [(node.result, numbers[cuts[1]])] if cuts.keys() == {1} else []


def _compute(
    graph: OnnxGraph, source: str, channels: np.ndarray, name: str, divides: bool
) -> list[Node]:
    """Return the operations that compute some channels of a map.

    Args:
        graph: its constants are extended by the weights of the part.
        source: the map.
        channels: the numbers of the channels, (C,).
        name: the name of the part.
        divides: True if the map is never needed as a whole, so that its operations are divided (1);
            False if the channels are selected (2).
    """
    # A part may be divided again.
    graph.shapes[name] = (graph.shapes[source][0], len(channels), *graph.shapes[source][2:])
    before = graph.writer(source) if divides else NO_NODE
    front = before.source
    in_front = []
    is_pointwise = before.op_type in POINTWISE
    groups = _groups(graph, before)
    if is_pointwise or groups > 1:
        # An activation works on each value by itself, and a depthwise kernel on each channel, so
        # that the map in front has parts too.
        inner = f"{name}.before"
        in_front = _compute(graph, front, channels, inner, graph.n_reads(front) == 1)
        front = inner
    if is_pointwise:
        kind = before.op_type
        return [*in_front, Node.new(kind, [front], name, f"{name}.{kind}", **before.attributes)]
    if groups:
        weight = graph.constants[before.inputs[1]][channels]
        bias = graph.value(before, 2)
        bias = bias if bias is None else bias[channels]
        attributes = {**before.attributes, "group": len(channels) if groups > 1 else 1}
        conv = graph.convolution(front, name, f"{name}.Conv", weight, bias, **attributes)
        return [*in_front, conv]
    weight = np.eye(graph.shapes[source][1])[channels][..., None, None]
    return [graph.convolution(source, name, f"{name}.Conv", weight)]


def _groups(graph: OnnxGraph, node: Node) -> int:
    """Return the groups of a convolution whose channels can be computed separately, 0 for another
    node.
    """
    if node.op_type != "Conv" or not is_convolution(graph, node):
        return 0
    outputs, inputs = graph.constants[node.inputs[1]].shape[:2]
    groups = node.groups
    # The channels of a group read others of their group, which the part need not have.
    return groups if groups == 1 or (groups == outputs and inputs == 1) else 0


def read_unselected(graph: OnnxGraph, node: Node) -> Replacement:
    """Let a convolution behind a concat read whole maps in place of selections of most of their
    channels (point 3 of the module).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The concat and the convolution; None if the node is something else.
    """
    joined = graph.sole_writer(node.source)
    if joined.op_type != "Concat" or _groups(graph, node) != 1:
        return None
    weight = graph.constants[node.inputs[1]]
    parts = []
    columns = []
    first = 0
    for name in joined.inputs:
        width = graph.channels(name)
        part = weight[:, first : first + width]
        first += width
        before = graph.sole_writer(name)
        chosen = _selected(graph, before)
        if chosen is None or 2 * width < chosen.shape[1]:
            parts.append(name)
            columns.append(part)
        else:
            parts.append(before.source)
            columns.append(np.einsum("oirc,ij->ojrc", part, chosen))
    if parts == list(joined.inputs) or first != weight.shape[1]:
        return None
    name = f"{node.name}.whole"
    concat = Node.new("Concat", parts, name, axis=1)
    wide = graph.add_constant(f"{name}.weight", np.concatenate(columns, 1))
    return [concat, replace(node, inputs=(name, wide, *node.inputs[2:]))]


def _selected(graph: OnnxGraph, node: Node) -> np.ndarray | None:
    """Return the weights (O, I) of a convolution of one pixel that selects channels; None for
    another node.
    """
    if _groups(graph, node) != 1 or graph.value(node, 2) is not None:
        return None
    weight = graph.constants[node.inputs[1]]
    is_one_pixel = node.window(weight.shape[2:]) == ((1, 1), Window())
    is_selection = ((weight == 0) | (weight == 1)).all() and (weight.sum((1, 2, 3)) == 1).all()
    return weight[:, :, 0, 0] if is_one_pixel and is_selection else None


def repeat_channels(graph: OnnxGraph, node: Node) -> Replacement:
    """Let a convolution repeat the channels of a map that a Tile or arithmetic repeats.

    The image that is added at the end is left as it is: the host adds it to each channel.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution, and the arithmetic; None if the node repeats no channels.
    """
    source = node.source
    result = node.result
    channels = graph.channels(source)
    if node.op_type == "Tile":
        repeats = graph.value(node, 1)
        if repeats is None or not channels or np.delete(repeats, 1).tolist() != [1, 1, 1]:
            return None
        weight = np.tile(np.eye(channels), (int(repeats[1]), 1))[:, :, None, None]
        return [graph.convolution(source, result, node.name, weight)]
    is_of_maps = graph.constants.keys().isdisjoint(node.inputs)
    if node.op_type not in ("Add", "Mul", "Sub") or not is_of_maps:
        return None
    widths = [graph.channels(name) for name in node.inputs]
    narrow = node.inputs[int(widths[0] > widths[1])]
    readers = {reader.op_type for reader in graph.readers[result]}
    is_end = node.op_type == "Add" and (result in graph.outputs or readers <= HOST)
    channels = max(widths)
    if not min(widths) == 1 < channels or (is_end and narrow in graph.inputs):
        return None
    name = f"{result}.repeated"
    repeated = graph.convolution(narrow, name, name, np.ones((channels, 1, 1, 1)))
    node.read_instead(narrow, name)
    return [repeated, node]
