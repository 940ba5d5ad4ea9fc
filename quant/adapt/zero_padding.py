"""Pad maps by zeros where a network pads them by reflection or by their edge.

1. Each convolution pads by zeros what the Pad in front of it added.
2. A Pad mirrors the image beyond its borders, and a Slice crops the result by as much. The host
   computes both. Zeros then lie outside of the image, so that little of it changes.
"""

import numpy as np
import onnx

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.quant.graph.mirror import pads_of
from beers_deploy.quant.onnx.graph import Node, OnnxGraph, Replacement
from beers_deploy.quant.tiling.receptive_field import tiling_of

MIRRORED_PX = 16
"""The width of the mirrored border in pixels, rounded up to a multiple of the strides."""


def pad_by_zeros(model: onnx.ModelProto) -> None:
    """Replace reflecting padding in a float network, in place.

    Args:
        model: a simplified float network whose result has the size of its image, or a multiple.

    Raises:
        ModelError: the network computes with its whole image.
    """
    graph = OnnxGraph(model)
    # 1.
    graph.rewrite(_padded)
    graph.save()
    # 2.
    try:
        tiling = tiling_of(model)
    except ModelError as error:
        raise ModelError(
            "Reflecting padding cannot be replaced in this network, because it computes with the "
            "whole image, and the replacement adds a mirrored border to the image. Pad by zeros, "
            "and train the network again."
        ) from error
    border_px = up_to_multiple(MIRRORED_PX, tiling.alignment_px)
    crop_px = int(border_px * tiling.scale)
    (image,) = graph.inputs
    (result,) = graph.outputs
    mirrored = f"{image}.mirrored"
    whole = f"{result}.whole"
    for node in graph.nodes:
        node.read_instead(image, mirrored)
    graph.rename(result, whole)
    ends = [[crop_px] * 2, [-crop_px] * 2, [2, 3]]
    places = [
        graph.add_constant(f"{whole}.{k}", numbers, np.int64) for k, numbers in enumerate(ends)
    ]
    crop = Node.new("Slice", [whole, *places], result, f"{result}.cropped")
    graph.set_nodes([graph.mirrored(image, border_px, mirrored), *graph.nodes, crop])
    graph.save()


def _padded(graph: OnnxGraph, node: Node) -> Replacement:
    """Return a convolution that pads by zeros what the Pad in front of it adds; None for others."""
    pad = graph.writer(node.source)
    pads = pads_of(graph, pad) if node.op_type == "Conv" else ()
    if not pads:
        return None
    own = node.attribute("pads", [0] * 4)
    attributes = {**node.attributes, "pads": [sum(both) for both in zip(own, pads, strict=True)]}
    return [node.replaced_by("Conv", [pad.source, *node.inputs[1:]], **attributes)]
