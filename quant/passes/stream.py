"""What is done to the residual stream and to its last tensor, so that rounding them costs little.

One scale for the whole stream makes its adds exact. Two gains for the correction: a fine one for
nearly all pixels, a coarse one for the strongest edges. Windows for a result that nothing is added
to: fine ones side by side over all that it can be, and a coarse one for what lies outside.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, chain, repeat

import numpy as np

from beers_deploy.quant.core import INT8_MAX
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Op,
    Resize,
    channels_of,
)
from beers_deploy.quant.graph.operations import SIX, united
from beers_deploy.quant.host_part import FINE_MAX, OutputDecoding

STREAM_FRAC_BITS = 8
"""Any would do: `equalise` scales the stream to it."""


Stream = Mapping[str, slice]
"""Tensors that have the same factors, channel by channel: each is added to another of them, or is
such a sum, or what a pool, an enlargement or a concat makes of them. And where in the factors the
channels of each stand.
"""
PASSING = (Concat, MaxPool, AveragePool, Resize)
"""What hands channels on without mixing them."""


def only(name: str) -> Stream:
    """A tensor by itself."""
    return {name: slice(None)}


def streams(graph: Graph) -> list[Stream]:
    """The streams that can share a scale and be equalised, in the order of the graph.

    Those that convolutions and adds alone write and read, and what hands channels on, with nothing
    between that a factor does not pass; so not where a product, a pixel shuffle or the network's
    end reads them.
    """
    linking = [op for op in graph if isinstance(op, (Add, *PASSING))]
    leader = united((*op.inputs, op.output) for op in linking)
    sums = {leader[op.output] for op in linking if isinstance(op, Add)}
    groups = [
        [name for name in leader if leader[name] == first]
        for first in dict.fromkeys(leader.values())
    ]
    placed = [_placed(linking, group, graph) for group in groups if leader[group[0]] in sums]
    return [group for group in placed if group and _passes_factors(graph, group)]


def _placed(linking: Sequence[Op], names: Sequence[str], graph: Graph) -> Stream:
    """Where the channels of these tensors stand; nowhere where one would have to stand in two
    places.
    """
    writers = [op for op in linking if op.output in names]
    # Only a concat puts channels at other places than those of its inputs.
    if not any(isinstance(op, Concat) for op in writers):
        return dict.fromkeys(names, slice(None))
    planes = next(op.weight.shape[1] for op in graph if isinstance(op, Conv))
    widths = channels_of(graph, {PLANES: planes})
    links = list(chain.from_iterable(_links(op, widths) for op in writers))
    first = {names[0]: 0}
    # The tensors are linked to each other, so every sweep places at least one more.
    while len(first) < len(names):
        for part, result, by in links:
            if result in first:
                first.setdefault(part, first[result] + by)
            elif part in first:
                first[result] = first[part] - by
    # A channel at two places would need two factors.
    if any(first[part] != first[result] + by for part, result, by in links):
        return {}
    least = min(first.values())
    return {
        name: slice(start - least, start - least + widths[name]) for name, start in first.items()
    }


def _links(op: Op, widths: Mapping[str, int]) -> list[tuple[str, str, int]]:
    """What an operation reads, what it writes, and where in that the channels of the one stand."""
    before = accumulate((widths[name] for name in op.inputs[:-1]), initial=0)
    offsets = before if isinstance(op, Concat) else repeat(0, len(op.inputs))
    return [(name, op.output, by) for name, by in zip(op.inputs, offsets, strict=True)]


def exceeds_six(graph: Graph, stream: Stream, frac_bits: Mapping[str, int]) -> bool:
    """Whether a ReLU6 writes to it, and int8 ends beyond the six in one of its tensors."""
    clipped = any(
        isinstance(op, Conv) and op.activation is Activation.relu6 and op.output in stream
        for op in graph
    )
    # Where int8 ends beyond the six there are larger sums, and its end cannot serve as their clip.
    return clipped and any(INT8_MAX * 2.0 ** -frac_bits[name] > SIX for name in stream)


def lone_tensors(graph: Graph) -> list[str]:
    """Tensors of no stream that convolutions alone write and read: each of their channels may have
    a factor.
    """
    adds = [op for op in graph if isinstance(op, Add)]
    terms = set(chain.from_iterable((*op.inputs, op.output) for op in adds))
    outputs = [op.output for op in graph if isinstance(op, Conv) and op.output not in terms]
    passing = set(chain.from_iterable(op.inputs for op in graph if isinstance(op, PASSING)))
    return [name for name in outputs if name not in passing and _passes_factors(graph, only(name))]


def _passes_factors(graph: Graph, stream: Stream) -> bool:
    """Whether factors pass; through ReLU6 where `equalise` may make int8's end its clip, so not
    behind an add.
    """
    touching = [op for op in graph if stream.keys() & {*op.inputs, op.output}]
    # The host writes the planes and reads the correction, and knows no factors.
    if stream.keys() & {PLANES, CORRECTION}:
        return False
    if not all(isinstance(op, (Conv, Add, *PASSING)) for op in touching):
        return False
    return all(
        op.activation.homogeneous or (isinstance(op, Conv) and op.activation is Activation.relu6)
        for op in touching
        if op.output in stream and isinstance(op, Conv | Add)
    )


def in_copies(graph: Graph, decoding: OutputDecoding) -> Graph:
    """Return the graph whose last convolution writes the copies that the host decodes.

    Args:
        graph: if there are several copies, one for which `takes_gains` is True.
        decoding: the host's.
    """
    if decoding.copies == 1:
        return graph
    *before, last = graph
    assert isinstance(last, Conv)  # noqa: S101 - takes_gains has seen to it
    weight = np.concatenate([last.weight / gain for gain in decoding.gains])
    bias = np.concatenate([last.bias / gain for gain in decoding.gains]).astype(np.float64)
    # The host adds the offsets of the last copies, so these copies are written without them.
    offsets = np.ravel(decoding.offsets)
    bias[len(bias) - len(offsets) :] -= offsets
    return (*before, replace(last, weight=weight.astype(np.float32), bias=bias.astype(np.float32)))


MAX_WINDOWS = 8
MAX_CHANNELS = 4096
"""That a convolution of the DPU writes."""


def window_offsets(low: np.ndarray, high: np.ndarray, unit: float) -> np.ndarray:
    """The middles (W, C) of as many windows of int8, its step `unit`, as hold values from low to
    high, (C,) each.
    """
    # The coarse copy takes one of the places that a convolution's channels have.
    most = min(MAX_WINDOWS, MAX_CHANNELS // len(low) - 1)
    # A window is believed up to FINE_MAX units on either side of its middle.
    needed = np.ceil((high - low).max() / (2 * FINE_MAX * unit))
    count = int(np.clip(needed, 1, max(most, 1)))
    shares = (np.arange(count)[:, None] + 0.5) / count
    return np.asarray(low + shares * (high - low))


def takes_gains(graph: Graph) -> bool:
    """Whether the last operation is a convolution that can write its channels twice."""
    last = graph[-1]
    return isinstance(last, Conv) and last.activation is Activation.none and last.groups == 1
