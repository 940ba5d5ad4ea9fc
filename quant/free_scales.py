"""Float scales by least squares, from streamed counts: one number a tensor, one an output channel of a weight.

The squared error of rounding and clipping depends on a tensor only through how often each value occurs. So its sizes
are counted in BINS steps of the largest, patch by patch, and every scale is judged on the counts: memory does not
grow with what is looked at.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from quant.float_file import float_model
from quant.graph import Graph
from quant.pieces import halo_of, tensor_values
from quant.positions import INT8_MAX
from quant.session import open_session

BINS = 4096
"""Sixteen and more a step of an 8-bit number."""

SHARES = np.linspace(0.3, 1.0, 71)
"""Scales tried, as shares of the one that clips nothing."""


@dataclass(frozen=True)
class RoundedWeight:
    """An int8 weight with one scale an output channel: (O, I, kh, kw) int8 in [-127, 127] and (O,) float32."""

    values: np.ndarray
    scales: np.ndarray


def tensor_scales(
    graph: Graph, levels: Mapping[str, int], images: Iterable[np.ndarray], tick: Callable[[], None]
) -> dict[str, float]:
    """The least-squares scale of each named tensor of a plane-reading graph.

    Args:
        graph: that reads the planes.
        levels: names, and the largest whole number that the size of a value may take: 255, or 127 beside a sign.
        images: (1, 1, H, W) float32 in [0, 1], passed over twice; one is in memory at a time.
        tick: called once per image and pass.
    """
    names, halo_px = list(levels), halo_of(graph)
    session = open_session(float_model(graph, names))

    def sizes() -> Iterator[list[np.ndarray]]:
        for image in images:
            for results in tensor_values(session, names, image, halo_px):
                yield [np.abs(r) for r in results]
            tick()

    largest = np.zeros(len(names))
    for results in sizes():
        largest = np.maximum(largest, [float(r.max()) for r in results])
    largest[largest == 0] = 1  # a tensor that is always zero: any scale will do
    counts = np.zeros((len(names), BINS + 1))
    for results in sizes():
        counts += [_counts(r, float(high)) for r, high in zip(results, largest, strict=True)]
    return {
        name: best_scale(count, float(high), levels[name])
        for name, count, high in zip(names, counts, largest, strict=True)
    }


def best_scale(counts: np.ndarray, largest: float, levels: int) -> float:
    """The scale of least squared error, of sizes counted at 0, largest / BINS, ... largest."""
    sizes = np.linspace(0, largest, BINS + 1)
    tried = SHARES * largest / levels
    errors = [np.dot(counts, (np.minimum(np.rint(sizes / s), levels) * s - sizes) ** 2) for s in tried]
    return float(tried[int(np.argmin(errors))])


def round_weight(weight: np.ndarray, finest: np.ndarray) -> RoundedWeight:
    """Each output channel at its own least-squares scale, but none below `finest` (O,); one of zeros at scale 1."""
    rows = np.asarray(weight, np.float64).reshape(len(weight), -1)
    scales = np.maximum(_row_scales(rows), finest).astype(np.float32)
    return RoundedWeight(_whole(rows, scales).astype(np.int8).reshape(weight.shape), scales)


def _row_scales(rows: np.ndarray) -> np.ndarray:
    """(O,) for rows (O, n): a share at a time for all rows, because a search asks for it at every trial."""
    largest = np.abs(rows).max(axis=1)
    best, least = np.ones(len(rows)), np.full(len(rows), np.inf)
    for share in SHARES:
        tried = np.where(largest > 0, share * largest / INT8_MAX, 1.0)
        error = np.square(_whole(rows, tried) * tried[:, None] - rows).sum(axis=1)
        best, least = np.where(error < least, tried, best), np.minimum(error, least)
    return best


def _whole(rows: np.ndarray, scales: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.rint(rows / scales[:, None]), -INT8_MAX, INT8_MAX))


def _counts(sizes: np.ndarray, largest: float) -> np.ndarray:
    places = np.rint(sizes.ravel() * np.float32(BINS / largest)).astype(np.int32)
    return np.bincount(np.minimum(places, BINS), minlength=BINS + 1)
