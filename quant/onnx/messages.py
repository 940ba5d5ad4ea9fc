"""Read constants and sizes from the messages of an ONNX file, edit repeated fields, and find free
names.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, TypeProto, helper, numpy_helper

from beers_deploy.quant.domains import functions_of, operator_name


def constants(model: ModelProto) -> dict[str, np.ndarray]:
    """Return the constants of a model by name: initializers, and the values of Constant nodes."""
    arrays = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    functions = functions_of(model)
    for node in model.graph.node:
        if operator_name(node, functions) == "Constant" and node.attribute:
            value = helper.get_attribute_value(node.attribute[0])
            if isinstance(value, TensorProto):
                value = numpy_helper.to_array(value)
            # Exporters may store numbers as such: value_float, value_ints.
            kind = np.float32 if "float" in node.attribute[0].name else None
            arrays[node.output[0]] = np.asarray(value, kind)
    return arrays


def sizes_of(tensor: TypeProto.Tensor) -> tuple[int, ...]:
    """Return the sizes that ONNX's type of a tensor states; 0 for a size that is not stated."""
    return tuple(dim.dim_value for dim in tensor.shape.dim)


def replace_all(field: Any, messages: Iterable[Any]) -> None:
    """Replace all messages of a repeated field, such as the nodes of a graph.

    Args:
        field: the field, which is changed in place.
        messages: the new messages, which may be some of the old ones.
    """
    new = list(messages)
    del field[:]
    field.extend(new)


def free_name(name: str, taken: dict[str, int]) -> str:
    """Return a name that is not in use, and mark it as used.

    Args:
        name: the name to use; a suffix is added if it is in use.
        taken: the number of names that were derived from each used name. It is changed.
    """
    candidate = name
    while candidate in taken:
        taken[name] += 1
        candidate = f"{name}_{taken[name] if taken[name] > 1 else ''}"
    taken[candidate] = 0
    return candidate
