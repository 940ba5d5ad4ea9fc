"""Write the slices that cut a border off a map as convolutions that each read one pixel.

A U-Net without padding crops its skips to the size of the enlarged map. In a kernel of three rows
the first and the last reach the border that is cut, and the one in the middle has the only weight,
1. It is exact, and does not need the size of the image.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.standard_operators import Shapes, slices_of


def convolve_crop(shapes: Shapes, graph: OnnxGraph, node: Node) -> list[Node] | None:
    """Replace a Slice that cuts a border off a map by a depthwise convolution that has the same
    result.

    Args:
        shapes: the sizes of each float tensor by name, as `float_shapes` returns them.
        graph: the graph that the node belongs to; its constants are extended.
        node: any node.

    Returns:
        The convolution. None for a Slice that does not cut the same number of pixels at either
        side, and for any other node.
    """
    size = shapes.get(node.inputs[0], ()) if node.op_type == "Slice" else ()
    if len(size) != 4 or size[1] < 1:
        return None
    border_px = {2: 0, 3: 0}
    cuts = slices_of(graph, node)
    for axis, cut in cuts.items():
        # A window without padding cuts as much at either side, so both cuts must be equal.
        is_crop = cut.step == 1 and cut.stop in (-cut.start, size[axis] - cut.start)
        if axis not in border_px or cut.start <= 0 or not is_crop:
            return None
        border_px[axis] = cut.start
    if not cuts:
        return None
    # Dilated by the border, a kernel of three shortens the map by the border on either side.
    kernel = [3 if px else 1 for px in border_px.values()]
    weight = np.zeros((size[1], 1, *kernel))
    weight[:, :, kernel[0] // 2, kernel[1] // 2] = 1
    dilations = [px or 1 for px in border_px.values()]
    source = node.inputs[0]
    result = node.outputs[0]
    return [
        graph.convolution(source, result, node.name, weight, dilations=dilations, group=size[1])
    ]
