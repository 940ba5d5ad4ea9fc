"""Convert a network whose image has its channels last (N, H, W, C) to channels first.

1. Exporters from TensorFlow transpose the image as the first node, and the result as the last.
2. In that case both nodes are removed, and input and output are (N, C, H, W), as in all other
   networks.
"""

import onnx

from beers_deploy.quant.onnx.graph import Node, OnnxGraph

TO_FIRST = [0, 3, 1, 2]
TO_LAST = [0, 2, 3, 1]


def channels_first(model: onnx.ModelProto) -> None:
    """Convert a network whose image has its channels last, and its result as well, to channels
    first.

    A network that does not transpose its image to channels first in its first nodes is unchanged.

    Args:
        model: a float network, which is changed in place.
    """
    graph = OnnxGraph(model)
    images = [name for name in graph.inputs if _is_transposed(graph.readers[name], TO_FIRST)]
    results = [
        name
        for name in graph.outputs
        if name in graph.writers and _is_transposed([graph.writers[name]], TO_LAST)
    ]
    if not images:
        return

    def without(_: OnnxGraph, node: Node) -> list[Node] | None:
        is_end = node.inputs[0] in images or node.outputs[0] in results
        if node.op_type != "Transpose" or not is_end:
            return None
        return [Node.new("Identity", node.inputs, node.outputs[0], node.name)]

    graph.rewrite(without)
    graph.save()
    for value in (*model.graph.input, *model.graph.output):
        if value.name in (*images, *results):
            dims = value.type.tensor_type.shape.dim
            channels = dims.pop()
            dims.insert(1, channels)


def _is_transposed(nodes: list[Node], order: list[int]) -> bool:
    """Return True if these nodes exist and all transpose in this order."""
    return bool(nodes) and all(
        node.op_type == "Transpose" and list(node.attributes.get("perm", [])) == order
        for node in nodes
    )
