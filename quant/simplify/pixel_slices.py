"""Write slices of rows and columns as depthwise convolutions that each read one pixel.

1. A U-Net without padding crops its skips to the size of the enlarged map. In a kernel of three
   rows the first and the last reach the border that is cut, and the one in the middle has the only
   weight, 1.
2. A wavelet transform selects every n-th row. The only weight of a kernel of stride n lies at its
   end, where the first selected row is.

Both are exact, and do not need the size of the image.
"""

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.standard_operators import slices_of

TO_THE_END = 1 << 30
"""A stop from this number on is that of a slice to the end."""


def convolve_slice(graph: OnnxGraph, node: Node) -> list[Node] | None:
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
