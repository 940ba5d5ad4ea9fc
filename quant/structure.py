"""Check an INT8 file by itself: results at the ends of 8 bits, lost ReLUs, and faults of its
encoding.

Saturation: every tensor that a node rounds to 8 bits is checked, in any encoding (integer kernels
or QDQ), as the graph is written. Values beyond the ends are clipped, and lost. Two ends are no
loss. One is the lower end if it represents zero or if a ReLU reads it, because that is the ReLU.
The others are the ends of the fine copy, which the coarse copy replaces
(`quant.passes.dual_range`). ReLUs are counted because quantisers have been seen to drop them
silently.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from onnx import ModelProto, helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.figures import Check
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.quant.adapt.kinds import Kind, nodes_by_kind
from beers_deploy.quant.bounds import within_int8
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import encoding_faults, read_core
from beers_deploy.quant.float_parts import float_layers_check
from beers_deploy.quant.graph import CORRECTION, Activation, Pointwise
from beers_deploy.quant.graph.quantized import Scale, stated
from beers_deploy.quant.host_part import ONE_CHANNEL, ZERO
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.image_input import any_size
from beers_deploy.quant.session import (
    open_any_size,
    open_session,
    result_of,
    tensors_of,
    with_outputs,
)
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.quant.untrusted import contradictions

RELUS = ("Relu", "Max")
HARD = (Activation.hard_sigmoid, Activation.hard_swish)
BYTES = ("int8", "uint8")
ENCODING = "faults of the encoding"
"""The name of the check of an INT8 file that describes its integers."""
TABLE = 256
"""The number of 8-bit values, each of which an activation table maps."""


@dataclass(frozen=True)
class Rounded:
    """A tensor that a node of an INT8 file rounds to 8 bits.

    Attributes:
        name: the name of the tensor.
        scale: the scale, zero point and integer type of the tensor.
        low_is_relu: True if a ReLU reads the tensor, so that values clipped at the lower end would
            have become zero anyway.
        counted: the channels that are checked for clipping. If the network's result has several
            copies, these are the channels of the coarse copy, which holds the values that the fine
            copies clip.
    """

    name: str
    scale: Scale
    low_is_relu: bool
    counted: slice

    @property
    def lowest(self) -> int:
        """The smallest integer of the tensor's 8-bit type: -128 or 0."""
        return int(np.iinfo(self.scale.integer_type).min)

    def may_be_clipped(self, values: np.ndarray) -> np.ndarray:
        """Return a mask of the values that may have been clipped.

        These equal the largest or smallest integer of the type. The smallest integer is not counted
        where it stands for zero or where a ReLU reads it, because clipping loses nothing there.

        Args:
            values: the tensor's integers, (N, C, H, W) or flat.

        Returns:
            A bool array of the values in the channels `counted`; of all values if `values` is flat.
        """
        channels = values[:, self.counted] if values.ndim > 1 else values
        high = channels == self.lowest + 255
        # At the lower end nothing is lost if it stands for zero, or if a ReLU reads it.
        low_counts = not self.low_is_relu and self.lowest not in self.scale.zero_points
        low = (channels == self.lowest) & low_counts
        return np.asarray(high | low)


def saturated_shares(model: ModelProto, images: Iterable[np.ndarray]) -> dict[str, float]:
    """Return for each 8-bit tensor the share of values that may have been clipped, over all images.

    These are the values at the largest or smallest integer, as `Rounded.may_be_clipped` counts
    them. Tensors are left out that provably never exceed 8 bits, such as a copy of the image.

    Args:
        model: an INT8 network in any encoding.
        images: images as the network reads them, (N, C, H, W) float32.

    Returns:
        A dict from the tensor's name to a share in [0, 1]; empty if no node rounds to 8 bits.

    Raises:
        ModelError: the nodes of the graph contradict their definition in ONNX, or the network does
            not run on an image.
    """
    core = _own_core(model)
    within = within_int8(core) if core else set()
    tensors = [tensor for tensor in rounded_tensors(model) if tensor.name not in within]
    if not tensors:
        return {}
    kinds = {
        t.name: helper.np_dtype_to_tensor_dtype(np.dtype(t.scale.integer_type)) for t in tensors
    }
    session = open_session(with_outputs(any_size(model), kinds), optimise=False)
    ends = np.zeros(len(tensors))
    counts = np.zeros(len(tensors))
    for image in images:
        results = tensors_of(session, [tensor.name for tensor in tensors], image)
        flags = [
            tensor.may_be_clipped(values) for tensor, values in zip(tensors, results, strict=True)
        ]
        ends += [flag.sum() for flag in flags]
        counts += [flag.size for flag in flags]
    shares = ends / np.maximum(counts, 1)
    return {tensor.name: float(share) for tensor, share in zip(tensors, shares, strict=True)}


