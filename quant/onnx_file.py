"""Read and write ONNX files without trusting them: an invalid model is reported in one sentence.

This module also reads the metadata that a network's file states about itself. The image that it
takes is read in `quant.onnx.image_input`.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from itertools import chain, product
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import (
    GraphProto,
    ModelProto,
    NodeProto,
    TensorProto,
    ValueInfoProto,
    helper,
    numpy_helper,
)

from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.formats import HEAD_BYTES, other_format
from beers_deploy.profiles.errors import (
    BeersError,
    ModelError,
    OptionError,
    one_line,
    printable,
    reason_of,
)
from beers_deploy.profiles.user_files.whole import read_whole, unreadable
from beers_deploy.quant.domains import IR_VERSION, MICROSOFT, OPSET, STANDARD, opset_of
from beers_deploy.quant.onnx.external_weights import take_in
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.onnx.messages import replace_all
from beers_deploy.quant.onnx.node_order import sort_nodes
from beers_deploy.quant.onnx.runnable import check_runnable, named
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.simplify.training_mode import require_inference
from beers_deploy.quant.untrusted import FILE_BYTES, check_content

REMEDY = (
    "Give an ONNX file, as 'beers-deploy export', 'beers-deploy quantize' or PyTorch writes it."
)


def load_onnx(path: Path, to_run: bool = True) -> ModelProto:
    """Read an ONNX model with its external weights; every file is read by this function.

    A float network is simplified (`quant.simplify`), and an INT8 network is returned unchanged. If
    a model is only inspected, and cannot be simplified, it is returned unchanged too.

    Args:
        path: the file.
        to_run: True if a runtime will open the model, which must then have ONNX's own operators.
            False if its nodes are only inspected; they may be of any domain.

    Returns:
        The model, with all weights in memory.

    Raises:
        ModelError: the file is missing, empty or not ONNX, has weights that are not finite, or
            cannot be trusted (see `quant.untrusted`). If `to_run`, also if it was exported in
            training mode or cannot be run (see `quant.onnx.runnable`).
    """
    try:
        content = read_whole(path, FILE_BYTES)
    except (OSError, ValueError) as error:
        reason = unreadable(path) or reason_of(error)
        raise ModelError(
            f"The network {printable(str(path))} cannot be read: {reason}. {REMEDY}"
        ) from error
    return _simplified(parse_onnx(content, str(path), to_run, path), str(path), to_run)


def read_onnx(content: bytes, where: str) -> ModelProto:
    """Read a network from bytes, with the checks and the simplification of `load_onnx`.

    Args:
        content: the bytes of an ONNX file that contains all its weights.
        where: name of the network for messages, such as "a.onnx".

    Raises:
        ModelError: the bytes are not ONNX, are of a network in training mode, or cannot be trusted.
    """
    return _simplified(parse_onnx(content, where), where, True)


def _simplified(model: ModelProto, where: str, to_run: bool) -> ModelProto:
    try:
        # First, because folding removes the Dropout and BatchNormalization that show the mode.
        require_inference(model, where)
        if is_quantized(model):
            return model
        # `parse_onnx` has checked those to run.
        if not to_run:
            check_runnable(model, where)
        return simplify(model, where)
    except ModelError:
        if to_run:
            raise
        return model


def parse_onnx(
    content: bytes, where: str, to_run: bool = True, path: Path | None = None
) -> ModelProto:
    """Parse and check a model from bytes as `load_onnx` does, without simplifying it.

    Args:
        content: the bytes of the file.
        where: name of the network for messages.
        to_run: True if a runtime will open the model, False if its nodes are only inspected.
        path: the path of the file, in whose folder weights may be stored; None if `content` has
            them all.

    Raises:
        ModelError: the bytes are not ONNX, or cannot be trusted.
    """
    if not content:
        raise ModelError(f"{where} is an empty file. {REMEDY}")
    if other := other_format(content[:HEAD_BYTES]):
        raise ModelError(f"{where} is not an ONNX file, but {other.name}: {other.remedy}.")
    try:
        model = ModelProto()
        model.ParseFromString(content)
        if path is not None:
            take_in(model, path)
        # Before onnx's checker, which opens the files that hold external weights.
        check_content(model, where)
        sort_nodes(model.graph)
        _check(model, where)
    except BeersError:
        raise
    except (DecodeError, onnx.checker.ValidationError, ValueError) as error:
        reason = reason_of(error) or "other bytes"
        raise ModelError(f"{where} is not an ONNX file: {reason}. {REMEDY}") from error
    opset = opset_of(model)
    newest = onnx.defs.onnx_opset_version()
    if opset > newest:
        raise ModelError(
            f"{where} has the ONNX opset {opset}, but {newest} is the newest that is supported. "
            "Export it for an older one."
        )
    if to_run:
        check_runnable(model, where)
    return model


def _check(model: ModelProto, where: str) -> None:
    """Apply onnx's checker, but let results have no sizes, as tools leave those that they add."""
    for node in model.graph.node:
        if node.domain in STANDARD and not onnx.defs.has(node.op_type):
            raise ModelError(
                f"{where} uses {printable(named(node))}, but ONNX has no such operator: the "
                "exporter could not translate a layer. Write that layer in another way, and "
                "export the network again."
            )
    tensors = [value.type.tensor_type for value in model.graph.output]
    open_tensors = [tensor for tensor in tensors if not tensor.HasField("shape")]
    for tensor in open_tensors:
        tensor.shape.SetInParent()
    onnx.checker.check_model(model)
    for tensor in open_tensors:
        tensor.ClearField("shape")


