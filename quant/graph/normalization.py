"""Replace a normalisation by statistics of its own map, because a DPU computes no root.

NAFNet normalises each pixel over its channels, HINet each channel over the image.

    y = scale (x - m) / sqrt(v + epsilon) + shift, v = mean((x - m)^2)

1. The differences d = x - m from the mean of the channels are a convolution of one pixel. From the
   mean of the image they are the map less its enlarged mean.
2. The inverse of the deviation is computed from the means of absolute differences by two
   convolutions of one pixel, whose weights `quant.adapt.inverse_deviation` fits to samples.
3. The product of both is scaled and shifted.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.quant.graph.deviation import Deviation, above_mean, less_mean, scaled
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.simplify.fold_affine import affine_chain


@dataclass(frozen=True)
class InverseDeviation:
    """The numbers of the two convolutions that compute the inverse of the deviation of d / unit.

        r = weight ReLU(inner_bias - inner_weight a) + bias

    The features a are ReLU(d / unit) and ReLU(-d / unit) of each pixel. Over the image they are the
    means of ReLU(d / unit), which are also those of ReLU(-d / unit).

    Attributes:
        unit: (C,) a typical deviation of each channel, so that all channels have equal ranges.
        inner_weight: (M, F) for F features.
        inner_bias: (M,).
        weight: (C, M).
        bias: (C,).
    """

    unit: np.ndarray
    inner_weight: np.ndarray
    inner_bias: np.ndarray
    weight: np.ndarray
    bias: np.ndarray

    @classmethod
    def unknown(cls, channels: int, features: int) -> "InverseDeviation":
        """Return numbers of the right shapes, for networks that are only read."""
        ones = np.ones((channels, features))
        return cls(ones[:, 0], ones, ones[:, 0], ones[:, :channels], ones[:, 0])


@dataclass(frozen=True)
class Normalization:
    """A normalisation of each pixel by its mean and deviation over the channels, or of each channel
    over a square image.

    Attributes:
        last: the node that ends it.
        source: the name of the map x.
        is_of_pixels: True if each pixel has statistics of its own.
        side_px: the sides of x; 0 if they are not known.
        channels: of x.
        scale: (C,) or (1,) the factor behind the quotient.
        shift: (C,) or (1,) the number that is added to it.
        epsilon: the number that is added to the variance.
        is_centred: False if x itself is divided by the deviation, with its mean.
    """

    last: Node
    source: str
    is_of_pixels: bool
    side_px: int
    channels: int
    scale: np.ndarray
    shift: np.ndarray
    epsilon: float
    is_centred: bool = True

    @classmethod
    def of(cls, graph: OnnxGraph, node: Node) -> "Normalization | None":
        """Return the normalisation that a node ends; None if it is something else.

        Args:
            graph: the graph that the node belongs to, which knows the sizes of its tensors.
            node: any node.
        """
        if node.op_type == "Div":
            return cls._of_quotient(graph, node)
        scale = graph.value(node, 1)
        shift = graph.value(node, 2)
        size = graph.shapes.get(node.source, ())
        # A group normalisation has one of a map of three dimensions.
        is_square = len(size) == 4 and size[2] == size[3]
        is_of_kind = node.op_type == "InstanceNormalization" and is_square
        if not is_of_kind or scale is None or shift is None:
            return None
        epsilon = float(node.attribute("epsilon", 1e-5))
        return cls(node, node.source, False, size[2], len(scale), scale, shift, epsilon)

    @classmethod
    def _of_quotient(cls, graph: OnnxGraph, node: Node) -> "Normalization | None":
        """Return the normalisation that is spelled out with a Div at its end."""
        root_name, of_root = scaled(graph, node.inputs[1], is_sole=False)
        deviation = Deviation.of(graph, graph.writer(root_name))
        numerator, affine = affine_chain(graph, node.source)
        if deviation is None or affine.shift.any():
            return None
        source = deviation.source
        centred = less_mean(graph, numerator)
        is_centred = centred is not None and centred.source == source
        channels = graph.channels(source)
        if not channels or not (is_centred or numerator == source):
            return None
        scale = affine.scale / of_root.scale / np.sqrt(deviation.scale)
        # Some add their epsilon to the root. Its square has a similar effect on the variance.
        of_variance = deviation.epsilon + float((of_root.shift / of_root.scale).max()) ** 2
        epsilon = of_variance / float(deviation.scale.max())
        return cls(
            node,
            source,
            deviation.is_of_pixels,
            deviation.side_px,
            channels,
            scale,
            np.zeros(1),
            epsilon,
            is_centred,
        )

    def nodes(self, graph: OnnxGraph, inverse: InverseDeviation | None = None) -> list[Node]:
        """Return the nodes that compute nearly the same.

        Args:
            graph: the graph, whose constants are extended.
            inverse: the numbers of the inverse deviation; None if the nodes are only read.
        """
        if inverse is None:
            n_features = self.channels * (2 if self.is_of_pixels else 1)
            inverse = InverseDeviation.unknown(self.channels, n_features)
        result = self.last.result
        names = [f"{result}.{part}" for part in ("above", "inner", "rectified", "inverse")]
        features, inner, rectified, factor = names
        in_units = self.source
        nodes = []
        if (inverse.unit != 1).any():
            in_units = f"{result}.scaled"
            factors = 1 / inverse.unit.reshape(1, -1, 1, 1)
            constant = graph.add_constant(f"{in_units}.factors", factors)
            nodes.append(Node.new("Mul", [self.source, constant], in_units))
        # 1.
        if self.is_of_pixels:
            nodes += self._of_pixels(graph, features)
        else:
            nodes += self._of_image(graph, in_units)
        # 2.
        weight = (inverse.weight * self.scale.reshape(-1, 1))[:, :, None, None]
        inner_weight = -inverse.inner_weight[:, :, None, None]
        nodes += [
            graph.convolution(features, inner, inner, inner_weight, inverse.inner_bias),
            Node.new("Relu", [inner], rectified),
            graph.convolution(rectified, factor, factor, weight, inverse.bias * self.scale),
        ]
        # 3.
        numerator = f"{result}.difference" if self.is_centred else in_units
        if not self.shift.any():
            return [*nodes, self.last.replaced_by("Mul", [numerator, factor])]
        product = f"{result}.product"
        shift = graph.add_constant(f"{result}.shift", self.shift.reshape(1, -1, 1, 1))
        nodes.append(Node.new("Mul", [numerator, factor], product))
        return [*nodes, self.last.replaced_by("Add", [product, shift])]

    def _of_pixels(self, graph: OnnxGraph, features: str) -> list[Node]:
        """Return the nodes of the differences from the mean of the channels, and of the features of
        each pixel.

        Args:
            graph: the graph, whose constants are extended.
            features: the name of the features.
        """
        difference = f"{self.last.result}.difference"
        absolute = f"{self.last.result}.absolute"
        centring = (np.eye(self.channels) - 1 / self.channels)[:, :, None, None]
        both = np.concatenate([centring, -centring])
        return [
            graph.convolution(self.source, difference, difference, centring),
            graph.convolution(self.source, absolute, absolute, both),
            Node.new("Relu", [absolute], features),
        ]

    def _of_image(self, graph: OnnxGraph, in_units: str) -> list[Node]:
        """Return the nodes of the differences from the mean of the image, and of the features of
        the image.

        Args:
            graph: the graph, whose constants are extended.
            in_units: the name of the map in units of each channel.
        """
        result = self.last.result
        mean = f"{result}.mean"
        negative = f"{result}.negative"
        minus_one = graph.add_constant(f"{negative}.factor", -1)
        return [
            Node.new("GlobalAveragePool", [in_units], mean),
            Node.new("Mul", [mean, minus_one], negative),
            *above_mean(graph, in_units, negative, self.side_px, result),
        ]


def lone_deviation(graph: OnnxGraph, node: Node) -> Deviation | None:
    """Return the standard deviation over the image that a node ends, unless a normalisation divides
    by it; None if it is something else.

    Args:
        graph: the graph that the node belongs to, which knows the sizes of its tensors.
        node: any node.
    """
    deviation = Deviation.of(graph, node)
    if deviation is None or deviation.is_of_pixels:
        return None
    roots = {
        scaled(graph, each.inputs[1], is_sole=False)[0]
        for each in graph.nodes
        if each.op_type == "Div" and Normalization.of(graph, each)
    }
    return None if node.result in roots else deviation
