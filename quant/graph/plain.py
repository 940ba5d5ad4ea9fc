"""Networks of ConvBEERS' kind: what proofs, the stress battery, bit flips and the free regime take.

They add a correction to an image of one channel, and compute it by same-size convolutions of stride 1, ReLU and adds;
at full resolution, or at a lower one, with the image's pixels rearranged into channels and the correction's back.
"""

import onnx

from beers_deploy.quant.graph.network import Network, refused_graph
from beers_deploy.quant.graph.operations import IMAGE, Add, Conv, Graph, is_plain
from beers_deploy.quant.graph.reader import read_network


def plain_network(model: onnx.ModelProto) -> Network:
    """A network of that kind."""
    network = read_network(model)
    blocks = [[shuffle.block for shuffle in end] for end in (network.front, network.back)]
    same_ends = network == Network(network.graph, front=network.front, back=network.back)
    if not (same_ends and blocks[0] == blocks[1] and len(blocks[0]) <= 1):
        raise refused_graph("an image of one channel, and a global add of it at the end", "another network")
    for op in network.graph:
        if not (isinstance(op, Conv | Add) and is_plain(op)):
            raise refused_graph("only same-size convolutions of stride 1, ReLU and adds", op.name)
    return network


def correction_graph(model: onnx.ModelProto) -> Graph:
    """The operations of `plain_network`, from `image` (N, S^2, H / S, W / S) to `correction` of the same shape."""
    return plain_network(model).graph


def image_channels(graph: Graph) -> int:
    """Channels of the image as such operations read it: S^2, the pixels of a place."""
    return next(int(op.weight.shape[1]) for op in graph if isinstance(op, Conv) and op.input == IMAGE)
