"""Find what the host computes at the end of a float network, behind the core's result.

    core -> Sigmoid or Tanh -> + enlarged image -> Clip

1. Clips to constant limits, which come last.
2. The sum with the enlarged image, as networks for super-resolution add it to their detail. A sum
   in front of a pixel shuffle, with channels that repeat the image's, is one with the image whose
   pixels are repeated.
3. A Sigmoid or a Tanh behind that; or one to whose result the image itself is added.

A DPU would compute the first two in 8 bits, and not compute the third.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.quant.graph.enlargement import CUBIC, Enlargement, Mode
from beers_deploy.quant.graph.node_operations import READERS
from beers_deploy.quant.graph.operations import SIX, Shuffle
from beers_deploy.quant.graph.resize import Resizing
from beers_deploy.quant.input_range import is_range
from beers_deploy.quant.onnx.graph import Node, OnnxGraph

ACTIVATIONS = {"Sigmoid", "Tanh"}


@dataclass(frozen=True)
class HostEnd:
    """What the host computes at the end of a float network.

    Attributes:
        replaced: for the result of each node that the host computes, the tensor that takes its
            place in the core.
        limits: low and high end to which the network clips its result; empty if it does not.
        enlargement: how the image is enlarged that the network adds; None if it adds none, or the
            image itself.
        activation: "Sigmoid" or "Tanh"; empty if there is none.
        adds_in_core: True if a sum with the image that ends the core is not the last sum, so that
            the host does not compute it.
    """

    replaced: dict[str, str]
    limits: tuple[float, ...] = ()
    enlargement: Enlargement | None = None
    activation: str = ""
    adds_in_core: bool = False

    def in_core(self, name: str) -> str:
        """Return the name of the tensor that takes a tensor's place in the core."""
        while name in self.replaced:
            name = self.replaced[name]
        return name


def host_end(graph: OnnxGraph) -> HostEnd:
    """Find what the host computes at the end of a network of one image and one result.

    Args:
        graph: the float network, simplified.
    """
    (image, *_) = graph.inputs
    (result, *_) = graph.outputs
    replaced: dict[str, str] = {}
    # 1.
    limits: tuple[float, ...] = ()
    while ends := _limits(graph, result, limits):
        limits = ends
        replaced[result] = graph.writers[result].inputs[0]
        result = replaced[result]
    # 2.
    enlargement, nodes = _enlarged_sum(graph, result, image)
    replaced |= nodes
    result = replaced.get(result, result)
    # 3.
    last = graph.sole_writer(result)
    adds_image = last is not None and last.op_type == "Add" and image in last.inputs
    activation = last
    if adds_image and last is not None and enlargement is None:
        activation = graph.sole_writer(last.inputs[1 - last.inputs.index(image)])
    if (
        activation is None
        or activation.op_type not in ACTIVATIONS
        or activation.inputs[0] in graph.inputs
    ):
        return HostEnd(replaced, limits, enlargement, "", enlargement is not None)
    replaced[activation.outputs[0]] = activation.inputs[0]
    is_last = enlargement is not None or not adds_image
    return HostEnd(replaced, limits, enlargement, activation.op_type, is_last)


def _limits(graph: OnnxGraph, result: str, limits: tuple[float, ...]) -> tuple[float, ...]:
    """Return the limits of the Clip that writes a tensor, within those of the one behind it; empty
    for another node.

    ReLU6 is left to the DPU.
    """
    node = graph.sole_writer(result)
    if node is None or node.op_type != "Clip":
        return ()
    ends = [graph.value(node, place) for place in (1, 2)]
    if any(end is None or end.size != 1 for end in ends):
        return ()
    low, high = (float(end.item()) for end in ends if end is not None)
    if limits:
        low = max(low, limits[0])
        high = min(high, limits[1])
    return (low, high) if is_range(low, high) and (low, high) != (0, SIX) else ()


def _enlarged_sum(
    graph: OnnxGraph, result: str, image: str
) -> tuple[Enlargement | None, dict[str, str]]:
    """Find the sum with the enlarged image that a tensor is (point 2).

    Args:
        graph: the float network.
        result: the name of the tensor.
        image: the name of the image.

    Returns:
        The enlargement, and the tensors that take the place of the sum and of the enlarged image;
        None and nothing if the tensor is no such sum.
    """
    total = graph.sole_writer(result)
    shuffle = None
    if total is not None and total.op_type == "DepthToSpace":
        shuffle = total
        total = graph.sole_writer(shuffle.inputs[0])
    if total is None or total.op_type != "Add":
        return None, {}
    for other, name in zip(total.inputs, total.inputs[::-1], strict=True):
        node = graph.sole_writer(name)
        if node is None or node.inputs[0] != image:
            continue
        enlargement = _resized(graph, node) if shuffle is None else _repeated(graph, node, shuffle)
        if enlargement is not None:
            return enlargement, {total.outputs[0]: other, name: image}
    return None, {}


def _resized(graph: OnnxGraph, node: Node) -> Enlargement | None:
    """Return what a Resize of an image does, if the host computes it to the bit at every place."""
    if node.op_type not in ("Resize", "Upsample"):
        return None
    resizing = Resizing.of(node, graph)
    if resizing.factors[:2] != (1, 1) or resizing.factors[2] != resizing.factors[3]:
        return None
    factor = int(resizing.factors[2])
    if factor != resizing.factors[2] or factor < 2:
        return None
    if resizing.mode == "nearest":
        return Enlargement(factor) if resizing.makes_blocks(factor) else None
    # Sums of weights that are multiples of a power of two are rounded alike at every place.
    is_exact = factor & (factor - 1) == 0
    is_plain = node.attributes.get("cubic_coeff_a", CUBIC) == CUBIC
    is_plain = is_plain and not node.attributes.get("exclude_outside", 0)
    if resizing.where not in ("half_pixel", "pytorch_half_pixel") or not (is_exact and is_plain):
        return None
    modes: dict[str, Mode] = {"linear": "linear", "cubic": "cubic"}
    return Enlargement(factor, modes[resizing.mode])


def _repeated(graph: OnnxGraph, node: Node, shuffle: Node) -> Enlargement | None:
    """Return the enlargement if a convolution copies an image's channels so that a pixel shuffle of
    the copies repeats the image's pixels.
    """
    weight = graph.value(node, 1)
    bias = graph.value(node, 2)
    if node.op_type != "Conv" or weight is None or weight.shape[2:] != (1, 1):
        return None
    operation = READERS["DepthToSpace"](shuffle, graph)
    assert isinstance(operation, Shuffle)  # noqa: S101 - that is what it reads
    channels = weight.shape[1]
    if len(weight) != channels * operation.block**2 or (bias is not None and bias.any()):
        return None
    # One image for each channel, with a single pixel in that channel.
    images = np.eye(channels, dtype=np.float32)[:, :, None, None]
    copies = operation(np.einsum("oiyx,nihw->nohw", weight, images))
    enlargement = Enlargement(operation.block)
    return enlargement if np.array_equal(copies, enlargement(images)) else None
