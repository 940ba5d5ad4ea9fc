"""Remove computations on the size of the image: shapes, and operations that crop, pad or enlarge to
them.

1. Set the free sizes of the image to numbers, so that the runtime folds arithmetic on shapes.
2. Write a Resize to a size as one by factors, pads in place of auto_pad SAME, pools that round
   whole sizes up as ones that round down, and what only moves and repeats values as one operator
   (`rearrangements`). Let crops count from the end. Remove a Pad by nothing, a Slice of the whole
   map, and an Expand that arithmetic does anyway. Let a convolution repeat a channel, and write a
   map of one number per channel, such as a noise level.
3. Do both for two sizes. If the networks are equal, the size has no effect, and theirs is the
   network of every image whose sides are multiples of one of `MULTIPLES_PX`. Otherwise the network
   is not changed.
4. Free a fixed height and width that differ, which no tile has, if they have no effect.

Exporters write such arithmetic for a U-Net that pads or enlarges to the size of its skips, for
`chunk`, and for a number that is repeated over the image.

All of it is exact.
"""

from collections.abc import Callable
from copy import deepcopy

import numpy as np
from onnx import ModelProto

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx.elementwise import ELEMENTWISE
from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement, Rewriting
from beers_deploy.quant.onnx.image_input import without_size
from beers_deploy.quant.onnx.messages import replace_all
from beers_deploy.quant.simplify.branches import JoinBranches
from beers_deploy.quant.simplify.channels_first import TO_LAST, moved_behind, multiplied
from beers_deploy.quant.simplify.convolutions import leaves_pads
from beers_deploy.quant.simplify.fold_affine import affine_chain
from beers_deploy.quant.simplify.rearrangements import (
    OF_BLOCKS,
    RESHAPING,
    is_rearrangement,
    rearranged,
    takes_others,
)
from beers_deploy.quant.simplify.slices import TO_THE_END, slices_of

MULTIPLES_PX = 64, 512
"""Six levels of a U-Net, and nine, halve sides of these lengths without a remainder."""
MOST_LEVELS = 6
"""A network of no more strided windows is not tried on the larger images, which take long."""
SIZES = (2, 3), (4, 3)
"""Rows and columns of two images, as multiples. They differ, so that a network that confuses them
is detected.
"""
SIZED = {"Expand", "Pad", "Resize", "Shape", "Size", "Slice"}
"""Operators that may need the size of an image."""
LOCAL = ELEMENTWISE | {
    *("AveragePool", "Concat", "Conv", "ConvTranspose", "DepthToSpace", "MaxPool", "Pad"),
    *("Resize", "SpaceToDepth"),
}
"""Operators that do the same at every pixel, for images of all sizes."""
Fold = Callable[[ModelProto], ModelProto]
"""A function that folds constants, as onnxruntime does."""


def free_rectangle(model: ModelProto) -> ModelProto:
    """Return the network for images of any size if it is fixed to a height and another width, and
    they have no effect (point 4 of the module); otherwise `model` itself.

    Args:
        model: a simplified float network; not changed.
    """
    graph = OnnxGraph(model)
    sizes = next(iter(graph.inputs.values()), [])
    is_rectangle = len(sizes) == 4 and all(sizes[2:]) and sizes[2] != sizes[3]
    is_local = all(
        node.op_type in LOCAL and (node.op_type != "Resize" or graph.numbers(node, 2, "scales"))
        for node in graph.nodes
    )
    return without_size(model) if is_rectangle and is_local else model


def free_sizes(model: ModelProto, fold: Fold) -> ModelProto:
    """Return the network without arithmetic on the size of its image, if the size has no effect on
    the rest.

    Args:
        model: a float network of this project's opset; not changed.
        fold: a function that folds the constants of a network, as onnxruntime does.

    Returns:
        The network for images whose sides are multiples of one of MULTIPLES_PX; `model` itself if
        the size has an effect.
    """
    graph = OnnxGraph(model)
    if not any(
        is_rearrangement(graph, node)
        or node.attribute("keepdims", 1) == 0
        or leaves_pads(node)
        or node.attribute("ceil_mode")
        or node.attribute("perm") == TO_LAST
        or node.op_type in SIZED
        or (node.op_type == "Concat" and graph.constants.keys() & {*node.inputs})
        for node in graph.nodes
    ):
        return model
    strided = sum(max(node.attribute("strides") or [1]) > 1 for node in graph.nodes)
    multiples_px = MULTIPLES_PX if strided > MOST_LEVELS else MULTIPLES_PX[:1]
    for multiple_px in multiples_px:
        network = _of_multiples(model, multiple_px, fold)
        if network is not None:
            return network
    return model


