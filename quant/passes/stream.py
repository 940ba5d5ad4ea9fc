"""What is done to the residual stream and to its last tensor, so that rounding them costs little.

One scale for the whole stream makes its adds exact. Two copies of the last stream tensor, rounded half a step
apart, together hold nine bits. Two gains for the correction: a fine one for nearly all pixels, a coarse one for the
strongest edges. Windows for a result that nothing is added to: fine ones side by side over all that it can be, and a
coarse one for what lies outside.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from beers_deploy.quant.ends import FINE_MAX, GAIN
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, Add, Conv, Graph
from beers_deploy.quant.graph.operations import united

STREAM_FRAC_BITS = 8
"""Any would do: `equalise` scales the stream to it."""


Stream = frozenset[str]
"""Tensors that adds read and write: each is added to another of them, or is such a sum."""


def streams(graph: Graph) -> list[Stream]:
    """The streams that can share a scale and be equalised, in the order of the graph.

    Those that convolutions and adds alone write and read, with nothing between that a factor does not pass; so not
    where a pool, a concat or the network's end reads them.
    """
    leader = united((*op.inputs, op.output) for op in graph if isinstance(op, Add))
    groups = [frozenset(name for name in leader if leader[name] == first) for first in dict.fromkeys(leader.values())]
    return [group for group in groups if _passes_factors(graph, group)]


def lone_tensors(graph: Graph) -> list[str]:
    """Tensors of no stream that convolutions alone write and read: each of their channels may have a factor."""
    added = {name for op in graph if isinstance(op, Add) for name in (*op.inputs, op.output)}
    written = [op.output for op in graph if isinstance(op, Conv) and op.output not in added]
    return [name for name in written if _passes_factors(graph, frozenset([name]))]


def _passes_factors(graph: Graph, stream: Stream) -> bool:
    touching = [op for op in graph if stream.intersection((*op.inputs, op.output))]
    known = all(isinstance(op, Conv | Add) for op in touching)
    writers = [op for op in touching if op.output in stream]
    homogeneous = all(isinstance(op, Conv | Add) and _passes(op.activation, len(stream) == 1) for op in writers)
    return known and homogeneous and not stream & {PLANES, CORRECTION}


def _passes(activation: Activation, lone: bool) -> bool:
    """Whether factors pass; ReLU6 where `equalise` may make int8's end its clip, so not of sums that exceed six."""
    return activation.homogeneous or (lone and activation is Activation.relu6)


def share_stream_scale(streams: Iterable[Stream], frac_bits: Mapping[str, int]) -> dict[str, int]:
    """The scales with one for all streams."""
    return {**frac_bits, **{name: STREAM_FRAC_BITS for stream in streams for name in stream}}


OFFSETS = np.array([-0.25, 0.25])
"""What the two copies of a half-LSB pair add before they are rounded, in units of their step; the mean is 0."""


def half_lsb_pair(graph: Graph, step: float) -> Graph:
    """The graph with two copies of what its last convolution reads, where that is the sum of two convolutions.

    Args:
        graph: that ends with an add and a convolution; any other is returned as it is.
        step: the value of one unit of the tensors that the add reads and writes.
    """
    *before, add, tail = graph if len(graph) > 1 else (None, None)
    if not (isinstance(add, Add) and isinstance(tail, Conv)):
        return graph
    writers = {op.output: op for op in graph if isinstance(op, Conv) and _plain(op)}
    two = add.activation is Activation.none and len(set(add.inputs)) == 2 and set(add.inputs) <= set(writers)
    shared = any(add.output in stream for stream in streams(graph))
    if not (shared and two and tail.groups == 1 and tail.input == add.output):
        return graph
    left, right = (_twice(writers[name], step) for name in add.inputs)
    read = {name for op in before for name in op.inputs}
    kept = [op for op in before if op.output in read or op.output not in add.inputs]
    both = replace(add, inputs=(left.output, right.output))
    halved = replace(tail, weight=np.concatenate([tail.weight / 2] * len(OFFSETS), axis=1))
    return (*kept, left, right, both, halved)


def _plain(op: Conv) -> bool:
    return op.activation is Activation.none and op.groups == 1


def _twice(op: Conv, step: float) -> Conv:
    """Its output channels down, then up."""
    bias = np.concatenate([op.bias + np.float32(offset * step) for offset in OFFSETS])
    weight = np.concatenate([op.weight] * len(OFFSETS))
    return replace(op, name=f"{op.name}.twice", output=f"{op.output}.twice", weight=weight, bias=bias)


def two_gains(graph: Graph) -> Graph:
    """The graph whose last convolution writes its channels twice: fine, and coarse by GAIN.

    Any other last operation stays as it is, and so does one with an activation that factors do not pass.
    """
    last = graph[-1]
    if not takes_gains(graph):
        return graph
    assert isinstance(last, Conv)  # noqa: S101
    weight = np.concatenate([last.weight, last.weight / GAIN])
    bias = np.concatenate([last.bias, last.bias / GAIN])
    return (*graph[:-1], replace(last, weight=weight.astype(np.float32), bias=bias.astype(np.float32)))


def windowed(graph: Graph, offsets: np.ndarray) -> Graph:
    """The graph whose last convolution writes its channels coarse by GAIN, then less each of the offsets (W, C)."""
    last = graph[-1]
    assert isinstance(last, Conv)  # noqa: S101 - takes_gains has seen to it
    weight = np.concatenate([last.weight / GAIN, *[last.weight] * len(offsets)])
    bias = np.concatenate([last.bias / GAIN, *(last.bias - offset for offset in offsets)])
    return (*graph[:-1], replace(last, weight=weight.astype(np.float32), bias=bias.astype(np.float32)))


MAX_WINDOWS = 8
MAX_CHANNELS = 4096
"""That a convolution of the DPU writes."""


def window_offsets(low: np.ndarray, high: np.ndarray, unit: float) -> np.ndarray:
    """The middles (W, C) of as many windows of int8, its step `unit`, as hold values from low to high, (C,) each."""
    most = min(MAX_WINDOWS, MAX_CHANNELS // len(low) - 1)
    count = int(np.clip(np.ceil((high - low).max() / (2 * FINE_MAX * unit)), 1, max(most, 1)))
    shares = (np.arange(count)[:, None] + 0.5) / count
    return np.asarray(low + shares * (high - low))


def takes_gains(graph: Graph) -> bool:
    """Whether the last operation is a convolution that can write its channels twice."""
    last = graph[-1]
    return isinstance(last, Conv) and last.activation is Activation.none and last.groups == 1
