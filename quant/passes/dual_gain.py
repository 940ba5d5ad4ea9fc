"""Two gains for the correction: a fine one for nearly all pixels, a coarse one for the strongest edges.

A correction of a few DN wants a fine step, one of a thousand DN at an edge wants range; int8 holds one of the two. So
the last convolution gets a second output channel with its weights divided by GAIN: the same tensor, the same
position, GAIN times the range. The host takes the fine one unless it has come to int8's end.
"""

from dataclasses import replace

import numpy as np

from quant.graph import Conv, Graph

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
