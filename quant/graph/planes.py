"""How an image of 12 bits enters a network of int8: in planes, a coarse one and what it leaves.

Each channel becomes a coarse plane, its remainder, and a third for finer weights: (N, C, H, W) to (N, 3 C, H, W), all
coarse planes first. Convolutions alone read them (`quant.graph.network` sees to it).
"""

from dataclasses import replace

import numpy as np

from beers_deploy.model.io.images import MAX_DN
from beers_deploy.quant.graph.operations import IMAGE, Conv, Graph

PLANES = "planes"
STEP = 32
COARSE_MAX = 127
QUARTER = 4
COUNT = 3
PLANES_FRAC_BITS = 7
"""The planes' scale is 2^-7: coarse 127 stands for about 1, the full scale."""


def split(image: np.ndarray, count: int = COUNT) -> np.ndarray:
    """(N, C, H, W) float32 in [0, 1] to the planes (N, count C, H, W) int8."""
    dn = np.clip(np.rint(image * np.float32(MAX_DN)), 0, MAX_DN)
    coarse = np.minimum(np.rint(dn / STEP), COARSE_MAX)
    remainder = dn - STEP * coarse
    planes = [coarse, remainder, np.rint(remainder / QUARTER)]
    return np.concatenate(planes[:count], axis=1).astype(np.int8)


def read_planes(graph: Graph) -> Graph:
    """The same graph, the convolutions that read the image reading the planes (as q * 2^-7) instead."""
    return tuple(_reads_planes(op) if isinstance(op, Conv) and op.input == IMAGE else op for op in graph)


def _reads_planes(op: Conv) -> Conv:
    unit = np.float32(2.0**PLANES_FRAC_BITS / MAX_DN)
    weight = dense(op).weight
    planes = [weight * (STEP * unit), weight * unit, np.zeros_like(weight)]
    return replace(op, input=PLANES, weight=np.concatenate(planes, axis=1).astype(np.float32), groups=1)


def dense(op: Conv) -> Conv:
    """A depthwise convolution as one of a single group; any other as it is."""
    if op.groups == 1:
        return op
    weight = np.zeros((len(op.weight), op.groups, *op.weight.shape[2:]), np.float32)
    channels = np.arange(op.groups)
    weight[channels, channels] = op.weight[:, 0]
    return replace(op, weight=weight, groups=1)
