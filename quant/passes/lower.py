"""Give a tensor behind ReLU all of int8: stored less 128 units, its ReLU is int8's own lower end.

int8 holds -128 to 127, and a tensor that is never below zero leaves half of that unused. Less 128
units of a scale twice as fine it fills all of it: the bias of the convolution that writes it goes
down by 128 units, saturation does what its ReLU did, and the biases of those that read it give back
what was taken off, times the sum of their weights. That sum is the same everywhere only where no
window reaches into the padding, whose zeros would no longer be zeros. So all readers must be
convolutions without padding, such as the 1 x 1 ones behind depthwise ones.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from beers_deploy.quant.core import INT8_MIN
from beers_deploy.quant.graph import Activation, Conv, Graph
from beers_deploy.quant.passes.equalise import Trial, rescaled
from beers_deploy.quant.passes.stream import lone_tensors, only

SPAN = 255
"""Units of int8 from its one end to the other."""


def lowerable(graph: Graph) -> list[str]:
    """The tensors behind ReLU or ReLU6 that only convolutions without padding read, in the graph's
    order.
    """
    relus = (Activation.relu, Activation.relu6)
    outputs = {
        op.output
        for op in graph
        if isinstance(op, Conv) and op.activation in relus and not op.offset
    }
    # A padded window sums the weights of its inner part alone, so no one bias would be right.
    padded = {
        op.input for op in graph if isinstance(op, Conv) and (any(op.window.pads) or op.transposed)
    }
    return [name for name in lone_tensors(graph) if name in outputs - padded]


def lowered(graph: Graph, name: str, frac_bits: int) -> Graph:
    """The same network with a tensor stored less 128 units of 2^-frac_bits, and given back to those
    that read it.

    Behind ReLU6 its channels are scaled until int8 ends no later than the six.

    Args:
        graph: plane-reading.
        name: of the tensor, one of `lowerable`.
        frac_bits: of its scale.
    """
    # Stored less this offset, zero is -128: int8's lower end then clips what ReLU clipped.
    offset = -INT8_MIN * 2.0**-frac_bits
    writer = next(op for op in graph if isinstance(op, Conv) and op.output == name)
    # The tensor reaches from 0 to 255 units now; where that is beyond the six, its channels grow.
    short = SPAN * 2.0**-frac_bits / writer.ceilings
    if writer.activation is Activation.relu6 and short.max() > 1:
        graph = rescaled(graph, only(name), np.maximum(short, 1))
    return tuple(_lowered(op, name, offset) if isinstance(op, Conv) else op for op in graph)


def _lowered(op: Conv, name: str, offset: float) -> Conv:
    if op.output == name:
        op = replace(op, offset=offset)
    if op.input == name:
        # Every input lacks the offset, so each result lacks it times the sum of its weights.
        bias = op.bias + offset * op.weight.sum((1, 2, 3), dtype=np.float64)
        op = replace(op, bias=bias.astype(np.float32))
    return op


def lower(graph: Graph, frac_bits: Mapping[str, int], trial: Trial) -> Graph:
    """The same network with those tensors lowered that cost less so: all of them, or else one after
    the other.

    Args:
        graph: plane-reading.
        frac_bits: of each tensor as it stands; lowered it has one more.
        trial: says what a graph costs, its weights and biases rounded as in the end.
    """
    names = lowerable(graph)
    if not names:
        return graph
    least = trial(graph)(None).sum()
    everything = graph
    # Half the range at the same 256 values is a scale twice as fine: one bit more.
    for name in names:
        everything = lowered(everything, name, frac_bits[name] + 1)
    if trial(everything)(None).sum() < least:
        return everything
    for name in reversed(names) if len(names) > 1 else ():
        candidate = lowered(graph, name, frac_bits[name] + 1)
        cost = trial(candidate)(None).sum()
        if cost < least:
            graph = candidate
            least = cost
    return graph
