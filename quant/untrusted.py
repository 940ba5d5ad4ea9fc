"""Whether an ONNX file holds what it states, and may be run: looked at before it is used."""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from types import ModuleType

import numpy as np
import onnx
from onnx import AttributeProto, NodeProto, TensorProto, helper, numpy_helper

from beers_deploy.profiles.errors import BeersError, ModelError
from beers_deploy.quant.domains import INLINE, MICROSOFT, STANDARD, foreign_remedy

DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)
"""What reading a damaged description raises, of Python and of NumPy."""

FILE_BYTES = 1 << 30
VALUES = 1 << 28
"""Of one tensor that a file sizes without holding it: 1 GiB of float32."""
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
"""Bytes of a value of each type of plain numbers."""


def check_content(model: onnx.ModelProto, where: str) -> None:
    """Refuse a model that does not hold what it states."""
    graph = model.graph
    initializers = {tensor.name for tensor in graph.initializer}
    if all(value.name in initializers for value in graph.input) or not graph.output:
        raise refused(
            where, "a network with an input and an output", "none", "export the network again"
        )
    for value in (*graph.input, *graph.output, *graph.value_info):
        check_size(value.name, [d.dim_value for d in value.type.tensor_type.shape.dim], where)
    for tensor in held_tensors(graph):
        _check_tensor(tensor, where)


@contextmanager
def contradictions(where: str) -> Iterator[None]:
    """One sentence for whatever a graph leads to whose nodes lack inputs, or have sizes that cannot
    be.
    """
    try:
        yield
    except BeersError:
        raise
    except DAMAGE as error:
        if isinstance(getattr(error, "obj", None), ModuleType):
            # The installed library lacks what this program calls, whatever the file holds.
            raise
        got = f"nodes that contradict it ({' '.join(str(error).split())[:80]})"
        remedy = "check the file with onnx.checker, and export it again"
        raise refused(where, "nodes as ONNX defines them", got, remedy) from error


def check_size(name: str, sizes: Iterable[float], where: str) -> None:
    """Refuse a tensor that a file sizes beyond reason; 0 and -1 stand for sizes left open."""
    sizes = list(sizes)
    allowed = len(sizes) <= RANK and min(sizes, default=0) >= -1
    # Written so that NaN is refused as well: it compares as False.
    if not allowed or not math.prod(max(size, 1) for size in sizes) <= VALUES:
        got = f"{name!r} of {times(sizes)}"
        raise refused(where, f"tensors of at most {VALUES} values", got, "export the network again")


def times(sizes: Iterable[float]) -> str:
    """Sizes as a person writes them: 64 x 3 x 3."""
    return " x ".join(f"{size:.12g}" for size in sizes)


def refused(where: str, expected: str, got: str, remedy: str) -> ModelError:
    """What is raised of a file."""
    return ModelError(where, expected=expected, got=got, remedy=remedy)


def held_tensors(graph: onnx.GraphProto) -> Iterator[TensorProto]:
    """Every constant, also of graphs within; protobuf itself ends their nesting at a hundred."""
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
    _check_place_and_type(tensor, where)
    if len(tensor.dims) > RANK or min(tensor.dims, default=0) < 0:
        got = f"{tensor.name!r} of {times(tensor.dims)}"
        raise refused(where, f"at most {RANK} sizes from 0 on", got, "export it again")
    # A tensor that states more than it holds makes a runtime allocate first and read afterwards.
    stated_count = math.prod(tensor.dims)
    raw = tensor.HasField("raw_data")
    kind = tensor.data_type
    field = tensor.raw_data if raw else getattr(tensor, helper.tensor_dtype_to_field(kind))
    stored_count = len(field) / (VALUE_BYTES[kind] if raw else 1)
    if stated_count != stored_count:
        got = f"{tensor.name!r} of {times(tensor.dims)} values that holds {stored_count:g}"
        raise refused(where, "weights as many as it states", got, "copy or export it again")
    _check_finite(tensor, where)


def _check_finite(tensor: TensorProto, where: str) -> None:
    """Of a plain number infinity may be meant, as a bound of Clip; of weights nothing that is not
    finite.
    """
    if tensor.data_type not in FLOATS:
        return
    values = numpy_helper.to_array(tensor)
    lost = np.isnan(values) if not tensor.dims else ~np.isfinite(values)
    if lost.any():
        got = f"{np.count_nonzero(lost)} NaN or infinite in {tensor.name or 'a constant'}"
        raise refused(where, "finite weights", got, "train or export it again")


