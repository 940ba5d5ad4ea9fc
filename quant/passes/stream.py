"""What is done to the residual stream and to its last tensor, so that rounding them costs little.

One scale for the whole stream makes its adds exact. Two copies of the last stream tensor, rounded half a step
apart, together hold nine bits. Two gains for the correction: a fine one for nearly all pixels, a coarse one for the
strongest edges.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from quant.graph import Add, Conv, Graph

STREAM_FRAC_BITS = 8
"""Any would do: `equalise` scales the stream to it."""


def stream_tensors(graph: Graph) -> set[str]:
    """The tensors that adds read and write."""
    return {name for op in graph if isinstance(op, Add) for name in (*op.inputs, op.output)}


def share_stream_scale(graph: Graph, frac_bits: Mapping[str, int], shared: int) -> dict[str, int]:
    """The scales with one for the stream."""
    return {**frac_bits, **dict.fromkeys(stream_tensors(graph), shared)}


def common_frac_bits(graph: Graph, frac_bits: Mapping[str, int]) -> int:
    """The coarsest least-squares scale on the stream: what a stream that is not equalised takes."""
    return min((frac_bits[name] for name in stream_tensors(graph)), default=STREAM_FRAC_BITS)


OFFSETS = np.array([-0.25, 0.25])
"""What the two copies of a half-LSB pair add before they are rounded, in units of their step; the mean is 0."""


def half_lsb_pair(graph: Graph, step: float) -> Graph:
    """The graph with two copies of what its last convolution reads, where that is the sum of two convolutions.

    Args:
        graph: that ends with an add and a convolution; any other is returned as it is.
        step: the value of one unit of the tensors that the add reads and writes.
    """
    writers = {op.output: op for op in graph if isinstance(op, Conv) and not op.relu}
    before, end = graph[:-2], graph[-2:]
    add, tail = end if len(end) == 2 else (None, None)
    if not (isinstance(add, Add) and isinstance(tail, Conv) and set(add.inputs) <= set(writers)):
        return graph
    left, right = (_twice(writers[name], step) for name in add.inputs)
    read = {name for op in before for name in op.inputs}
    kept = [op for op in before if op.output in read or op.output not in add.inputs]
    both = replace(add, inputs=(left.output, right.output))
    halved = replace(tail, weight=np.concatenate([tail.weight / 2] * len(OFFSETS), axis=1))
    return (*kept, left, right, both, halved)


def _twice(op: Conv, step: float) -> Conv:
    """Its output channels down, then up."""
    bias = np.concatenate([op.bias + np.float32(offset * step) for offset in OFFSETS])
    weight = np.concatenate([op.weight] * len(OFFSETS))
    return replace(op, name=f"{op.name}.twice", output=f"{op.output}.twice", weight=weight, bias=bias)


GAIN = 8
FINE_MAX = 126
"""The largest size at which the fine channel is believed: one below int8's end."""


def two_gains(graph: Graph) -> Graph:
    """The graph with a last convolution of two output channels: fine, and coarse by GAIN."""
    last = graph[-1]
    assert isinstance(last, Conv)  # noqa: S101 - correction_graph ends with the tail
    weight = np.concatenate([last.weight, last.weight / GAIN])
    bias = np.concatenate([last.bias, last.bias / GAIN])
    return (*graph[:-1], replace(last, weight=weight.astype(np.float32), bias=bias.astype(np.float32)))


def merge(correction: np.ndarray, scale: float) -> np.ndarray:
    """The correction (N, 1, H, W) from one or two channels (N, 1 or 2, H, W) of multiples of `scale`."""
    if correction.shape[1] == 1:
        return correction
    fine, coarse = correction[:, :1], correction[:, 1:]
    return np.where(np.abs(fine) <= (FINE_MAX + 0.5) * scale, fine, coarse * np.float32(GAIN))
