"""Choose the power-of-two scale of every tensor.

1. The largest value of each tensor over calibration gives the finest scale that clips nothing.
2. That scale and finer ones are compared by their squared errors: a finer one rounds less and clips
   more.
3. Each tensor gets the scale of least error. Tensors that must share a scale (`quant.graph.tied`)
   get the one of least error in all of them together.
"""

from collections.abc import Callable, Iterable

import numpy as np

from beers_deploy.quant.frac_bits import CANDIDATES, squared_errors, unclipped_frac_bits
from beers_deploy.quant.graph import PLANES, PLANES_FRAC_BITS, Graph, tensors, tied
from beers_deploy.quant.host_part import ONE_CHANNEL, HostPart
from beers_deploy.quant.session import values_of


def choose_frac_bits(
    graph: Graph,
    images: Iterable[np.ndarray],
    host_part: HostPart = ONE_CHANNEL,
    least_squares: bool = True,
) -> dict[str, int]:
    """Choose the power-of-two scale of every tensor of a float graph.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.
        images: calibration images (1, C, H, W) as the network reads them. They are read twice.
        host_part: the host's pre- and post-processing around the graph.
        least_squares: True chooses the scale of least squared error. False chooses the finest scale
            that clips no value.

    Returns:
        The number of fractional bits of each tensor's scale, by the tensor's name.
    """
    names = tensors(graph)
    shared = tied(graph)
    # The planes' scale is fixed; -1 stands for the group of tensors that are tied to them.
    groups = np.array(
        [names.index(shared[name]) if shared[name] in names else -1 for name in names]
    )

    def together(of_each: np.ndarray, join: Callable[..., np.ndarray]) -> np.ndarray:
        return np.stack([join(of_each[groups == group], axis=0) for group in groups])

    # 1.
    largest = np.zeros(len(names))
    for results in values_of(graph, names, images, host_part):
        largest = np.maximum(largest, [float(np.abs(r).max()) for r in results])
    best = np.array([unclipped_frac_bits(m) for m in together(largest, np.max)])
    if least_squares:
        # 2.
        errors = np.zeros((len(names), CANDIDATES))
        for results in values_of(graph, names, images, host_part):
            errors += [squared_errors(r[0], int(f)) for r, f in zip(results, best, strict=True)]
        # 3.
        best = best + np.argmin(together(errors, np.sum), axis=1)
    return {PLANES: PLANES_FRAC_BITS, **dict(zip(names, best.tolist(), strict=True))}