def _check_place_and_type(tensor: TensorProto, where: str) -> None:
    if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
        place = next(
            (entry.value for entry in tensor.external_data if entry.key == "location"), "no place"
        )
        got = f"{tensor.name!r} kept in another file, {place!r}"
        raise refused(where, "one self-contained ONNX file", got, "save it as one file")
    if tensor.data_type not in VALUE_BYTES:
        type_numbers = TensorProto.DataType.values()
        kind = (
            TensorProto.DataType.Name(tensor.data_type)
            if tensor.data_type in type_numbers
            else f"{tensor.data_type}"
        )
        raise refused(
            where, "weights of plain numbers", f"{tensor.name!r} of type {kind}", "convert them"
        )


WINDOW_PX = 1024
"""Kernel, stride, dilation or padding of a window, or a factor of enlargement."""

ONNXRUNTIMES = {(MICROSOFT, "QLinearAdd"), (MICROSOFT, "QLinearMul")}
"""Its operators that we write."""

WINDOWS = {"kernel_shape", "strides", "dilations", "pads", "output_padding", "blocksize"}
SIZES = {"CenterCropPad": (1,), "Expand": (1,), "MaxUnpool": (2,), "OneHot": (1,), "Resize": (3,)}
"""Operators with an input that says how large the result is, and which."""
FACTORS = {"Pad": (1,), "Resize": (2,), "Tile": (1,), "Upsample": (1,)}
"""The same, of an input that says by how much larger."""
KEEPING = {
    "Cast",
    "Constant",
    "DequantizeLinear",
    "Identity",
    "Neg",
    "QuantizeLinear",
    "Reshape",
    "Sqrt",
    "Squeeze",
    "Transpose",
    "Unsqueeze",
}
"""What may be computed of constants alone: no result of these is larger than what they read."""


def check_runnable(model: onnx.ModelProto, where: str) -> None:
    """Refuse a model that no runtime of ours should open."""
    for function in model.functions:
        got = f"{function.name} of {function.domain!r}, a function of the file"
        raise refused(where, "operators of ONNX itself", got, INLINE)
    if model.graph.sparse_initializer:
        raise refused(where, "plain weights", "sparse ones", "export it without them")
    constants = _Constants(model, where)
    # What follows from the image is sized by it; what follows from constants alone may have any
    # size.
    of_image = {value.name for value in model.graph.input} - set(constants.values)
    for node in model.graph.node:
        _check_operator(node, where)
        _check_windows(node, where)
        _check_growth(node, constants.values, of_image, where)
        if of_image.intersection(node.input):
            of_image.update(node.output)
        else:
            constants.follow(node)


class _Constants:
    """What is computed of constants alone: its values, where they are a short list, and how much
    there is of it.
    """

    def __init__(self, model: onnx.ModelProto, where: str) -> None:
        self.values = {tensor.name: tensor for tensor in model.graph.initializer}
        self._arrays: dict[str, np.ndarray] = {}
        self._made = 0
        self._where = where
        self._opset = opset_of(model)

    def follow(self, node: NodeProto) -> None:
        """Note a node that reads no image."""
        stored = (
            [a.t for a in node.attribute if a.name == "value"] if node.op_type == "Constant" else []
        )
        if stored:
            self.values[node.output[0]] = stored[0]
            return
        arrays = [self._array(name) for name in node.input]
        self._check_filled(node, arrays)
        result = _computed(node, arrays, self._opset)
        if result is not None:
            self.values[node.output[0]] = numpy_helper.from_array(result, node.output[0])
        elif node.op_type not in KEEPING | {"ConstantOfShape"}:
            got = f"{named(node)} of constants alone"
            raise refused(
                self._where, "operators that work on the image", got, "fold its constants"
            )

    def _array(self, name: str) -> np.ndarray | None:
        """A short list, None where it is none."""
        tensor = self.values.get(name)
        if (
            name not in self._arrays
            and tensor is not None
            and math.prod(tensor.dims) <= LIST_VALUES
        ):
            self._arrays[name] = numpy_helper.to_array(tensor)
        return self._arrays.get(name)

    def _check_filled(self, node: NodeProto, arrays: list[np.ndarray | None]) -> None:
        """Weights may be filled with one number, as far as the file states how many."""
        if node.op_type != "ConstantOfShape":
            return
        if len(arrays) != 1 or arrays[0] is None:
            raise refused(
                self._where,
                "sizes that the file states",
                f"a computed one in {named(node)}",
                "fold it",
            )
        sizes = [int(size) for size in arrays[0].ravel()[: RANK + 1]]
        check_size(named(node), sizes, self._where)
        self._made += math.prod(max(size, 0) for size in sizes)
        check_size("what constants fill", [self._made], self._where)


