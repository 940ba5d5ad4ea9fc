"""Find padding by reflection: of the image, which the host can do instead, and of other maps."""

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


def pads_of(graph: OnnxGraph, node: Node) -> tuple[int, ...]:
    """Return top, left, bottom and right of a Pad by reflection or edge that only convolutions
    read; empty for any other node.

    Args:
        graph: the graph that the node belongs to.
        node: any node.
    """
    if node.op_type != "Pad" or node.attribute("mode") not in ("edge", "reflect"):
        return ()
    readers = {reader.op_type for reader in graph.readers[node.result]}
    amounts = graph.numbers(node, 1, "pads") or []
    is_of_pixels = len(amounts) == 8 and not any((*amounts[:2], *amounts[4:6]))
    if readers != {"Conv"} or not is_of_pixels or min(amounts) < 0:
        return ()
    return (*amounts[2:4], *amounts[6:])
