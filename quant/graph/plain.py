"""Read networks of ConvBEERS' kind, the only ones that proofs, the stress battery and bit flips
accept.
"""

from onnx import ModelProto

from beers_deploy.quant.graph.operations import IMAGE, Activation, Add, Conv, Graph, same
from beers_deploy.quant.graph.reader import read_network
from beers_deploy.quant.graph.split_network import SplitNetwork, unsupported


def correction_graph(model: ModelProto) -> Graph:
    """Read a network of ConvBEERS' kind, which adds a correction to an image of one channel.

    The correction is computed by same-size convolutions of stride 1, ReLU and adds. It may run at
    full resolution, or at a lower one with the image's pixels rearranged into channels and back.

    Args:
        model: a simplified float network.

    Returns:
        The operations from the tensor `image` (N, S^2, H / S, W / S) to the tensor `correction` of
        the same shape, for blocks of S x S pixels.

    Raises:
        ModelError: a network of another kind.
    """
    network = read_network(model)
    blocks = [[shuffle.block for shuffle in end] for end in (network.front, network.back)]
    adds_to_one_channel = network == SplitNetwork(
        network.graph, front=network.front, back=network.back, limits=network.limits
    )
    if not (adds_to_one_channel and blocks[0] == blocks[1] and len(blocks[0]) <= 1):
        raise unsupported(
            "The network must read an image of one channel, and add it to its result at the end "
            "(a global add)."
        )
    for op in network.graph:
        if isinstance(op, Conv):
            alone = op.groups == 1 and not op.transposed and op.window == same(op.weight)
            is_plain = alone and op.activation in (Activation.none, Activation.relu)
        else:
            is_plain = isinstance(op, Add) and op.activation is Activation.none
        if not is_plain:
            raise unsupported(
                "The network may have only same-size convolutions of stride 1, ReLU and adds, but "
                f"it has {op.name}."
            )
    return network.graph


def image_channels(graph: Graph) -> int:
    """Return the number of channels in which the operations read an image of one channel.

    It is S^2 if blocks of S x S pixels were rearranged into channels.
    """
    return next(
        int(op.weight.shape[1]) for op in graph if isinstance(op, Conv) and op.input == IMAGE
    )
