"""Check that an ONNX file holds what it states, before any of it is used.

Whether a runtime may open it is checked by `quant.onnx.runnable`.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from types import ModuleType

import numpy as np
from onnx import GraphProto, ModelProto, TensorProto, helper, numpy_helper

from beers_deploy.profiles.errors import BeersError, ModelError, printable, reason_of

DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)
"""Exceptions that reading a damaged description raises, from Python and from NumPy."""

FILE_BYTES = 1 << 30
VALUES = 1 << 28
"""The maximum number of values of one tensor that a file sizes without storing it: 1 GiB of
float32.
"""
RANK = 16

FLOATS = (TensorProto.FLOAT, TensorProto.DOUBLE, TensorProto.FLOAT16, TensorProto.BFLOAT16)
VALUE_BYTES: dict[int, int] = {
    **dict.fromkeys((TensorProto.BOOL, TensorProto.INT8, TensorProto.UINT8), 1),
    **dict.fromkeys(
        (TensorProto.FLOAT16, TensorProto.BFLOAT16, TensorProto.INT16, TensorProto.UINT16), 2
    ),
    **dict.fromkeys((TensorProto.FLOAT, TensorProto.INT32, TensorProto.UINT32), 4),
    **dict.fromkeys((TensorProto.DOUBLE, TensorProto.INT64, TensorProto.UINT64), 8),
}
"""The number of bytes per value of each plain number type."""


def check_content(model: ModelProto, where: str) -> None:
    """Raise ModelError if a model does not hold what it states.

    It checks that names are text, that there are an input and an output, that no stated size is
    absurd, and that each weight has as many finite values as its size states.

    Args:
        model: the parsed file, not checked before.
        where: name of the network for the message, such as "a.onnx" or "the float network".
    """
    graph = model.graph
    # protobuf returns bytes unchanged that are not valid UTF-8.
    names = chain.from_iterable((node.op_type, node.domain, node.name) for node in graph.node)
    if not all(isinstance(name, str) for name in names):
        raise ModelError(f"{where} has a name that is no text. Copy or export it again.")
    initializers = {tensor.name for tensor in graph.initializer}
    if all(value.name in initializers for value in graph.input) or not graph.output:
        raise ModelError(
            f"The graph of {where} must have an input and an output, but it has none. Export the "
            "network again."
        )
    for value in (*graph.input, *graph.output, *graph.value_info):
        check_size(value.name, [d.dim_value for d in value.type.tensor_type.shape.dim], where)
    for tensor in held_tensors(graph):
        _check_tensor(tensor, where)


@contextmanager
def contradictions(where: str) -> Iterator[None]:
    """Turn errors within the block that a malformed graph causes into a ModelError.

    Missing inputs and impossible sizes cause such errors, at any place that reads the graph.

    Args:
        where: name of the network for the message, such as "a.onnx" or "the float network".

    Raises:
        ModelError: one of the exceptions in DAMAGE was raised within the block.
    """
    try:
        yield
    except BeersError:
        raise
    except DAMAGE as error:
        if isinstance(getattr(error, "obj", None), ModuleType):
            # The installed library lacks a function that this program calls, whatever the file
            # contains.
            raise
        reason = reason_of(error)
        raise ModelError(
            f"Nodes of {where} contradict their definition in ONNX ({reason}). Check the file with "
            "onnx.checker, and export it again."
        ) from error


def check_size(name: str, sizes: Iterable[float], where: str) -> None:
    """Raise ModelError if a tensor that a file only sizes would have more than VALUES values, or
    too many axes.

    Args:
        name: the name of the tensor, for the message.
        sizes: the sizes that the file states; 0 and -1 mean a free size.
        where: name of the network, for the message.
    """
    sizes = list(sizes)
    allowed = len(sizes) <= RANK and min(sizes, default=0) >= -1
    # Written so that NaN is refused as well: it compares as False.
    if not allowed or not math.prod(max(size, 1) for size in sizes) <= VALUES:
        raise ModelError(
            f"{printable(repr(name))} in {where} has the size {printable(times(sizes))}, but a "
            f"tensor may have at most {VALUES} values. Export the network again."
        )


def times(sizes: Iterable[float]) -> str:
    """Format sizes as text for a message, such as "64 x 3 x 3"."""
    return " x ".join(f"{size:.12g}" for size in sizes)


def held_tensors(graph: GraphProto) -> Iterator[TensorProto]:
    """Yield every constant tensor of a graph: initializers and attributes of nodes, nested graphs
    included.

    protobuf itself limits the nesting to a hundred.
    """
    yield from graph.initializer
    for sparse in graph.sparse_initializer:
        yield from (sparse.values, sparse.indices)
    for attribute in chain.from_iterable(node.attribute for node in graph.node):
        if attribute.HasField("t"):
            yield attribute.t
        yield from attribute.tensors
        graphs = [attribute.g] if attribute.HasField("g") else []
        for inner in (*graphs, *attribute.graphs):
            yield from held_tensors(inner)


def _check_tensor(tensor: TensorProto, where: str) -> None:
    name = printable(repr(tensor.name))
    if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
        places = {entry.key: entry.value for entry in tensor.external_data}
        place = printable(repr(places.get("location", "no place")))
        raise ModelError(
            f"{where} stores {name} in another file, {place}. Save the network as one "
            "self-contained ONNX file."
        )
    kind = tensor.data_type
    if kind not in VALUE_BYTES:
        names = {number: text for text, number in TensorProto.DataType.items()}
        raise ModelError(
            f"{name} in {where} has the type {names.get(kind, kind)}, but weights must be plain "
            "numbers. Convert them."
        )
    if len(tensor.dims) > RANK or min(tensor.dims, default=0) < 0:
        raise ModelError(
            f"{name} in {where} has the size {printable(times(tensor.dims))}, but a tensor has at "
            f"most {RANK} dimensions, each 0 or more. Export it again."
        )
    # If a tensor states more values than it contains, a runtime allocates first and reads
    # afterwards.
    stated_count = math.prod(tensor.dims)
    raw = tensor.HasField("raw_data")
    field = tensor.raw_data if raw else getattr(tensor, helper.tensor_dtype_to_field(kind))
    stored_count = len(field) / (VALUE_BYTES[kind] if raw else 1)
    if stated_count != stored_count:
        raise ModelError(
            f"The weights {name} in {where} state {times(tensor.dims)} values, but the file holds "
            f"{stored_count:g}. Copy or export it again."
        )
    if kind not in FLOATS:
        return
    # A single number may be infinite, for example as a bound of Clip, but not NaN.
    values = numpy_helper.to_array(tensor)
    missing = np.isnan(values) if not tensor.dims else ~np.isfinite(values)
    if missing.any():
        short = printable(tensor.name) or "a constant"
        raise ModelError(
            f"The weights of {where} must be finite, but {short} has {np.count_nonzero(missing)} "
            "NaN or infinite values. Train or export the network again."
        )
