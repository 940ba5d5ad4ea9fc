"""Write the result in several copies, so that rounding its small values costs little.

1. A correction that the host adds to the image is written twice: fine for nearly all pixels, and
   coarser by GAIN for the strongest edges, which clip in the fine copy.
2. A result to which nothing is added is written in windows: fine copies side by side over its whole
   float range, and one coarser by GAIN for values outside.
3. Nothing is done if the last operation is no convolution that can write copies, or if its channels
   would be too many for the DPU.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from beers_deploy.quant.graph import CORRECTION, Activation, Conv, Graph
from beers_deploy.quant.host_part import FINE_MAX, HostPart, OffsetWindows, OutputDecoding
from beers_deploy.quant.session import values_of

MAX_WINDOWS = 8
MAX_CHANNELS = 4096
"""The maximum number of channels that a convolution of the DPU writes."""


def can_write_copies(graph: Graph) -> bool:
    """Return True if the last operation is a convolution that can write each of its channels
    several times.

    It must not be depthwise, and must have no activation.
    """
    last = graph[-1]
    return isinstance(last, Conv) and last.activation is Activation.none and last.groups == 1


def with_copies(graph: Graph, decoding: OutputDecoding) -> Graph:
    """Return the graph whose last convolution writes each result channel in all copies that the
    host decodes.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into. If the decoding
            has several copies, `can_write_copies` must be True for it.
        decoding: the host's decoding, which states the copies and the factor of each.

    Returns:
        The graph; `graph` itself if there is one copy only.
    """
    if decoding.copies == 1:
        return graph
    *before, last = graph
    assert isinstance(last, Conv)  # noqa: S101 - can_write_copies has seen to it
    weight = np.concatenate([last.weight / gain for gain in decoding.gains])
    bias = np.concatenate([last.bias / gain for gain in decoding.gains]).astype(np.float64)
    # 2. The host adds the offsets of the windows, which come last, so they are written without.
    offsets = np.ravel(decoding.offsets)
    bias[len(bias) - len(offsets) :] -= offsets
    return (*before, replace(last, weight=weight.astype(np.float32), bias=bias.astype(np.float32)))


def with_windows(
    graph: Graph, host_part: HostPart, frac_bits: int, images: Iterable[np.ndarray]
) -> HostPart:
    """Return a host part that decodes the result from int8 windows over its float range, if that
    helps.

    A window is a copy of the result that is clipped outside a part of the range, and finer by GAIN
    than one copy over all of it.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.
        host_part: the host's pre- and post-processing around the network.
        frac_bits: the number of fractional bits of the result's scale as a single copy.
        images: calibration images (1, C, H, W), on which the range of the result is measured.

    Returns:
        The host part with windows; `host_part` itself if the result needs none.
    """
    plain = host_part.decoding.copies == 1 and not host_part.adds_image
    # 3. One convolution of the DPU has to write the coarse copy and a window at the least.
    if not (plain and can_write_copies(graph) and host_part.outputs <= MAX_CHANNELS // 2):
        return host_part
    low = np.array(np.inf)
    high = np.array(-np.inf)
    for (result,) in values_of(graph, [CORRECTION], images, host_part):
        low = np.minimum(low, result[0].min((1, 2)))
        high = np.maximum(high, result[0].max((1, 2)))
    # The coarse copy takes one of the places that a convolution's channels have.
    most = min(MAX_WINDOWS, MAX_CHANNELS // len(low) - 1)
    # The result of a window is used up to FINE_MAX units on either side of its middle.
    unit = 2.0 ** -(frac_bits + OffsetWindows.finer_bits)
    needed = np.ceil((high - low).max() / (2 * FINE_MAX * unit))
    count = int(np.clip(needed, 1, max(most, 1)))
    shares = (np.arange(count)[:, None] + 0.5) / count
    windows = tuple(tuple(map(float, window)) for window in low + shares * (high - low))
    return replace(host_part, decoding=OffsetWindows(windows))
