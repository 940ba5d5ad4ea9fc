"""Let dead channels carry copies of the others, so that each of these is rounded twice, at no cost
on a board.

A channel behind ReLU that is zero on all calibration patches does nothing. The channel whose
rounding costs most may be computed there once more: what reads the two takes half of each, and
their errors, at scales a little apart, partly cancel. Where depthwise convolutions follow one
another the copy goes through all of them. A network without a global add has its image in such
tensors, and training with ReLU leaves a third of their channels dead and more.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from beers_deploy.quant.ends import Ends
from beers_deploy.quant.graph import Conv, Graph
from beers_deploy.quant.passes.equalise import largest_sizes

APART = 0.87
"""The range of a copy is divided by it, so that levelling gives it another scale than its channel
has.
"""

Copies = Mapping[str, np.ndarray]
"""The channels of each tensor that are copies."""


def with_copies(
    graph: Graph, names: Collection[str], images: Iterable[np.ndarray], ends: Ends
) -> tuple[Graph, Copies]:
    """The graph with as many copies as it has dead channels, and which these are.

    Args:
        graph: plane-reading.
        names: the tensors that may have factors by channel (`quant.passes.stream.lone_tensors`).
        images: (1, C, H, W) on which a dead channel is zero.
        ends: what the host does to the images.
    """
    copies_by_tensor = dict[str, np.ndarray]()
    paths = runs(graph, names)
    # What dense convolutions read is the last tensor of a run: there rounding is weighed.
    sizes = largest_sizes(graph, [run[-1] for run in paths], images, ends) if paths else ()
    for run, size in zip(paths, sizes, strict=True):
        sources, copies = _pairs(graph, run[-1], size)
        if len(copies):
            graph = tuple(
                _copied(op, run, sources, copies) if isinstance(op, Conv) else op for op in graph
            )
            copies_by_tensor |= dict.fromkeys(run, copies)
    return graph, copies_by_tensor


def runs(graph: Graph, names: Collection[str]) -> list[list[str]]:
    """Of these, tensors one behind the other, depthwise convolutions between: from a dense one to
    dense ones.
    """
    readers = {
        name: [op for op in graph if isinstance(op, Conv) and op.input == name] for name in names
    }
    starts = [
        op.output
        for op in graph
        if isinstance(op, Conv) and op.output in readers and op.groups == 1
    ]
    paths = []
    for name in starts:
        run = [name]
        # A depthwise convolution hands a copy on only if nothing else reads the tensor.
        while [op.groups > 1 and op.output in readers for op in readers[run[-1]]] == [True]:
            run.append(readers[run[-1]][0].output)
        if all(op.groups == 1 for op in readers[run[-1]]):
            paths.append(run)
    return paths


def _pairs(graph: Graph, name: str, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The channels that are copied, those first whose rounding weighs most in what reads them, and
    where to.
    """
    weights = sum(
        np.square(op.weight, dtype=np.float64).sum((0, 2, 3))
        for op in graph
        if isinstance(op, Conv) and op.input == name
    )
    # A channel's step grows with its range, and its readers multiply the error by their weights.
    order = np.argsort(-np.square(sizes) * weights, kind="stable")
    dead = np.flatnonzero(sizes == 0)
    # A channel is copied once at most: its readers take half of each.
    count = min(len(dead), len(sizes) - len(dead))
    return order[:count], dead[:count]


def _copied(op: Conv, run: list[str], sources: np.ndarray, copies: np.ndarray) -> Conv:
    weight = op.weight.copy()
    bias = op.bias.copy()
    if op.output in run:
        weight[copies] = weight[sources]
        bias[copies] = bias[sources]
    if op.input == run[-1]:
        # Two halves of the same values sum to what the reader had, so the float network stays.
        weight[:, sources] /= 2
        weight[:, copies] = weight[:, sources]
    return replace(op, weight=weight, bias=bias)


def ranges_apart(ranges: np.ndarray, tensors: Mapping[str, slice], copies: Copies) -> np.ndarray:
    """Ranges (channels of all tensors,) with those of the copies apart from their channels'."""
    apart = ranges.copy()
    # At one scale a copy would be rounded like its channel, and the errors would not cancel.
    for name, channels in copies.items():
        apart[tensors[name]][channels] /= APART
    return apart
