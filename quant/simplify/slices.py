"""Write slices of rows and columns as pixel unshuffles and depthwise convolutions.

1. A Concat of slices that start at each place of a block, and step by the block, has the pixels of
   SpaceToDepth; its channels may be in another order. YOLO's Focus layer is an example. Slices are
   tested on an image of numbered pixels.
2. Convolutions that read it reorder their weights accordingly.
3. A U-Net without padding crops its skips to the size of the enlarged map. In a kernel of three
   rows the first and the last reach the border that is cut, and the one in the middle has the only
   weight, 1.
   torch's users crop by a Pad of negative numbers, too.
4. A wavelet transform selects every n-th row. The only weight of a kernel of stride n lies at its
   end, where the first selected row is.

The depthwise convolutions read one pixel each. They are exact, and do not need the size of the
image.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.fold_affine import is_convolution

BLOCKS = (2, 3, 4)
TO_THE_END = 1 << 30
"""A stop from this number on is that of a slice to the end."""


def slices_of(graph: OnnxGraph, node: Node) -> dict[int, slice]:
    """Return which part of each axis a Slice of a tensor of four axes selects.

    Args:
        graph: the graph that the node belongs to.
        node: a Slice.

    Returns:
        The slice of each axis that is cut, by the axis' number from 0 to 3; empty if other nodes
        compute the positions.
    """
    starts, stops, axes, steps = (graph.numbers(node, place, "") for place in range(1, 5))
    if not (starts and stops and axes) or steps is None:
        return {}
    steps = steps or [1] * len(axes)
    return {
        axis % 4: slice(*cut)
        for axis, *cut in zip(axes, starts, stops, steps, strict=True)
        if cut[0] or cut[1] < TO_THE_END or cut[2] != 1
    }


def unshuffle_slices(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace slices of every n-th pixel that are concatenated by one pixel unshuffle (point 1 of
    the module).

    Args:
        graph: the graph that the node belongs to. Convolutions that read the result get other
            weights, because its channels may be in another order.
        node: any node; only a Concat can be replaced.

    Returns:
        The pixel unshuffle (SpaceToDepth); None if the node stays.
    """
    if node.op_type != "Concat" or node.attribute("axis") not in (1, -3):
        return None
    source, *others = {_origin(graph, name)[0] for name in node.inputs}
    size = graph.shapes.get(source, ())
    if others or len(size) != 4 or size[1] < 1:
        return None
    for block in BLOCKS:
        order = _order(graph, node, size[1], block)
        if order is not None:
            return unshuffled(graph, node, source, block, order)
    return None


def unshuffled(
    graph: OnnxGraph, node: Node, source: str, block: int, order: np.ndarray
) -> Replacement:
    """Return the pixel unshuffle that replaces a node if only convolutions read it, whose weights
    are reordered (point 2 of the module).

    Args:
        graph: the graph that the node belongs to. Those convolutions get other weights.
        node: the node that is replaced.
        source: the name of the map.
        block: side of the unshuffle's blocks in pixels.
        order: the unshuffle's channel that each channel of the node is.
    """
    readers = graph.readers[node.result]
    takes_order = all(
        reader.op_type == "Conv" and is_convolution(graph, reader) and reader.groups == 1
        for reader in readers
    )
    if not readers or node.result in graph.outputs or not takes_order:
        return None
    for reader in readers:
        weight = graph.constants[reader.inputs[1]]
        name = graph.add_constant(f"{reader.name}.weight", weight[:, np.argsort(order)])
        reader.inputs = (reader.source, name, *reader.inputs[2:])
    return [node.replaced_by("SpaceToDepth", [source], blocksize=block)]


def _origin(graph: OnnxGraph, name: str) -> tuple[str, list[Node]]:
    """Return the tensor that slices in front of a name begin with, and these in their order."""
    slices: list[Node] = []
    while (writer := graph.writer(name)).op_type == "Slice":
        slices.insert(0, writer)
        name = writer.source
    return name, slices


