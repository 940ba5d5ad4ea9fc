"""Fit the convolutions around replaced activations to the original network, without training.

1. HardSwish and HardSigmoid approximate SiLU and Sigmoid better over scaled ranges. Each channel
   gets the factor k with which HardSigmoid(k x), or a line through HardSwish(k x), is nearest to
   the original. The convolution in front is multiplied by k, and those behind HardSwish by 1 / k.
2. Each convolution that reads changed tensors is fitted in order, by least squares. From the
   adapted network's tensors it computes approximately what it computed from the original ones. That
   includes a scale for each channel, the correction of the bias, and the remaining error of the
   layers before. If the samples are too few for the weights, as in the small maps of a detector,
   only the bias is corrected.
"""

from collections.abc import Collection, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import chain

import numpy as np
import onnx
from onnx import TensorProto

from beers_deploy.model.progress import step
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.messages import replace_all
from beers_deploy.quant.onnx.window import Sides, Window
from beers_deploy.quant.session import open_any_size, tensors_of, with_outputs
from beers_deploy.quant.simplify.fold_affine import is_convolution

MOST_UNKNOWNS = 2304
"""A convolution is fitted if each output channel has at most this many weights, as with 3 x 3
pixels of 256 channels. With more, solving the equations takes too long.
"""
PIXELS_OF_EACH_UNKNOWN = 16
LEAST_PIXELS = 8192
"""Equations are taken at this many pixels for each weight, and at LEAST_PIXELS if that is more."""
LEAST_PIXELS_OF_EACH_UNKNOWN = 8
"""If maps have fewer pixels for each weight, only the bias is fitted; weights would overfit."""
RIDGE = 1e-5
"""The penalty on changing the weights, relative to the mean square of a convolution's input."""
FACTORS = np.geomspace(0.6, 3.6, 31)
"""Candidates of k."""
VALUES = 256
"""The number of values of a channel, from each image, that are compared for k."""


@dataclass(frozen=True)
class Networks:
    """The original network and the one with replaced activations, in which tensors have the same
    names.

    Attributes:
        original: the original network.
        adapted: the network with replaced activations, whose weights are changed in place.
        graph: the graph of the adapted network.
        images: (1, C, H, W) as the networks read them, on which both are run.
    """

    original: onnx.ModelProto
    adapted: onnx.ModelProto
    graph: OnnxGraph
    images: Sequence[np.ndarray]

    def is_conv(self, node: Node) -> bool:
        """Return True if a node is a convolution whose weights can be fitted.

        It must have constant weights and stated pads, and must not be transposed.
        """
        is_plain = node.attribute("auto_pad", "NOTSET") == "NOTSET"
        return node.op_type == "Conv" and is_plain and is_convolution(self.graph, node)

    def weights(self, node: Node) -> tuple[np.ndarray, np.ndarray]:
        """Return the weights (O, I / groups, kh, kw) and the bias (O,) of a convolution; zeros
        without a bias.
        """
        weight = self.graph.constants[node.inputs[1]]
        bias = self.graph.value(node, 2)
        return weight, np.zeros(len(weight), np.float32) if bias is None else bias

    def set_weights(self, node: Node, weight: np.ndarray, bias: np.ndarray) -> None:
        """Give a convolution of the adapted network weights and a bias of its own, in the graph and
        the model.

        Other nodes that read the same constants keep them.

        Args:
            node: the convolution.
            weight: (O, I / groups, kh, kw) the new weights.
            bias: (O,) the new bias.
        """
        numbers = {"weight": weight, "bias": bias}
        names = [self.graph.add_constant(f"{node.name}.{role}", v) for role, v in numbers.items()]
        node.inputs = (node.source, *names)
        self.graph.save()


def compensated(
    original: onnx.ModelProto,
    adapted: onnx.ModelProto,
    changed: Collection[str],
    images: Sequence[np.ndarray],
) -> onnx.ModelProto:
    """Fit the convolutions around replaced activations, so that the network computes nearly what
    the original did.

    Args:
        original: the original network.
        adapted: the same network with replaced activations; not changed.
        changed: the names of the tensors that the replaced activations write.
        images: (1, C, H, W) as the networks read them, on which both are run.

    Returns:
        A copy of `adapted` with other weights and biases.
    """
    model = deepcopy(adapted)
    networks = Networks(original, model, OnnxGraph(model), images)
    originals = OnnxGraph(original).writers
    writers = networks.graph.writers
    # 1. The last of several operators may have become a part of a convolution behind it.
    whole = [writers[name] for name in changed if name in writers]
    factors = _scale_activations(networks, whole)
    # 2.
    behind = {name for name in writers if name in changed or name.rpartition(".")[0] in changed}
    convolutions = []
    for node in networks.graph.nodes:
        if behind.intersection(node.inputs):
            behind.update(node.outputs)
            # Convolutions within an exact replacement have no tensor to be compared with.
            is_known = networks.is_conv(node) and node.result in originals
            weight = networks.graph.value(node, 1)
            if is_known and weight is not None and weight[0].size <= MOST_UNKNOWNS:
                convolutions.append(node)
    targets = _targets(networks, convolutions)
    for number, (node, target) in enumerate(zip(convolutions, targets, strict=True), 1):
        step(f"fitting convolution {number} of {len(convolutions)}")
        _fit(networks, node, target, factors.get(node.result))
    return model