def _of_multiples(model: ModelProto, multiple_px: int, fold: Fold) -> ModelProto | None:
    """Return the network for images whose sides are multiples of a number of pixels; None if the
    size has an effect on it (3).
    """
    sizes_px = np.multiply(SIZES, multiple_px).tolist()
    try:
        first, second = (_of_size(model, rows, columns, fold) for rows, columns in sizes_px)
    # A network may demand other sizes.
    except ModelError:
        return None
    first_constants, second_constants = (
        {tensor.name: tensor for tensor in network.graph.initializer} for network in (first, second)
    )
    if first.graph.node != second.graph.node or first_constants != second_constants:
        return None
    # The sizes that the file states are as free as before.
    replace_all(first.graph.input, model.graph.input)
    replace_all(first.graph.output, model.graph.output)
    first.graph.ClearField("value_info")
    return first


def _of_size(model: ModelProto, rows: int, columns: int, fold: Fold) -> ModelProto:
    """Return the network for images of one size, where the file leaves the size free (1, 2).

    Args:
        model: a float network; not changed.
        rows: the rows of the image.
        columns: the columns of the image.
        fold: folds the constants of a network.
    """
    network = deepcopy(model)
    for value in network.graph.input:
        dims = value.type.tensor_type.shape.dim
        if len(dims) == 4:
            for dim, size in zip(dims, (1, 0, rows, columns), strict=True):
                if size and not dim.dim_value:
                    dim.dim_value = size
    # The sizes of other tensors in the file may contradict the numbers.
    network.graph.ClearField("value_info")
    for value in network.graph.output:
        value.type.tensor_type.ClearField("shape")
    network = fold(network)
    network.graph.ClearField("value_info")
    graph = OnnxGraph(network)
    graph.infer_shapes()
    graph.rewrite(JoinBranches())
    graph.rewrite(_sized)
    graph.rewrite(moved_behind)
    graph.save()
    return fold(network)


def _sized(graph: OnnxGraph, node: Node) -> Replacement:
    """Return the nodes that replace a node whose input has a known size (2).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The nodes with the same result; None if the node stays.
    """
    before = graph.shapes.get(node.source, ())
    after = graph.shapes.get(node.result, ())
    moves = node.op_type == "Transpose" or takes_others(graph, node)
    if moves or (node.op_type in RESHAPING and before != after):
        return multiplied(graph, node) or _with_kept_axis(graph, node) or rearranged(graph, node)
    if node.op_type in RESHAPING and (operator := rearranged(graph, node)):
        return operator
    if len(before) != 4 or len(after) != 4 or min(*before, *after) < 1:
        return None
    if node.op_type in SPECIAL:
        return SPECIAL[node.op_type](graph, node)
    adds_nothing = node.op_type == "Pad" and graph.numbers(node, 1, "pads") == [0] * 8
    if adds_nothing or node.op_type in RESHAPING:
        return [node.replaced_by("Identity", [node.source])]
    return None


