"""Networks on OpenVINO, with the same int8 numbers as on onnxruntime."""

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from threading import Lock, get_ident
from typing import Any, Literal

import numpy as np
import onnx
from onnx import helper, numpy_helper

from model.processor import asked
from profiles.errors import MachineError, ModelError
from quant.kernels import is_integer, made_exact

LOWEST = "openvino.lowest_uint8"


Precision = Literal["f32", "bf16"]


def open_openvino(
    model: onnx.ModelProto, threads: int, precision: Precision = "f32", at_once: int = 1
) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
    """A callable (1, 1, h, w) float32 -> (1, 1, h, w) for `at_once` callers, and the runtime's name and version.

    Raises:
        MachineError: OpenVINO is not installed, or this processor does not compute in that precision.
        ModelError: OpenVINO refuses the model.
    """
    core = _core()
    if precision == "bf16" and "BF16" not in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
        remedy = "run it on a processor that has them"
        raise MachineError("bfloat16", expected="a processor with bfloat16 units", got="none", remedy=remedy)
    # Said aloud: where the processor has bfloat16 units, OpenVINO would round to it unasked.
    options = {"INFERENCE_PRECISION_HINT": precision, "NUM_STREAMS": str(at_once), "ENABLE_CPU_PINNING": False}
    options |= {"INFERENCE_NUM_THREADS": str(threads)} if threads else {}
    content = saturating_adds(_exact(model, core)).SerializeToString()

    @lru_cache(maxsize=2)
    def compiled(shape: tuple[int, ...]) -> Any:
        try:
            network = core.read_model(content)
            network.reshape(list(shape))
            return core.compile_model(network, "CPU", options)
        except RuntimeError as error:
            got, remedy = " ".join(str(error).split())[:160], "use --runtime onnxruntime"
            raise ModelError("ONNX model", expected="one that OpenVINO runs", got=got, remedy=remedy) from error

    compiling = Lock()

    @lru_cache(maxsize=64)
    def request(shape: tuple[int, ...], _thread: int) -> Any:
        with compiling:  # or each thread would compile its own at the first tile
            return compiled(shape).create_infer_request()  # one serves no two threads at once

    def infer(image: np.ndarray) -> np.ndarray:
        return np.asarray(request(image.shape, get_ident()).infer([image], share_inputs=True)[0])

    return infer, f"openvino {version('openvino')}"


def _exact(model: onnx.ModelProto, core: Any) -> onnx.ModelProto:
    """The model as this processor's kernels add it exactly."""
    return model if not is_integer(model) or _adds_exactly(core) else made_exact(model)[0]


@lru_cache(maxsize=1)
def _adds_exactly(core: Any) -> bool:
    def convolve(model: bytes, image: np.ndarray) -> np.ndarray:
        return np.asarray(core.compile_model(core.read_model(model), "CPU").create_infer_request().infer([image])[0])

    return asked("openvino", convolve)


def _core() -> Any:  # openvino.Core, an optional package
    try:
        return import_module("openvino").Core()
    except ImportError as error:
        got, remedy = "no package openvino", "pip install 'beers-deploy[openvino]'"
        raise MachineError("--runtime", expected="OpenVINO installed", got=got, remedy=remedy) from error


def saturating_adds(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with every QLinearAdd spelt as dequantise, add, quantise.

    OpenVINO's own QLinearAdd wraps around where it should saturate (256 becomes 0). Spelt out it saturates, but a
    convolution before it is fused with it, and the rounding between the two is lost; taking the larger of the value
    and 0, which changes no uint8, keeps them apart. Measured: equal to onnxruntime bit for bit.
    """
    spelt = onnx.ModelProto()
    spelt.CopyFrom(model)
    spelt.graph.initializer.append(numpy_helper.from_array(np.array(0, np.uint8), LOWEST))
    del spelt.graph.node[:]
    for node in model.graph.node:
        spelt.graph.node.extend(_spelt_out(node) if node.op_type == "QLinearAdd" else [node])
    return spelt


def _spelt_out(add: onnx.NodeProto) -> list[onnx.NodeProto]:
    (a, *a_scale), (b, *b_scale), scale = add.input[0:3], add.input[3:6], add.input[6:8]
    name = add.output[0]
    return [
        helper.make_node("Max", [a, LOWEST], [f"{name}.a"]),
        helper.make_node("Max", [b, LOWEST], [f"{name}.b"]),
        helper.make_node("DequantizeLinear", [f"{name}.a", *a_scale], [f"{name}.a_real"]),
        helper.make_node("DequantizeLinear", [f"{name}.b", *b_scale], [f"{name}.b_real"]),
        helper.make_node("Add", [f"{name}.a_real", f"{name}.b_real"], [f"{name}.sum"]),
        helper.make_node("QuantizeLinear", [f"{name}.sum", *scale], [name]),
    ]
