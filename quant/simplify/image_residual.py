"""Add a correction to the image itself where a network adds it to the normalised image.

Networks that normalise inside, to [-1, 1] or by a mean and a deviation, often add their correction
to the normalised image and undo the normalisation behind the sum:

    c (correction + a x + b) + d = c correction + x    if c a = 1 and c b + d = 0

1. A Clip whose result is scaled and shifted becomes the last operation, and so do Max and Min.
2. A sum whose scaling returns the image becomes a sum with the image.

The host then adds the image in float, and INT8 holds the small correction alone. In one small
network, INT8 then lost 0.10 instead of 1.20 dB (measured). All of it is exact except for the
rounding of float32.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.simplify.fold_affine import Affine, affine_chain
from beers_deploy.quant.simplify.spelled_activations import joint_limits

SAME = 1e-6
"""The relative error of constants that undo one another: a few roundings of float32."""


def clip_last(graph: OnnxGraph, node: Node) -> Replacement:
    """Let one Clip follow the arithmetic with one constant that ends a network (point 1).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        A product, a sum if there is a shift, and the Clip; None if the node does not end a network
        in this way, or is this Clip.
    """
    if node.result not in graph.outputs:
        return None
    source, affine = affine_chain(graph, node.result)
    is_last = source == node.result
    clip = node if is_last else graph.sole_writer(source)
    clipping = joint_limits(graph, clip)
    # Without a node the limits are infinite.
    is_limited = np.isfinite(clipping.limits).all()
    is_this = is_last and clipping.nodes == 1
    if not is_limited or affine.channels > 1 or not affine.scale.all() or is_this:
        return None
    name = node.result
    # A negative scale exchanges the two limits.
    low, high = sorted((affine.scale * limit + affine.shift).item() for limit in clipping.limits)
    ends = [
        graph.add_constant(f"{name}.low", low),
        graph.add_constant(f"{name}.high", high),
    ]
    nodes = [] if is_last else _scaled(graph, clipping.source, name, affine)
    last = nodes[-1].result if nodes else clipping.source
    return [*nodes, Node.new("Clip", [last, *ends], name, clip.name)]


def _scaled(graph: OnnxGraph, source: str, name: str, affine: Affine) -> list[Node]:
    """Return the product, and the sum if there is a shift, that scale a tensor by one constant."""
    scale = graph.add_constant(f"{name}.scale", affine.scale)
    nodes = [Node.new("Mul", [source, scale], f"{name}.scaled")]
    if affine.shift.any():
        shift = graph.add_constant(f"{name}.shift", affine.shift)
        nodes.append(Node.new("Add", [nodes[0].result, shift], f"{name}.shifted"))
    return nodes


def add_to_image(graph: OnnxGraph, node: Node) -> Replacement:
    """Add a correction to the image itself, where a network normalises the image and undoes that
    behind the sum (point 2).

    Args:
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        A product and the sum; None if the node does not undo the normalisation of the image.
    """
    source, behind = affine_chain(graph, node.result)
    total = graph.writer(source)
    if source == node.result or total.op_type != "Add":
        return None
    for name, other in total.orders:
        image, before = affine_chain(graph, name, is_sole=False)
        if name == image or len(graph.inputs.get(image, ())) != 4:
            continue
        is_undone = np.allclose(behind.scale * before.scale, 1, 0, SAME) and np.allclose(
            behind.scale * before.shift, -behind.shift, SAME, SAME
        )
        # A grey image may get channels by its normalisation.
        channels = max(behind.channels, before.channels)
        if is_undone and channels in (1, graph.inputs[image][1]):
            result = node.result
            factor = graph.add_constant(f"{result}.scale", behind.scale.reshape(1, -1, 1, 1))
            correction = f"{result}.correction"
            return [
                Node.new("Mul", [other, factor], correction),
                node.replaced_by("Add", [image, correction]),
            ]
    return None