def rounded_tensors(model: ModelProto) -> list[Rounded]:
    """List the tensors that the nodes of an INT8 file round to 8 bits, in the order of the nodes.

    Constants, such as quantised weights, are left out.

    Args:
        model: a network in any encoding.

    Raises:
        ModelError: the nodes of the graph contradict their definition in ONNX.
    """
    with contradictions("the INT8 network"):
        return _rounded(OnnxGraph(model), _own_core(model))


def _own_core(model: ModelProto) -> IntCore | None:
    """Return the integer core that a file describes; None if it describes none."""
    try:
        return read_core(model)
    except ModelError:
        # Files of other quantisers do not describe their integers.
        return None


def _rounded(graph: OnnxGraph, core: IntCore | None) -> list[Rounded]:
    """Return the tensors that nodes round to 8 bits, without constants.

    Args:
        graph: the graph of the INT8 network.
        core: its integer core, which knows copies of the result; None if the file describes none.
    """
    host_part = core.host_part if core else ONE_CHANNEL
    counted = host_part.decoding.never_replaced(host_part.outputs)
    read_as = {
        node.result: node.source for node in graph.nodes if node.op_type == "DequantizeLinear"
    }
    relus = set(chain.from_iterable(n.inputs for n in graph.nodes if n.op_type in RELUS))
    # In a QDQ file the ReLU reads the tensor as float, behind its DequantizeLinear.
    relus |= {read_as[name] for name in relus & set(read_as)}
    tensors = []
    for node in graph.nodes:
        name = node.result
        scale = dict(stated(graph, node)).get(name)
        if scale is not None and scale.integer_type in BYTES and node.source not in graph.constants:
            tensors.append(
                Rounded(name, scale, name in relus, counted if name == CORRECTION else slice(None))
            )
    return tensors


@dataclass(frozen=True)
class Relus:
    """The number of ReLUs in a file, which shows whether a quantiser dropped one.

    Attributes:
        explicit: the number of nodes that are a ReLU: Relu, or the larger of a value and zero.
        folded: the number of convolutions that may contain a ReLU. The integers of their results
            begin at zero, which is a ReLU unless the results were never below zero. Convolutions
            whose saturation is their ReLU, according to the description in the file, count as well.
    """

    explicit: int
    folded: int

    def off_by(self, expected: int) -> int:
        """Return the smallest number of ReLUs that must have been lost or added in this file.

        A convolution whose 8 bits begin at zero (`folded`) may or may not be a ReLU. The case with
        the smaller difference is assumed.

        Args:
            expected: the number of ReLUs that the file should have.
        """
        return max(expected - self.explicit - self.folded, self.explicit - expected, 0)

    def __str__(self) -> str:
        return (
            f"{self.explicit}, and up to {self.folded} as 8 bits from zero"
            if self.folded
            else str(self.explicit)
        )


def count_relus(model: ModelProto) -> Relus:
    """Count the ReLUs of a network, so that a file that lost one can be detected.

    In an INT8 file a convolution whose 8 bits begin at zero may be a ReLU. These are counted
    separately, in `Relus.folded`.

    Args:
        model: a float or an INT8 network.

    Raises:
        ModelError: the nodes of the graph contradict their definition in ONNX.
    """
    with contradictions("the network"):
        graph = OnnxGraph(model)
        core = _own_core(model)
        tensors = {tensor.name: tensor for tensor in _rounded(graph, core)}
        # On a coarse scale the table of HardSwish or HardSigmoid is that of a ReLU.
        alike = {
            op.output
            for op in (core.ops if core else ())
            if isinstance(op, Pointwise) and op.activation in HARD
        }
        nodes = [node for node in graph.nodes if alike.isdisjoint(node.outputs)]
        convolved = {node.result for node in graph.nodes if "Conv" in node.op_type}
        explicit = sum(_is_relu(graph, node, tensors) for node in nodes)
        results = {
            node.result
            for node in graph.nodes
            if node.op_type == "QLinearConv" or node.source in convolved
        }
        # All numbers of a convolution's result are at least zero.
        folded = sum(
            set(tensor.scale.zero_points) == {tensor.lowest}
            for name, tensor in tensors.items()
            if name in results
        )
        return Relus(explicit, folded)


