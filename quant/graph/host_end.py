"""Find what the host computes at the end of a float network, behind the core's result.

    core -> Sigmoid or Tanh -> + base -> Clip -> crop

1. A crop by as many pixels as the image was mirrored beyond its borders, and clips to constant
   limits.
2. The sum with a base: some channels of the image, or the enlarged image. A sum in front of a pixel
   shuffle, with channels that repeat the image's, is one with the image whose pixels are repeated.
3. A Sigmoid or a Tanh behind that; or one to whose result the image itself is added.

A DPU would compute the first two in 8 bits, and not compute the third.
"""

from dataclasses import dataclass, replace

import numpy as np

from beers_deploy.quant.graph.base import THE_IMAGE, Base, Mode
from beers_deploy.quant.graph.node_operations import READERS
from beers_deploy.quant.graph.operations import SIX, Shuffle
from beers_deploy.quant.input_range import is_range
from beers_deploy.quant.onnx.graph import NO_NODE, Node, OnnxGraph
from beers_deploy.quant.onnx.resize import Resizing
from beers_deploy.quant.simplify.slices import slices_of

ACTIVATIONS = {"Sigmoid", "Tanh"}


@dataclass(frozen=True)
class HostEnd:
    """The operations at the end of a float network that the host computes.

    Attributes:
        replaced: for the result of each node that the host computes, the tensor that takes its
            place in the core.
        crop_px: the number of pixels of the result that are cut off at each side.
        limits: low and high end to which the network clips its result; empty if it does not.
        base: the enlarged image that the result is added to; None if it is added to the image
            itself, or to nothing.
        activation: "Sigmoid" or "Tanh"; empty if there is none.
        adds_in_core: True if a sum with the image that ends the core is not the last sum, so that
            the host does not compute it.
    """

    replaced: dict[str, str]
    crop_px: int
    limits: tuple[float, ...]
    base: Base | None
    activation: str
    adds_in_core: bool

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
    last = graph.sole_writer(result)
    cuts = slices_of(graph, last) if last.op_type == "Slice" else {}
    crop_px = cuts[2].start if 2 in cuts else 0
    both_sides = slice(crop_px, -crop_px, 1)
    if cuts != {2: both_sides, 3: both_sides}:
        crop_px = 0
    if crop_px:
        replaced[result] = graph.writer(result).source
        result = replaced[result]
    limits: tuple[float, ...] = ()
    while ends := _limits(graph, result, limits):
        limits = ends
        replaced[result] = graph.writer(result).source
        result = replaced[result]
    # 2.
    base, nodes = _sum_with_base(graph, result, image)
    replaced |= nodes
    result = replaced.get(result, result)
    # 3.
    activation = graph.sole_writer(result)
    adds_image = activation.op_type == "Add" and image in activation.inputs
    if adds_image and base is None:
        activation = graph.sole_writer(activation.inputs[1 - activation.inputs.index(image)])
    if activation.op_type not in ACTIVATIONS or activation.source in graph.inputs:
        return HostEnd(replaced, crop_px, limits, base, "", base is not None)
    replaced[activation.result] = activation.source
    is_last = base is not None or not adds_image
    return HostEnd(replaced, crop_px, limits, base, activation.op_type, is_last)


def _limits(graph: OnnxGraph, result: str, limits: tuple[float, ...]) -> tuple[float, ...]:
    """Return the limits of the Clip that writes a tensor, within those of the one behind it; empty
    for another node.

    ReLU6 is left to the DPU.
    """
    node = graph.sole_writer(result)
    if node.op_type != "Clip":
        return ()
    ends = [graph.value(node, place) for place in (1, 2)]
    numbers = [float(end.item()) for end in ends if end is not None and end.size == 1]
    if len(numbers) < 2:
        return ()
    least, most = limits or (-np.inf, np.inf)
    low = max(numbers[0], least)
    high = min(numbers[1], most)
    return (low, high) if is_range(low, high) and (low, high) != (0, SIX) else ()


