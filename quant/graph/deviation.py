"""Recognise standard deviations, of each channel over the image or of each pixel over its channels.

A DPU computes no root. The deviation over the image, which IMDN's attention (CCA) has, is replaced
by the mean absolute deviation:

    sqrt(mean((x - m)^2)) is about RATIO mean(|x - m|) = 2 RATIO mean(ReLU(x - m))

1. The mean m of each channel is enlarged to the size of the map x, from which it is subtracted.
2. Differences above and below the mean have the same sum, so that those above it are enough.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import Affine, affine_chain
from beers_deploy.quant.simplify.spelled_activations import squared
from beers_deploy.quant.simplify.standard_operators import reduced_axes

OVER_CHANNELS = {1}
OVER_IMAGE = {2, 3}
RATIO = (np.pi / 2) ** 0.5
"""The standard deviation over the mean absolute deviation, of normally distributed values."""


@dataclass(frozen=True)
class Deviation:
    """A standard deviation over a square image, or over the channels of each pixel.

    Attributes:
        root: the node that computes it from the variance.
        source: the name of the map x.
        negative: the name of the mean of x, times -1.
        is_of_pixels: True for a deviation over the channels.
        side_px: the sides of x; 0 if they are not known.
        scale: (C,) or (1,) the factor of the variance.
        epsilon: the number that is added to the variance.
    """

    root: Node
    source: str
    negative: str
    is_of_pixels: bool
    side_px: int
    scale: np.ndarray
    epsilon: float

    @classmethod
    def of(cls, graph: OnnxGraph, node: Node) -> "Deviation | None":
        """Return the standard deviation that a node ends; None if it is something else.

        Args:
            graph: the graph that the node belongs to, which knows the sizes of its tensors.
            node: any node; only a root can end one.
        """
        name, affine = scaled(graph, node.source if node.op_type == "Sqrt" else "")
        variance = graph.writer(name)
        axes = _axes_of_mean(graph, variance)
        match = less_mean(graph, squared(graph, variance.source))
        if match is None or match.axes != axes:
            return None
        *_, rows, columns = graph.shapes.get(match.source, (0, 0))
        is_of_pixels = axes == OVER_CHANNELS
        if rows != columns and not is_of_pixels:
            return None
        return cls(
            root=node,
            source=match.source,
            negative=match.negative,
            is_of_pixels=is_of_pixels,
            side_px=rows,
            scale=affine.scale,
            epsilon=float(affine.shift.max()),
        )

    def nodes(self, graph: OnnxGraph) -> list[Node]:
        """Return the nodes that compute the mean absolute deviation in place of the root.

        Args:
            graph: the graph whose constants are extended.
        """
        result = self.root.result
        pooled = f"{result}.above"
        factor = 2 * RATIO * np.sqrt(self.scale).reshape(1, -1, 1, 1)
        return [
            *above_mean(graph, self.source, self.negative, self.side_px, result),
            self.root.replaced_by("Mul", [pooled, graph.add_constant(f"{pooled}.factor", factor)]),
        ]


def above_mean(
    graph: OnnxGraph, source: str, negative: str, side_px: int, result: str
) -> list[Node]:
    """Return the nodes of `result`.difference, a map less its mean over the image, and of
    `result`.above, the mean of the positive part of that.

    Args:
        graph: the graph, whose constants are extended.
        source: the name of the map.
        negative: the name of its mean, times -1.
        side_px: the sides of the map; 0 if they are not known.
        result: the name that the new names begin with.
    """
    wide, difference, positive = (f"{result}.{part}" for part in ("wide", "difference", "positive"))
    side_px = side_px or 1  # A network of free size is refused later, by its pooling.
    scales = graph.add_constant(f"{wide}.scales", [1, 1, side_px, side_px])
    modes = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    return [
        Node.new("Resize", [negative, "", scales], wide, **modes),
        Node.new("Add", [source, wide], difference),
        Node.new("Relu", [difference], positive),
        Node.new("GlobalAveragePool", [positive], f"{result}.above"),
    ]


@dataclass(frozen=True)
class LessMean:
    """A map less its mean.

    Attributes:
        source: the name of the map.
        negative: the name of its mean, times -1.
        axes: OVER_IMAGE or OVER_CHANNELS.
    """

    source: str
    negative: str
    axes: set[int]


def less_mean(graph: OnnxGraph, name: str) -> LessMean | None:
    """Return the parts of a tensor that is a map less its mean; None for any other tensor.

    Args:
        graph: the graph of the tensor.
        name: the name of the tensor.
    """
    difference = graph.writer(name)
    for source, negative in difference.orders if difference.op_type == "Add" else ():
        mean_name, affine = scaled(graph, negative, is_sole=False)
        mean = graph.writer(mean_name)
        axes = _axes_of_mean(graph, mean)
        is_negative = (affine.scale == -1).all() and not affine.shift.any()
        if axes and is_negative and mean.source == source:
            return LessMean(source, negative, axes)
    return None


def _axes_of_mean(graph: OnnxGraph, node: Node) -> set[int]:
    """Return the axes that a node takes the mean over, if it keeps them: OVER_IMAGE or
    OVER_CHANNELS; none for anything else.
    """
    if node.op_type == "GlobalAveragePool":
        return OVER_IMAGE
    is_kept = node.op_type == "ReduceMean" and node.attribute("keepdims", 1)
    axes = reduced_axes(graph, node) if is_kept else set()
    return axes if axes == OVER_CHANNELS else set()


def scaled(graph: OnnxGraph, name: str, is_sole: bool = True) -> tuple[str, Affine]:
    """Follow scalings and shifts by constants upwards from a tensor, as `affine_chain` does.

    Args:
        graph: the graph.
        name: the name of the tensor to start from.
        is_sole: True to follow only tensors that nothing else reads.
    """
    name, affine = affine_chain(graph, name, is_sole)
    node = graph.writer(name)
    weight = graph.value(node, 1)
    # A convolution of one pixel that scales each channel, or repeats one.
    if node.op_type != "Conv" or weight is None or weight.shape[1:] != (1, 1, 1):
        return name, affine
    bias = graph.value(node, 2)
    shift = affine.shift if bias is None else affine.scale * bias + affine.shift
    return node.source, Affine(affine.scale * weight.ravel(), shift)