def _is_relu(graph: OnnxGraph, node: Node, tensors: dict[str, Rounded]) -> bool:
    """Return True if a node is a ReLU, a ReLU6, a maximum with zero or a table of a ReLU.

    Args:
        graph: the graph that the node belongs to.
        node: any node.
        tensors: the tensors of 8 bits by name, whose zero is their zero point.
    """
    constants = [graph.constants[name] for name in node.inputs if name in graph.constants]
    if node.op_type == "Clip":
        return [float(limit) for limit in constants if limit.size == 1] == [0.0, 6.0]
    if node.op_type == "Max" and constants:
        # A tensor of 8 bits has its zero at the zero point, a float one at 0 itself.
        zeros = [tensors[name].scale.zero_points for name in node.inputs if name in tensors]
        zeros = zeros or [(0,)]
        return bool((constants[0] == np.array(zeros[0])).all())
    table = graph.value(node, 0) if node.op_type == "Gather" else None
    if table is None or table.shape != (TABLE,) or table.dtype != np.uint8:
        return node.op_type == "Relu"
    # Our files store a ReLU that follows no convolution as a table of uint8, around ZERO. It maps
    # values below zero to zero, and others to values that do not decrease.
    values = table.astype(np.int16) - ZERO
    return bool(
        (values[:ZERO] == 0).all() and (np.diff(values[ZERO:]) >= 0).all() and values[-1] > 0
    )


def structure_checks(
    float_model: ModelProto, int8: ModelProto, must_describe: bool = False
) -> list[Check]:
    """Check that an INT8 file has the ReLUs of its float network, is encoded correctly, and does
    not depend on onnxruntime's optimisations.

    Args:
        float_model: the float network that the INT8 file was made from.
        int8: the INT8 network.
        must_describe: if True, a file whose metadata do not describe its integer core fails.
            Otherwise the encoding of such a file is not checked, because files of other quantisers
            have no description.

    Returns:
        The checks, each with its value and limit: lost or added ReLUs, faults of the encoding if it
        is described, layers that are computed in float, and the difference of the results with and
        without optimisations of onnxruntime.
    """
    # An image that the network accepts: free sides are 97 and 101 pixels, rounded up to multiples
    # of the network's lattice.
    sizes = [side.dim_value for side in int8.graph.input[0].type.tensor_type.shape.dim]
    alignment_px = 1 if sizes[2] else tiling_of(int8).alignment_px
    rows, columns = (
        fixed or up_to_multiple(n, alignment_px)
        for fixed, n in zip(sizes[2:], (97, 101), strict=True)
    )
    image = np.random.default_rng(0).random((1, sizes[1] or 1, rows, columns), dtype=np.float32)
    # On a processor without VNNI the unoptimised graph was up to 126 DN off, because onnxruntime's
    # exact setting is one of its optimisations.
    plain, optimised = (result_of(open_any_size(int8, optimise=o), image) for o in (False, True))
    difference = float(np.abs(plain - optimised).max())
    optimisation = Check("optimised against unoptimised", difference, 0, "of full scale")
    float_relus = count_relus(float_model).explicit
    int8_relus = count_relus(int8)
    if (core := _own_core(int8)) is not None:
        # `quant.adapt` computes LeakyReLUs and PReLUs by a ReLU in a second branch, a Tanh by a
        # ReLU6, a standard deviation by a ReLU, and a normalisation by two. They are those of the
        # float network less the LeakyReLUs of the integers.
        kinds = Counter(node.op_type for node in float_model.graph.node)
        replaced = nodes_by_kind(OnnxGraph(float_model))
        float_relus += kinds["LeakyRelu"] + kinds["PRelu"]
        for kind, count in {Kind.tanh: 1, Kind.deviation: 1, Kind.normalization: 2}.items():
            float_relus += count * len(replaced.get(kind, ()))
        float_relus -= sum(
            isinstance(op, IntConv | Pointwise) and op.activation is Activation.leaky_relu
            for op in core.ops
        )
    detail = f"{float_relus} in float, {int8_relus} in INT8"
    faults = encoding_faults(int8)
    checks = [
        Check("ReLUs lost or added", int8_relus.off_by(float_relus), 0, "ReLU", detail=detail)
    ]
    if faults is None and must_describe:
        faults = ["the file does not describe its integers, as that of the baseline did"]
    if faults is not None:
        checks.append(Check(ENCODING, len(faults), 0, "fault", detail="".join(faults[:1])))
    checks.append(float_layers_check(int8))
    return [*checks, optimisation]