@dataclass(frozen=True)
class FitTarget:
    """Values that the original network computes at K pixels of a map, to which a convolution is
    fitted.

    Attributes:
        rows: (K,) the row of each pixel.
        columns: (K,) the column of each pixel.
        values: (K, O) the values of the O channels at these pixels.
    """

    rows: np.ndarray
    columns: np.ndarray
    values: np.ndarray


def _targets(networks: Networks, nodes: Sequence[Node]) -> list[list[FitTarget]]:
    """Return the results of each convolution for each image, in one run of the original."""
    targets = [list[FitTarget]() for _ in nodes]
    if not nodes:
        return targets
    generator = np.random.default_rng(0)
    unknowns = [networks.weights(node)[0][0].size for node in nodes]
    outputs = [node.result for node in nodes]
    for maps in part_values(networks.original, outputs, networks.images):
        for target, values, count in zip(targets, maps, unknowns, strict=True):
            total = max(LEAST_PIXELS, PIXELS_OF_EACH_UNKNOWN * count)
            height, width = values.shape[2:]
            n_pixels = min(-(-total // len(networks.images)), height * width)
            places = generator.integers(0, height * width, n_pixels)
            rows, columns = np.unravel_index(places, (height, width))
            target.append(FitTarget(rows, columns, values[0][:, rows, columns].T))
    return targets


def _scale_activations(networks: Networks, replaced: Sequence[Node]) -> dict[str, np.ndarray]:
    """Put k in front of activations and 1 / k behind them; return k (C,) of each tensor."""
    nodes = [node for node in replaced if _may_scale(networks, node)]
    names = list(chain.from_iterable((node.source, node.result) for node in nodes))
    if not names:
        return {}
    values = list[list[np.ndarray]]()
    for maps in part_values(networks.original, names, networks.images):
        flat = [array[0].reshape(array.shape[1], -1) for array in maps]
        values.append([array[:, :: -(-array.shape[1] // VALUES)] for array in flat])
    columns = [np.concatenate(arrays, axis=1) for arrays in zip(*values, strict=True)]
    factors = dict[str, np.ndarray]()
    for node, source, result in zip(nodes, columns[::2], columns[1::2], strict=True):
        best = _best_factors(node.op_type == "HardSwish", source, result)
        factors[node.source] = best
        before = networks.graph.writer(node.source)
        weight, bias = networks.weights(before)
        networks.set_weights(before, weight * best[:, None, None, None], bias * best)
        if node.op_type != "HardSwish":
            continue
        for reader in networks.graph.readers[node.result]:
            weight, bias = networks.weights(reader)
            # Depthwise convolutions and those of groups read only their own group's channels.
            shape = (reader.groups, 1, -1, 1, 1)
            split = weight.reshape(shape[0], -1, *weight.shape[1:])
            networks.set_weights(reader, (split / best.reshape(shape)).reshape(weight.shape), bias)
    return factors


def _may_scale(networks: Networks, node: Node) -> bool:
    """Return True if factors can go into the convolutions in front of an activation and behind."""
    graph = networks.graph
    if not networks.is_conv(graph.sole_writer(node.source)):
        return False
    behind = all(networks.is_conv(reader) for reader in graph.readers[node.result])
    # A HardSigmoid is only scaled in front.
    is_alone = node.op_type == "HardSwish" and behind and node.result not in graph.outputs
    return is_alone or node.op_type == "HardSigmoid"


def _best_factors(is_swish: bool, source: np.ndarray, result: np.ndarray) -> np.ndarray:
    """Return the best k (C,) from the input of an activation and the original's output, (C, K)."""
    residuals = []
    centred = result - result.mean(1, keepdims=True)
    for factor in FACTORS:
        scaled = source * np.float32(factor)
        candidate = np.clip(scaled / 6 + 0.5, 0, 1)
        # A gate multiplies another map, so no convolution behind can add the offset of a line.
        if not is_swish:
            residuals.append(np.square(candidate - result).mean(1))
            continue
        candidate = candidate * scaled
        candidate = candidate - candidate.mean(1, keepdims=True)
        variance = np.maximum(np.square(candidate).mean(1), np.finfo(np.float32).tiny)
        # The part of the variance that a line through the candidate explains; the rest is the same
        # for every k.
        residuals.append(-np.square((candidate * centred).mean(1)) / variance)
    return np.asarray(FACTORS[np.argmin(residuals, axis=0)], np.float32)


def _fit(
    networks: Networks, node: Node, targets: Sequence[FitTarget], factors: np.ndarray | None
) -> None:
    """Solve the normal equations of a convolution, group by group.

    Args:
        networks: both networks.
        node: the convolution, in the adapted network.
        targets: its results in the original network, for each image.
        factors: k (O,) of its results, None for 1.
    """
    weight, bias = networks.weights(node)
    kernel_and_window = node.window(weight.shape[2:])
    if kernel_and_window is None:
        return
    kernel, window = kernel_and_window
    groups = node.groups
    equations = Equations(groups, weight[0].size, len(weight) // groups)
    names = [node.source, node.result]
    adapted = part_values(networks.adapted, names, networks.images)
    for target, (source, result) in zip(targets, adapted, strict=True):
        expected = target.values if factors is None else target.values * factors
        equations.add(
            _windows(source[0], kernel, window, (target.rows, target.columns)),
            expected - result[0, :, target.rows, target.columns],
        )
    change, bias_change = equations.solved()
    networks.set_weights(node, weight + change.reshape(weight.shape), bias + bias_change)


class Equations:
    """The normal equations of least squares for a convolution's weights and bias, added up image by
    image.
    """

    def __init__(self, groups: int, unknowns: int, results: int) -> None:
        """Start with no equations.

        Args:
            groups: the number of groups of the convolution, each of which is fitted by itself.
            unknowns: the number of weights of one output channel: I / groups * kh * kw.
            results: the number of output channels of a group.
        """
        self._shape = groups, unknowns, results
        self._gram = np.zeros((groups, unknowns, unknowns))
        self._moment = np.zeros((groups, unknowns, results))
        self._reads = np.zeros((groups, unknowns, 1))
        self._errors = np.zeros((groups, 1, results))
        self._count = 0

    def add(self, reads: np.ndarray, errors: np.ndarray) -> None:
        """Add equations from K pixels of a map.

        Args:
            reads: (K, I, kh, kw) the values that the convolution reads for each pixel.
            errors: (K, O) the changes that its results need there.
        """
        groups, unknowns, results = self._shape
        x = reads.reshape(-1, groups, unknowns).transpose(1, 2, 0).astype(np.float64)
        y = errors.reshape(-1, groups, results).swapaxes(0, 1).astype(np.float64)
        self._gram += x @ x.swapaxes(1, 2)
        self._moment += x @ y
        self._reads += x.sum(2, keepdims=True)
        self._errors += y.sum(1, keepdims=True)
        self._count += len(reads)

    def solved(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the changes of weights and bias that fit the equations best, with a penalty of
        RIDGE.

        If there are fewer than LEAST_PIXELS_OF_EACH_UNKNOWN pixels for each weight, only the bias
        is changed.

        Returns:
            The changes (O, I / groups * kh * kw) of the weights and (O,) of the bias, float64.
        """
        groups, unknowns, results = self._shape
        if self._count < LEAST_PIXELS_OF_EACH_UNKNOWN * unknowns:
            bias_change = (self._errors / self._count).ravel()
            return np.zeros((groups * results, unknowns)), bias_change
        # The means are subtracted, so that the bias has no penalty.
        reads = self._reads / self._count
        errors = self._errors / self._count
        gram = self._gram / self._count - reads @ reads.swapaxes(1, 2)
        moment = self._moment / self._count - reads @ errors
        penalty = RIDGE * np.trace(gram, axis1=1, axis2=2) / unknowns + np.finfo(np.float32).tiny
        gram += penalty[:, None, None] * np.eye(unknowns)
        change = np.linalg.solve(gram, moment)
        bias_change = errors - reads.swapaxes(1, 2) @ change
        return change.swapaxes(1, 2).reshape(groups * results, unknowns), bias_change.ravel()


def _windows(
    source: np.ndarray, kernel: Sides, window: Window, places: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return the input windows of a convolution in a map (I, H, W) for its results at some places.

    Returns:
        (K, I, kh, kw) for K places.
    """
    top, left, bottom, right = window.pads
    padded = np.pad(source, ((0, 0), (top, bottom), (left, right)))
    rows, columns = (
        place[:, None] * stride + np.arange(side) * dilation
        for place, stride, side, dilation in zip(
            places, window.strides, kernel, window.dilations, strict=True
        )
    )
    return padded[:, rows[:, :, None], columns[:, None, :]].swapaxes(0, 1)


def part_values(
    model: onnx.ModelProto, names: Sequence[str], images: Sequence[np.ndarray]
) -> Iterator[list[np.ndarray]]:
    """Yield the named tensors for each image; only the nodes in front of them are run."""
    part = with_outputs(model, dict.fromkeys(names, TensorProto.FLOAT))
    replace_all(part.graph.output, [v for v in part.graph.output if v.name in names])
    OnnxGraph(part).save()
    session = open_any_size(part)
    for image in images:
        yield tensors_of(session, list(names), image)