def _order(graph: OnnxGraph, node: Node, channels: int, block: int) -> np.ndarray | None:
    """Return the unshuffle's channels in the order of a Concat, or None if pixels differ.

    Args:
        graph: the graph that the slices belong to.
        node: the Concat.
        channels: the channels of the map that is sliced.
        block: side of the unshuffle's blocks in pixels.
    """
    shape = (1, channels, 4 * block, 6 * block)
    image = np.arange(np.prod(shape)).reshape(shape)
    parts = []
    # Each pixel has a unique number, so that the result shows where each one moved.
    for name in node.inputs:
        part = image
        for each in _origin(graph, name)[1]:
            cuts = slices_of(graph, each)
            part = part[tuple(cuts.get(axis, slice(None)) for axis in range(4))]
        parts.append(part)
    # ONNX's SpaceToDepth has the place in the block before the channel.
    blocks = image.reshape(channels, 4, block, 6, block).transpose(2, 4, 0, 1, 3)
    unshuffled = blocks.reshape(1, block**2 * channels, 4, 6)
    if any(part.shape[2:] != unshuffled.shape[2:] for part in parts):
        return None
    result = np.concatenate(parts, axis=1)
    if result.shape != unshuffled.shape:
        return None
    # Each channel is known by its first pixel.
    order = (result[0, :, :1, 0] == unshuffled[0, :, 0, 0]).argmax(1)
    return order if np.array_equal(unshuffled[:, order], result) else None


def slice_by_pads(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a Pad by negative numbers of rows and columns, which crops, by a Slice.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The Slice; None if the node is something else.
    """
    amounts = np.array(graph.numbers(node, 1, "pads") if node.op_type == "Pad" else None)
    if amounts.shape != (8,) or amounts.max() > 0 or amounts[[0, 1, 4, 5]].any():
        return None
    stops = [stop or TO_THE_END for stop in amounts[6:].tolist()]
    places = [
        graph.add_constant(f"{node.result}.{role}", numbers, np.int64)
        for role, numbers in (("starts", -amounts[2:4]), ("stops", stops), ("axes", [2, 3]))
    ]
    return [node.replaced_by("Slice", [node.source, *places])]


def convolve_slice(graph: OnnxGraph, node: Node) -> Replacement:
    """Replace a Slice that crops a map, or selects every n-th pixel, by a depthwise convolution.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution. None for any other Slice, and for any other node.
    """
    size = graph.shapes.get(node.source, ()) if node.op_type == "Slice" else ()
    cuts = slices_of(graph, node) if len(size) == 4 and size[1] else {}
    is_end = node.result in graph.outputs and cuts.get(2) == cuts.get(3)
    # The host crops the result of a network, also where it mirrored the image before.
    if not cuts or not cuts.keys() <= {2, 3} or is_end:
        return None
    # For rows and columns.
    taps = [[1], [1]]
    strides = [1, 1]
    dilations = [1, 1]
    for axis, cut in cuts.items():
        # A window without padding cuts as much at either side, so both cuts must be equal.
        is_crop = cut.step == 1 and cut.stop in (-cut.start, size[axis] - cut.start)
        is_strided = 0 <= cut.start < cut.step and cut.stop >= (size[axis] or TO_THE_END)
        if is_crop and cut.start > 0:
            # Dilated by the border, a kernel of three shortens the map by it on either side.
            taps[axis - 2] = [0, 1, 0]
            dilations[axis - 2] = cut.start
        elif is_strided:
            taps[axis - 2] = [0] * cut.start + [1]
            strides[axis - 2] = cut.step
        else:
            return None
    weight = np.tile(np.outer(taps[0], taps[1]), (size[1], 1, 1, 1))
    conv = graph.convolution(
        node.source,
        node.result,
        node.name,
        weight,
        dilations=dilations,
        strides=strides,
        group=size[1],
    )
    return [conv]