def _cropped(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a crop whose stops count from the end of rows and columns, as those of all sizes do;
    nothing but another name for a Slice of the whole map, and None for other Slices.
    """
    before = graph.shapes[node.source]
    cuts = slices_of(graph, node)
    if any(cut.step != 1 for cut in cuts.values()):
        return None
    if before == graph.shapes[node.result]:
        return [node.replaced_by("Identity", [node.source])]
    if cuts.keys().isdisjoint((2, 3)):
        return None
    stops = {axis: cut.indices(before[axis])[1] - before[axis] for axis, cut in cuts.items()}
    numbers = {
        "starts": [cut.start for cut in cuts.values()],
        "stops": [(stops[k] or TO_THE_END) if k > 1 else cut.stop for k, cut in cuts.items()],
        "axes": list(cuts),
    }
    places = [
        graph.add_constant(f"{node.name}.{role}", values, np.int64)
        for role, values in numbers.items()
    ]
    return [node.replaced_by("Slice", [node.source, *places])]


def _with_stated_sizes(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a strided window with its pads in place of auto_pad SAME, or without a ceil_mode that
    has no effect; None for other windows.
    """
    weight = graph.value(node, 1)
    _, _, rows, columns = graph.shapes[node.source]
    size = rows, columns
    match = node.window(() if weight is None else weight.shape[2:], size)
    if match is None or not (leaves_pads(node) or node.attribute("ceil_mode")):
        return None
    kernel, window = match
    rounded_down = tuple(window.output_size(axis, kernel[axis], size[axis]) for axis in (0, 1))
    if rounded_down != graph.shapes[node.result][2:]:
        return None
    attributes = {key: value for key, value in node.attributes.items() if key != "ceil_mode"}
    attributes |= {"auto_pad": "NOTSET", "pads": list(window.pads)}
    return [node.replaced_by(node.op_type, node.inputs, **attributes)]


def _by_factors(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a Resize by factors in place of one to a size, and nothing but another name for one to
    the map's own size; None if no whole number divides one of the sizes into the other, so that
    factors may be rounded, and the result have another size.
    """
    before = graph.shapes[node.source]
    crops = node.attribute("coordinate_transformation_mode") == "tf_crop_and_resize"
    if before == graph.shapes[node.result] and not crops:
        return [node.replaced_by("Identity", [node.source])]
    factors = np.divide(graph.shapes[node.result], before)
    if len(node.inputs) < 4 or any(factor % 1 and (1 / factor) % 1 for factor in factors):
        return None
    scales = graph.add_constant(f"{node.name}.scales", factors)
    attributes = {k: v for k, v in node.attributes.items() if k != "keep_aspect_ratio_policy"}
    # One pixel is the same in all modes.
    if before[2:] == (1, 1):
        attributes = OF_BLOCKS
    inputs = [node.source, "", scales]
    return [node.replaced_by("Resize", inputs, **attributes)]


def _expanded(graph: OnnxGraph, node: Node) -> Replacement:
    """Return nothing but another name for an Expand without effect, or the convolution that repeats
    a map of one channel; None for other Expands.
    """
    source = node.source
    result = node.result
    before = graph.shapes[source]
    after = graph.shapes[result]
    # It has no effect on arithmetic that broadcasts to the same size anyway. The source of another
    # Expand may be small itself, so it does not count.
    large = {
        name
        for name, size in graph.shapes.items()
        if size == after and graph.writer(name).op_type != "Expand"
    }
    is_broadcast_anyway = result not in graph.outputs and all(
        reader.op_type in ("Add", "Mul", "Sub") and not large.isdisjoint(reader.inputs)
        for reader in graph.readers[result]
    )
    if before == after or is_broadcast_anyway:
        return [node.replaced_by("Identity", [source])]
    if before[1] > 1 or before[2:] != after[2:]:
        return None
    return [graph.convolution(source, result, node.name, np.ones((after[1], 1, 1, 1)))]


def _with_written_maps(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a Concat whose constant maps are written by convolutions with weights of zero.

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: the Concat. The convolutions read its first input.

    Returns:
        The convolutions and the Concat, None if a constant is no map of one number a channel.
    """
    source = node.source
    before = graph.shapes[source]
    after = graph.shapes[node.result]
    maps = {name: graph.constants[name] for name in node.inputs if name in graph.constants}
    is_map = all(
        value.ndim == 4 and value.shape[2:] == after[2:] and (value == value[..., :1, :1]).all()
        for value in maps.values()
    )
    if not maps or not is_map or source in maps:
        return None
    nodes = []
    names = {}
    for number, (name, value) in enumerate(maps.items()):
        names[name] = f"{node.result}.constant_{number}"
        # With weights of zero the result is the bias alone, in the size of the map that is read.
        weight = np.zeros((value.shape[1], before[1], 1, 1))
        bias = value[0, :, 0, 0]
        nodes.append(graph.convolution(source, names[name], names[name], weight, bias))
    node.inputs = tuple(names.get(name, name) for name in node.inputs)
    return [*nodes, node]


SPECIAL: dict[str, Rewriting] = {
    "Concat": _with_written_maps,
    "Expand": _expanded,
    "Resize": _by_factors,
    "Slice": _cropped,
    **dict.fromkeys(("AveragePool", "Conv", "MaxPool"), _with_stated_sizes),
}
"""The function for each operator that returns the nodes which replace one."""


def _with_kept_axis(graph: OnnxGraph, node: Node) -> Replacement:
    """Return the mean or maximum of a map over its channels, times a constant, in place of one that
    drops the axis, which a Reshape adds again, as torch writes a variance and CBAM's attention;
    None if the node is no such Reshape.
    """
    source, affine = affine_chain(graph, node.source)
    before = graph.writer(source)
    is_of_channels = graph.numbers(before, 1, "axes") == [1]
    if before.op_type not in ("ReduceMax", "ReduceMean") or not is_of_channels:
        return None
    batch, _, *sides = graph.shapes.get(before.source, (0, 0))
    is_kept = len(sides) == 2 and graph.shapes.get(node.result) == (batch, 1, *sides)
    if not is_kept or affine.shift.any():
        return None
    attributes = {**before.attributes, "keepdims": 1}
    if (affine.scale == 1).all():
        return [node.replaced_by(before.op_type, before.inputs, **attributes)]
    reduced = f"{node.result}.reduced"
    factor = graph.add_constant(f"{reduced}.factor", affine.scale)
    return [
        Node.new(before.op_type, before.inputs, reduced, **attributes),
        node.replaced_by("Mul", [reduced, factor]),
    ]
