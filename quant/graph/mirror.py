"""Find the border by which a network mirrors its image, which the host can do instead."""

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.resize import enlarges_image


def image_mirror(graph: OnnxGraph) -> tuple[Node, int] | None:
    """Return the Pad that mirrors the image, and its border in pixels; None if there is none that
    the host can do.

    It is the only Pad, by reflection and as wide on each side. The sum at the end may read the
    image without it, because the host adds the image, or enlarges it.

    Args:
        graph: the graph of a network of one image.
    """
    (image, *_) = graph.inputs
    pads = [node for node in graph.nodes if node.op_type == "Pad"]
    others = [node for node in graph.readers[image] if node not in pads]
    is_of_host = all(n.op_type == "Add" or enlarges_image(graph, n) for n in others)
    if len(pads) != 1 or pads[0].source != image or not is_of_host:
        return None
    (pad,) = pads
    amounts = graph.numbers(pad, 1, "pads") or [0]
    border_px = int(amounts[-1])
    is_even = amounts == [0, 0, border_px, border_px] * 2
    if pad.attribute("mode") != "reflect" or not is_even or border_px < 1:
        return None
    return pad, border_px