def require_onnx_name(*paths: Path | None) -> None:
    """Raise OptionError if the name of a file to write does not end in .onnx.

    Args:
        paths: the files; None is skipped.
    """
    for path in paths:
        if path is not None and path.suffix.lower() != ".onnx":
            raise OptionError(f"The name of the output must end in .onnx, got {path}.")


def save_onnx(model: ModelProto, path: Path) -> None:
    """Check a model, and write it to a file completely or not at all.

    Args:
        model: the model.
        path: the file, which is replaced if it exists.
    """
    onnx.checker.check_model(model)
    with whole_file(path) as temporary:
        onnx.save_model(model, temporary)


def metadata(model: ModelProto) -> dict[str, str]:
    """Return the metadata that a model's file states, as text by key."""
    return {item.key: item.value for item in model.metadata_props}


def make_model(graph: GraphProto, about: dict[str, str], microsoft: bool = False) -> ModelProto:
    """Build a model around a graph, with the ONNX versions that this project writes.

    Args:
        graph: the graph.
        about: the metadata of the model, by key.
        microsoft: True to import onnxruntime's own operators (the domain com.microsoft) as well.
    """
    opsets = [helper.make_opsetid("", OPSET)]
    opsets += [helper.make_opsetid(MICROSOFT, 1)] if microsoft else []
    model = helper.make_model(
        graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="beers-deploy"
    )
    helper.set_model_props(model, about)
    return model


