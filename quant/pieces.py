"""Large images in pieces: looking at every tensor of a network at once costs memory that grows with the image."""

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np
import onnxruntime as ort

from quant.graph import Conv, Graph
from quant.planes import PLANES, POSITION, split
from quant.session import require_finite

PIECE_PX = 128
"""Side of the largest piece, halo not counted."""


def crops(image: np.ndarray) -> list[np.ndarray]:
    """Crops (1, 1, h, w) of at most PIECE_PX a side that tile an image (1, 1, H, W): small images by themselves."""
    return [image[..., slice(*rows), slice(*columns)] for rows, columns in _places(image)]


def tensor_values(
    session: ort.InferenceSession, names: list[str], image: np.ndarray, halo_px: int
) -> Iterator[list[np.ndarray]]:
    """The named tensors (1, C, h, w) of a plane-reading float network, piece by piece of an image (1, 1, H, W).

    Each piece is computed with a halo of the pixels that its values depend on, which is then cut off: together the
    pieces hold what the whole image would have given, its zero-padded borders included.

    Raises:
        ModelError: NaN or infinity inside the network.
    """
    for (top, bottom), (left, right) in _places(image):
        above, before = min(top, halo_px), min(left, halo_px)
        with_halo = image[..., top - above : bottom + halo_px, left - before : right + halo_px]
        inner = ..., slice(above, above + bottom - top), slice(before, before + right - left)
        values = [result[inner] for result in session.run(names, {PLANES: planes_of(with_halo)})]
        require_finite(values, "float network")
        yield values


def planes_of(image: np.ndarray) -> np.ndarray:
    """An image (N, 1, H, W) in [0, 1] as a plane-reading float network takes it: (N, 3, H, W) float32."""
    return split(image).astype(np.float32) * np.float32(2.0**-POSITION)


def halo_of(graph: Graph) -> int:
    """Pixels on each side that a value can depend on: no path passes more than all of the convolutions."""
    return sum(op.pad_px for op in graph if isinstance(op, Conv))


def _places(image: np.ndarray) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """(top, bottom) and (left, right) of every piece, all about equally large."""
    height, width = image.shape[-2:]
    return product(pairwise(_edges(height)), pairwise(_edges(width)))


def _edges(size: int) -> list[int]:
    count = -(-size // PIECE_PX)
    return [size * k // count for k in range(count + 1)]
