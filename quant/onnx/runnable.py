"""Check that a runtime may open an ONNX file: operators of ONNX itself, and sizes within bounds.

`quant.untrusted` has checked the file's content before.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np
from onnx import AttributeProto, ModelProto, NodeProto

from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.quant.domains import INLINE, MICROSOFT, STANDARD, foreign_remedy, opset_of
from beers_deploy.quant.onnx.messages import constants
from beers_deploy.quant.untrusted import RANK, check_size, times

WINDOW_PX = 1024
"""The limit of kernel, stride, dilation or padding of a window, and of a factor of enlargement."""

ONNXRUNTIMES = {(MICROSOFT, "QLinearAdd"), (MICROSOFT, "QLinearMul")}
"""onnxruntime's own operators that this project writes."""

WINDOWS = {"kernel_shape", "strides", "dilations", "pads", "output_padding", "blocksize"}
SIZES = {"CenterCropPad": 1, "Expand": 1, "MaxUnpool": 2, "OneHot": 1, "Resize": 3}
"""Operators with an input that states the size of the result, and that input."""
FACTORS = {"Pad": 1, "Resize": 2, "Tile": 1, "Upsample": 1}
"""Operators with an input that states the enlargement, and that input."""
KEEPING = {
    "Cast",
    "DequantizeLinear",
    "Identity",
    "Neg",
    "QuantizeLinear",
    "RandomUniformLike",
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


def check_runnable(model: ModelProto, where: str) -> None:
    """Raise ModelError if a model is not safe or not possible to run.

    Its operators must be ONNX's own, or those of onnxruntime that this project writes, and no node
    may make a tensor of a size that the file does not bound.

    Args:
        model: the model, the content of which was checked.
        where: name of the network for the message, such as "a.onnx" or "the float network".
    """
    for function in model.functions:
        name = printable(f"{function.name} of {function.domain!r}")
        raise _not_of_onnx(f"{name}, a function that the file defines", where, INLINE)
    if model.graph.sparse_initializer:
        raise ModelError(
            f"{where} has sparse weights, which are not supported. Export it without them."
        )
    # Tensors that depend on the image are limited by its size. Those that depend only on constants
    # may have any size.
    arrays = constants(model)
    of_image = {value.name for value in model.graph.input} - arrays.keys()
    filled_values = 0
    for node in model.graph.node:
        _check_operator(node, where)
        _check_windows(node, where)
        _check_growth(node, arrays, of_image, where)
        if of_image.intersection(node.input):
            of_image.update(node.output)
        elif node.op_type != "Constant":
            if node.op_type in FILLING:
                filled_values += _filled(node, arrays, where)
                check_size("all filled constants", [filled_values], where)
            arrays |= _computed(node, arrays, opset_of(model), where)


def _filled(node: NodeProto, arrays: Mapping[str, np.ndarray], where: str) -> int:
    """Return the number of values to which a node fills a constant.

    Raises ModelError if the file does not state the size, or if it is too large.
    """
    source = arrays.get(node.input[0])
    sizes = arrays.get(node.input[-1])
    if source is None or sizes is None:
        raise _computed_size(node, where)
    sides = [int(size) for size in sizes.ravel()[: RANK + 1]]
    # One size or factor each, or fewer sizes for Expand, whose source then is as large.
    if node.op_type != "ConstantOfShape":
        dims = [1] * (len(sides) - source.ndim) + list(source.shape)
        if len(dims) == len(sides):
            sides = [abs(side) * dim for side, dim in zip(sides, dims, strict=True)]
    check_size(named(node), sides, where)
    return math.prod(max(side, 0) for side in sides)


LIST_VALUES = 4096
"""The maximum number of values of one list; a runtime computes with such lists in a moment."""

COMPUTED = (
    KEEPING
    | FILLING
    | {"Add", "Concat", "Div", "Equal", "Gather", "Mod", "Mul", "Shape", "Slice", "Sub", "Where"}
)
"""Operators whose results are computed if they are short lists of numbers."""

REDUCING = {"ReduceL2", "ReduceMean", "ReduceSum"}
NORMALIZING = REDUCING | {"Add", "Div", "MatMul", "Mul", "Pow", "Sub"}
"""Operators that torch's older exporter leaves of weights that are normalised, such as by
weight_norm or spectral_norm.
"""


def _computed(
    node: NodeProto, arrays: Mapping[str, np.ndarray], opset: int, where: str
) -> dict[str, np.ndarray]:
    """Compute the result of a node from short lists or weights; empty if it is neither.

    Exporters leave a dozen nodes to state four sizes. onnx's reference in Python computes them
    before a runtime opens the file. The resulting sizes are therefore checked like those that a
    file states. The caller has bounded the results of ConstantOfShape. Raises ModelError for a
    node whose result might be of any size.
    """
    values = [arrays.get(name) for name in node.input]
    is_short = all(value is not None and value.size <= LIST_VALUES for value in values)
    is_weight = node.op_type in NORMALIZING and _keeps_size(node.op_type, values)
    if (node.op_type in COMPUTED and is_short) or is_weight:
        # Importing it takes half a second, which only files that compute sizes should pay.
        from onnx.reference import ReferenceEvaluator

        # If the reference raises any error for a contradictory node, the value is not known.
        with np.errstate(all="ignore"), suppress(Exception):
            feeds = dict(zip(node.input, values, strict=True))
            evaluator = ReferenceEvaluator(node, opsets={"": opset})
            result = np.asarray(next(iter(evaluator.run(None, feeds))))
            if result.dtype.kind in "biuf" and (is_weight or result.size <= LIST_VALUES):
                return {node.output[0]: result}
    if node.op_type not in KEEPING | FILLING:
        raise ModelError(
            f"{printable(named(node))} in {where} reads constants only, but only operators on the "
            "image are supported here. Export it with dynamo=True, or save it through onnxruntime "
            "(optimized_model_filepath, ORT_ENABLE_BASIC), which folds its constants."
        )
    return {}


def _keeps_size(op_type: str, values: Sequence[np.ndarray | None]) -> bool:
    """Return True if arithmetic of constants gives no more numbers than the largest of them has."""
    arrays = [value for value in values if value is not None]
    if len(arrays) < len(values):
        return False
    if op_type in REDUCING:
        return True
    largest = max(array.size for array in arrays)
    if op_type == "MatMul":
        shared = math.prod(arrays[0].shape[-1:]) or 1
        return math.prod(array.size for array in arrays) <= largest * shared**2
    # Arrays that do not fit together are none that a runtime would accept.
    with suppress(ValueError):
        return np.broadcast(*arrays).size <= largest
    return False


def named(node: NodeProto) -> str:
    """Return the operator and the name of a node as text for a sentence, such as "Conv head"."""
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
    node: NodeProto, arrays: Mapping[str, np.ndarray], of_image: set[str], where: str
) -> None:
    """Raise ModelError if a node may enlarge too much.

    A size that the file stores is checked. A size that derives from the image is allowed. Any other
    size is rejected, because it could be anything.
    """
    for places, absolute in ((SIZES, True), (FACTORS, False)):
        place = places.get(node.op_type, len(node.input))
        name = node.input[place] if place < len(node.input) else ""
        if not name or name in of_image:
            continue
        if name not in arrays:
            raise _computed_size(node, where)
        # At most one more than any list of sizes has.
        values = [float(value) for value in arrays[name].ravel()[: 2 * RANK + 1]]
        if absolute:
            check_size(named(node), values, where)
        elif not max(map(abs, values), default=0) <= WINDOW_PX:
            raise ModelError(
                f"{printable(named(node))} in {where} enlarges by {times(values)}, but the "
                f"largest factor is {WINDOW_PX}. Export the network again."
            )