class GraphWriter:
    """A graph under construction: nodes in order, and constants that are stored once by their name.

    Attributes:
        domain: the domain that nodes state; None leaves it out, which means ONNX's own.
    """

    domain: str | None = None
    """The domain of operators that state none; the empty one is ONNX's own, stated explicitly."""

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.weights: dict[str, TensorProto] = {}

    def node(
        self,
        kind: str,
        output: str,
        inputs: Sequence[str],
        name: str = "",
        domain: str | None = None,
        **attributes: int | float | str | list[int],
    ) -> str:
        """Append a node with one result, and return the name of the result.

        Args:
            kind: the operator.
            output: the name of the result.
            inputs: the names of the tensors that the node reads.
            name: the name of the node; that of the result if empty.
            domain: the domain of the operator; None for the domain of the writer.
            attributes: the attributes of the node.
        """
        node = helper.make_node(
            kind, inputs, [output], name=name or output, domain=domain or self.domain
        )
        node.attribute.extend(
            helper.make_attribute(key, value) for key, value in attributes.items()
        )
        self.nodes.append(node)
        return output

    def constant(self, name: str, value: np.ndarray) -> str:
        """Store a constant under a name, unless that name has one already, and return the name."""
        self.weights.setdefault(name, numpy_helper.from_array(value, name))
        return name

    def unit(self, frac_bits: int) -> str:
        """Add the scale 2^-frac_bits as a float32 constant, and return its name."""
        return self.constant(f"scale_2^{-frac_bits}", np.array(2.0**-frac_bits, np.float32))

    def graph(
        self, name: str, inputs: list[ValueInfoProto], outputs: list[ValueInfoProto]
    ) -> GraphProto:
        """Build the ONNX graph of the nodes and constants collected so far.

        Args:
            name: the name of the graph.
            inputs: type and shape of each input, such as `image_info` describes them.
            outputs: type and shape of each output.
        """
        return helper.make_graph(self.nodes, name, inputs, outputs, list(self.weights.values()))


OUTPUT = "output"
"""The metadata key of the name of the output, in a network with only one of its outputs."""


def with_one_output(model: ModelProto, name: str, where: str) -> ModelProto:
    """Return a network that has only one of its outputs, and only the nodes that compute it.

    Args:
        model: a network with several outputs; not changed.
        name: the output that remains.
        where: name of the network for messages.

    Returns:
        The network, simplified if it is a float one. Its metadata record the output's name.

    Raises:
        OptionError: the network has no output of this name.
    """
    values = {value.name: value for value in model.graph.output}
    if name not in values:
        raise OptionError(
            f"`output` must be an output of {where}, {printable(', '.join(values))}, got "
            f"{printable(repr(name))}. The file to write is `out`."
        )
    copy = deepcopy(model)
    graph = copy.graph
    replace_all(graph.output, [values[name]])
    OnnxGraph(copy).save()
    reads = {name, *chain.from_iterable(node.input for node in graph.node)}
    for parts in (graph.input, graph.initializer):
        replace_all(parts, [part for part in parts if part.name in reads])
    helper.set_model_props(copy, {**metadata(copy), OUTPUT: name})
    return _simplified(copy, where, to_run=False)


def is_quantized(model: ModelProto) -> bool:
    """Return True if a network is an INT8 one: any node reads, writes or computes with quantised
    numbers.
    """
    kinds = {node.op_type.lower() for node in model.graph.node}
    marks = ("qlinear", "quantizelinear", "integer")
    return any(mark in kind for kind, mark in product(kinds, marks))


@contextmanager
def faults_named(label: str) -> Iterator[None]:
    """Put the name of a network in front of a ModelError that is raised within the block.

    Functions that work on a model in memory do not know the name of its file. A message that states
    the name already is not changed.

    Args:
        label: the name of the network, such as that of its file.
    """
    try:
        yield
    except ModelError as error:
        # Only as a whole word, because a network may be called "image" or "a".
        if re.search(rf"(?<![\w.-]){re.escape(one_line(label))}(?![\w-])", str(error)):
            raise
        raise ModelError(f"{label}: {error}") from error


def require_quantized(model: ModelProto, name: str, expected: bool) -> None:
    """Raise ModelError unless a network is of the expected kind, float or INT8.

    This detects that a user gave the float and the INT8 file in the wrong order.

    Args:
        model: the network.
        name: the name of the network, with which the message begins.
        expected: True for an INT8 network, False for a float one.
    """
    if is_quantized(model) != expected:
        kinds = ("a float network", "an INT8 network")
        raise ModelError(
            f"{name} must be {kinds[expected]}, but it is {kinds[not expected]}. Give "
            f"{kinds[expected]} in its place."
        )