LIST_VALUES = 4096
"""Of one list; a runtime that computes with such ones is done in a moment."""

COMPUTED = {
    "Add",
    "Cast",
    "Concat",
    "ConstantOfShape",
    "Div",
    "Gather",
    "Identity",
    "Mul",
    "Neg",
    "Reshape",
    "Shape",
    "Slice",
    "Sqrt",
    "Squeeze",
    "Sub",
    "Transpose",
    "Unsqueeze",
}


def _computed(
    node: NodeProto, values: Sequence[np.ndarray | None], opset: int
) -> np.ndarray | None:
    """What a node computes of short lists, None where that is no short list of numbers or not
    computed here.

    Exporters leave a dozen nodes to state four sizes. They are computed by onnx's reference in
    Python, before a runtime has the file: so the sizes that follow are looked at like those that a
    file states. The caller has bounded what ConstantOfShape makes.
    """
    short = all(value is not None and value.size <= LIST_VALUES for value in values)
    if node.op_type not in COMPUTED or not short:
        return None
    # Importing it takes half a second, which only files that compute sizes should cost.
    from onnx.reference import ReferenceEvaluator

    try:
        with np.errstate(all="ignore"):
            feeds = dict(zip(node.input, values, strict=True))
            result = next(iter(ReferenceEvaluator(node, opsets={"": opset}).run(None, feeds)))
    except Exception:  # noqa: BLE001 - whatever the reference raises of a node that is none means: not known
        return None
    array = np.asarray(result)
    return array if array.dtype.kind in "biuf" and array.size <= LIST_VALUES else None


def opset_of(model: onnx.ModelProto) -> int:
    """The version of ONNX's own operators."""
    return max(
        (opset.version for opset in model.opset_import if opset.domain in STANDARD), default=1
    )


def named(node: NodeProto) -> str:
    """A node's operator and name, as sentences say it."""
    return f"{node.op_type} {node.name}".strip()


def _check_operator(node: NodeProto, where: str) -> None:
    if node.domain not in STANDARD and (node.domain, node.op_type) not in ONNXRUNTIMES:
        got = f"{named(node)} of {node.domain!r}"
        remedy = foreign_remedy(node.domain, node.op_type)
        raise refused(where, "operators of ONNX itself", got, remedy)
    if any(a.HasField("g") or a.graphs or a.HasField("sparse_tensor") for a in node.attribute):
        raise refused(
            where, "nodes that run once", f"{named(node)} with a graph within", "unroll it"
        )


def _check_windows(node: NodeProto, where: str) -> None:
    for attribute in node.attribute:
        if attribute.name in WINDOWS and attribute.type in (
            AttributeProto.INT,
            AttributeProto.INTS,
        ):
            largest = max(map(abs, (attribute.i, *attribute.ints)))
            if largest > WINDOW_PX:
                got = f"{attribute.name} of {largest} in {named(node)}"
                raise refused(
                    where, f"windows of at most {WINDOW_PX} pixels", got, "export the network again"
                )
        elif attribute.name in ("shape", "output_shape"):
            check_size(named(node), attribute.ints, where)


def _check_growth(
    node: NodeProto, constants: dict[str, TensorProto], of_image: set[str], where: str
) -> None:
    """A size that the file holds is looked at; one of the image's own is its matter; any other
    could be anything.
    """
    for places, absolute in ((SIZES, True), (FACTORS, False)):
        for name in (node.input[i] for i in places.get(node.op_type, ()) if i < len(node.input)):
            if not name or name in of_image:
                continue
            if name not in constants:
                raise refused(
                    where,
                    "sizes that the file states",
                    f"a computed one in {named(node)}",
                    "fold it",
                )
            # At most one more than any list of sizes has.
            values = [
                float(value)
                for value in numpy_helper.to_array(constants[name]).ravel()[: 2 * RANK + 1]
            ]
            if absolute:
                check_size(named(node), values, where)
            elif not max(map(abs, values), default=0) <= WINDOW_PX:
                got = f"{named(node)} by {times(values)}"
                remedy = "export the network again"
                raise refused(where, f"enlargements of at most {WINDOW_PX}", got, remedy)
