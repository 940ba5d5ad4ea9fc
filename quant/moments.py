"""Second moments of what each convolution reads: from them follows what other weights would do to its result."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from quant.float_file import float_model
from quant.graph import Conv, Graph, tensors
from quant.pieces import crops, halo_of, planes_of, tensor_values
from quant.planes import PLANES
from quant.session import open_session

EVERY_PX = 4
"""Windows are taken so far apart in both directions: neighbours say nearly the same."""


@dataclass
class Moments:
    """Sums over windows x, (I kh kw,) each, that a convolution multiplies its weights with."""

    products: np.ndarray  # (n, n) float64, sum of x x^T
    total: np.ndarray  # (n,) float64, sum of x
    count: int = 0

    def add(self, windows: np.ndarray) -> None:
        """Count further windows (K, n) float32."""
        self.products += windows.T @ windows
        self.total += windows.sum(axis=0, dtype=np.float64)
        self.count += len(windows)

    @property
    def mean(self) -> np.ndarray:
        """(n,) mean window."""
        return np.asarray(self.total / self.count)

    @property
    def covariance(self) -> np.ndarray:
        """(n, n) covariance, a little of its mean variance added to the diagonal so that no direction is free."""
        covariance = self.products / self.count - np.outer(self.mean, self.mean)
        floor = 1e-6 * np.trace(covariance) / len(covariance)
        return np.asarray(covariance + floor * np.eye(len(covariance)))


def input_moments(graph: Graph, images: Iterable[np.ndarray], tick: Callable[[], None]) -> dict[str, Moments]:
    """The moments of every convolution of a plane-reading graph, by its name, over images (1, 1, H, W) in [0, 1].

    The values are those of the float network. `tick` is called once an image.
    """
    convs = [op for op in graph if isinstance(op, Conv)]
    found = {op.name: _nothing(op) for op in convs}
    names, halo_px = tensors(graph), halo_of(graph)
    session = open_session(float_model(graph, names))
    for image in images:
        for crop, values in zip(crops(image), tensor_values(session, names, image, halo_px), strict=True):
            read = {PLANES: planes_of(crop), **dict(zip(names, values, strict=True))}
            for op in convs:
                found[op.name].add(_windows(read[op.input], op))
        tick()
    return found


def _nothing(op: Conv) -> Moments:
    size = int(np.prod(op.weight.shape[1:]))
    return Moments(np.zeros((size, size)), np.zeros(size))


def _windows(values: np.ndarray, op: Conv) -> np.ndarray:
    """(K, I kh kw) of the windows within (1, I, H, W), some pixels apart."""
    kernel = op.weight.shape[2:]
    windows = sliding_window_view(values[0], kernel, axis=(1, 2))[:, ::EVERY_PX, ::EVERY_PX]
    return np.ascontiguousarray(windows.transpose(1, 2, 0, 3, 4)).reshape(-1, int(np.prod(op.weight.shape[1:])))
