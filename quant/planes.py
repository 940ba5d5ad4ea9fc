"""A 12-bit image for an int8 engine: coarse and remainder, and a third plane for finer weights.

    DN = 32 * coarse + remainder,   coarse in 0..127,   remainder in -16..31
    quarter = remainder / 4, rounded

All fit int8, and no bit is lost. Zero stays zero in all, so that the engine's zero padding means what it meant in
the float network. The first convolution reads them: the remainder's weights are the coarse ones / 32, the quarter's
are 0. In whole numbers that leaves the remainder's weights a size of 4 at most, and rounding them errs as much as all
behind it; `quant.passes.fit_weights` mends them in quarters by weights of the third plane. An engine that takes 16
channels at once computes it for nothing.
"""

from dataclasses import replace

import numpy as np

from quant.graph import IMAGE, Conv, Graph

PLANES = "planes"
MAX_DN = 4095
STEP = 32
COARSE_MAX = 127
QUARTER = 4
COUNT = 3
POSITION = 7
"""The planes' scale is 2^-7: coarse 127 stands for about 1, the full scale."""


def split(image: np.ndarray) -> np.ndarray:
    """(N, 1, H, W) float32 in [0, 1] to the planes (N, 3, H, W) int8."""
    dn = np.clip(np.rint(image * np.float32(MAX_DN)), 0, MAX_DN)
    coarse = np.minimum(np.rint(dn / STEP), COARSE_MAX)
    remainder = dn - STEP * coarse
    return np.concatenate([coarse, remainder, np.rint(remainder / QUARTER)], axis=1).astype(np.int8)


def read_planes(graph: Graph) -> Graph:
    """The same graph with a first convolution that reads the planes (as q * 2^-7) instead of the image."""
    first = graph[0]
    assert isinstance(first, Conv)  # noqa: S101 - correction_graph has seen to it
    assert first.input == IMAGE  # noqa: S101
    unit = np.float32(2.0**POSITION / MAX_DN)
    planes = [first.weight * (STEP * unit), first.weight * unit, np.zeros_like(first.weight)]
    weight = np.concatenate(planes, axis=1)
    return (replace(first, input=PLANES, weight=weight.astype(np.float32)), *graph[1:])


def coarse_plane_only(graph: Graph) -> Graph:
    """A plane-reading graph that does not look at the remainder: 7 bits of the image, to show what the others buy."""
    first = graph[0]
    assert isinstance(first, Conv)  # noqa: S101
    weight = first.weight.copy()
    weight[:, 1:] = 0
    return (replace(first, weight=weight), *graph[1:])