def _sum_with_base(graph: OnnxGraph, result: str, image: str) -> tuple[Base | None, dict[str, str]]:
    """Find the sum with a base, other than the image itself, that a tensor is (point 2).

    Args:
        graph: the float network.
        result: the name of the tensor.
        image: the name of the image.

    Returns:
        The base, and the tensors that take the place of the sum and of the base; None and nothing
        if the tensor is no such sum.
    """
    total = graph.sole_writer(result)
    shuffle = None
    if total.op_type == "DepthToSpace":
        shuffle = total
        total = graph.sole_writer(shuffle.source)
    for other, name in total.orders if total.op_type == "Add" else ():
        base = _repeated(graph, name, shuffle) if shuffle else _base(graph, name, image)
        if base is not None:
            replaced = {total.result: other}
            # The core may read it too.
            if graph.sole_writer(name) is not NO_NODE:
                replaced[name] = image
            return base, replaced
    return None, {}


def _base(graph: OnnxGraph, name: str, image: str) -> Base | None:
    """Return the base that a tensor is: channels of the image, or these enlarged in a way that the
    host computes alike at every place.
    """
    node = graph.writer(name)
    if node.op_type not in ("Resize", "Upsample"):
        return _channels(graph, name)
    source = THE_IMAGE if node.source == image else _channels(graph, node.source)
    resizing = Resizing.of(graph, node)
    if source is None or resizing.factors[:2] != (1, 1):
        return None
    factor = int(resizing.factors[2])
    if resizing.factors[2:] != (factor, factor) or factor < 2:
        return None
    if resizing.mode == "nearest":
        return replace(source, factor=factor) if resizing.makes_blocks(factor) else None
    # Sums of weights that are multiples of a power of two are rounded alike at every place.
    is_exact = factor & (factor - 1) == 0
    if not (resizing.is_half_pixel and is_exact and resizing.is_plain):
        return None
    modes: dict[str, Mode] = {"linear": "linear", "cubic": "cubic"}
    return replace(source, factor=factor, mode=modes[resizing.mode])


def _channels(graph: OnnxGraph, name: str) -> Base | None:
    """Return the base if a tensor has channels of the image, which a convolution selects."""
    weight = _copies(graph, name)
    if weight is None:
        return None
    numbers = weight.argmax(1)
    is_selection = np.array_equal(weight, np.eye(weight.shape[1])[numbers])
    return Base(tuple(numbers.tolist())) if is_selection else None


def _repeated(graph: OnnxGraph, name: str, shuffle: Node) -> Base | None:
    """Return the base if a tensor has the image's channels so that a pixel shuffle repeats the
    image's pixels.
    """
    weight = _copies(graph, name)
    operation = READERS["DepthToSpace"](graph, shuffle)
    assert isinstance(operation, Shuffle)  # noqa: S101 - that is what it reads
    if weight is None or len(weight) != weight.shape[1] * operation.block**2:
        return None
    # One image for each channel, with a single pixel in that channel.
    images = np.eye(weight.shape[1], dtype=np.float32)
    copies = operation((images @ weight.T)[:, :, None, None])
    base = Base(factor=operation.block)
    return base if np.array_equal(copies, base(images[:, :, None, None])) else None


def _copies(graph: OnnxGraph, name: str) -> np.ndarray | None:
    """Return the weights (O, C) if a tensor is a convolution of one pixel of the image, without
    bias; None for any other tensor.
    """
    node = graph.writer(name)
    is_of_image = node.op_type == "Conv" and node.source in graph.inputs
    weight = graph.value(node, 1) if is_of_image else None
    is_plain = len(node.inputs) == 2 and node.groups == 1
    if weight is None or weight.shape[2:] != (1, 1) or not is_plain:
        return None
    return weight[:, :, 0, 0]
