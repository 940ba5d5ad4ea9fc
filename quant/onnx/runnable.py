"""Check that a runtime may open an ONNX file: operators of ONNX itself, and sizes within bounds.

`quant.untrusted` has checked the file's content before.
"""

import math
from collections.abc import Sequence

import numpy as np
import onnx
from onnx import AttributeProto, NodeProto, TensorProto, numpy_helper

from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.domains import INLINE, MICROSOFT, STANDARD, foreign_remedy, opset_of
from beers_deploy.quant.untrusted import RANK, check_size, times

WINDOW_PX = 1024
"""The limit of kernel, stride, dilation or padding of a window, and of a factor of enlargement."""

ONNXRUNTIMES = {(MICROSOFT, "QLinearAdd"), (MICROSOFT, "QLinearMul")}
"""onnxruntime's own operators that this project writes."""

WINDOWS = {"kernel_shape", "strides", "dilations", "pads", "output_padding", "blocksize"}
SIZES = {"CenterCropPad": (1,), "Expand": (1,), "MaxUnpool": (2,), "OneHot": (1,), "Resize": (3,)}
"""Operators with an input that states the size of the result, and that input."""
FACTORS = {"Pad": (1,), "Resize": (2,), "Tile": (1,), "Upsample": (1,)}
"""Operators with an input that states the enlargement, and that input."""
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
"""Operators that may be computed from constants alone, because their result is no larger than their
inputs.
"""
FILLING = {"ConstantOfShape", "Expand", "Tile"}
"""Operators that may be computed from constants alone if the file states the size of the result."""


def check_runnable(model: onnx.ModelProto, where: str) -> None:
    """Raise ModelError if no runtime should open a model.

    Args:
        model: to be checked.
        where: name of the network for the message, such as "a.onnx" or "the float network".
    """
    for function in model.functions:
        name = printable(f"{function.name} of {function.domain!r}")
        raise _not_of_onnx(f"{name}, a function that the file defines", where, INLINE)
    if model.graph.sparse_initializer:
        raise ModelError(
            f"{where} has sparse weights, which are not supported. Export it without them."
        )
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
    """Results that are computed from constants alone: their values if they are a short list, and
    their total size.
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
        elif node.op_type not in KEEPING | FILLING:
            raise ModelError(
                f"{printable(named(node))} in {self._where} reads constants only, but only "
                "operators on the image are supported here. Fold its constants."
            )

    def _array(self, name: str) -> np.ndarray | None:
        """Return a constant as an array if it is a short list, otherwise None."""
        tensor = self.values.get(name)
        if (
            name not in self._arrays
            and tensor is not None
            and math.prod(tensor.dims) <= LIST_VALUES
        ):
            self._arrays[name] = numpy_helper.to_array(tensor)
        return self._arrays.get(name)

    def _check_filled(self, node: NodeProto, arrays: list[np.ndarray | None]) -> None:
        """Raise ModelError if a node fills weights to a size that the file does not state, or that
        is too large.
        """
        if node.op_type not in FILLING:
            return
        source = self.values.get(node.input[0])
        if not arrays or arrays[-1] is None or source is None:
            raise _computed_size(node, self._where)
        sizes = [int(size) for size in arrays[-1].ravel()[: RANK + 1]]
        # One size or factor each, or fewer sizes for Expand, whose source then is as large.
        if node.op_type != "ConstantOfShape":
            dims = [1] * (len(sizes) - len(source.dims)) + list(source.dims)
            if len(dims) == len(sizes):
                sizes = [abs(size) * dim for size, dim in zip(sizes, dims, strict=True)]
        check_size(named(node), sizes, self._where)
        self._made += math.prod(max(size, 0) for size in sizes)
        check_size("all filled constants", [self._made], self._where)


LIST_VALUES = 4096
"""The maximum number of values of one list; a runtime computes with such lists in a moment."""

COMPUTED = {
    "Add",
    "Cast",
    "Concat",
    "ConstantOfShape",
    "Div",
    "Expand",
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
    "Tile",
    "Transpose",
    "Unsqueeze",
}


def _computed(
    node: NodeProto, values: Sequence[np.ndarray | None], opset: int
) -> np.ndarray | None:
    """Compute the result of a node from short lists; None if it is no short list of numbers, or is
    not supported.

    Exporters leave a dozen nodes to state four sizes. onnx's reference in Python computes them
    before a runtime opens the file. The resulting sizes are therefore checked like those that a
    file states. The caller has bounded the results of ConstantOfShape.
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


def named(node: NodeProto) -> str:
    """Return operator and name of a node, for a sentence."""
    return f"{node.op_type} {node.name}".strip()


def _check_operator(node: NodeProto, where: str) -> None:
    if node.domain not in STANDARD and (node.domain, node.op_type) not in ONNXRUNTIMES:
        name = printable(f"{named(node)} of {node.domain!r}")
        raise _not_of_onnx(name, where, foreign_remedy(node.domain, node.op_type))
    if any(a.HasField("g") or a.graphs or a.HasField("sparse_tensor") for a in node.attribute):
        raise ModelError(
            f"{printable(named(node))} in {where} contains a graph, such as the body of a loop. "
            "Unroll it, so that each node runs once."
        )


def _not_of_onnx(name: str, where: str, remedy: str) -> ModelError:
    return ModelError(
        f"{where} uses {name}, but only operators of ONNX itself are supported: {remedy}."
    )


def _computed_size(node: NodeProto, where: str) -> ModelError:
    return ModelError(
        f"{printable(named(node))} in {where} has a size that other nodes compute, but the file "
        "must state it. Fold it into a constant."
    )


def _check_windows(node: NodeProto, where: str) -> None:
    for attribute in node.attribute:
        if attribute.name in WINDOWS and attribute.type in (
            AttributeProto.INT,
            AttributeProto.INTS,
        ):
            largest = max(map(abs, (attribute.i, *attribute.ints)))
            if largest > WINDOW_PX:
                raise ModelError(
                    f"{printable(named(node))} in {where} has {attribute.name} of {largest}, but a "
                    f"window has at most {WINDOW_PX} pixels. Export the network again."
                )
        elif attribute.name in ("shape", "output_shape"):
            check_size(named(node), attribute.ints, where)


def _check_growth(
    node: NodeProto, constants: dict[str, TensorProto], of_image: set[str], where: str
) -> None:
    """Raise ModelError if a node may enlarge too much.

    A size that the file stores is checked. A size that derives from the image is allowed. Any other
    size is rejected, because it could be anything.
    """
    for places, absolute in ((SIZES, True), (FACTORS, False)):
        for name in (node.input[i] for i in places.get(node.op_type, ()) if i < len(node.input)):
            if not name or name in of_image:
                continue
            if name not in constants:
                raise _computed_size(node, where)
            # At most one more than any list of sizes has.
            values = [
                float(value)
                for value in numpy_helper.to_array(constants[name]).ravel()[: 2 * RANK + 1]
            ]
            if absolute:
                check_size(named(node), values, where)
            elif not max(map(abs, values), default=0) <= WINDOW_PX:
                raise ModelError(
                    f"{printable(named(node))} in {where} enlarges by {times(values)}, but the "
                    f"largest factor is {WINDOW_PX}. Export the network again."
                )
