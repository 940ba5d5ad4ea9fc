"""An onnxruntime session, set up once for the whole project."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort

from profiles.errors import ModelError


def open_session(model: Path | onnx.ModelProto, threads: int = 0, optimise: bool = True) -> ort.InferenceSession:
    """Open a model on the CPU; `threads` 0 takes every core, `optimise` False runs the graph as written.

    Raises:
        ModelError: onnxruntime refuses the model.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    if not optimise:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    source = model.SerializeToString() if isinstance(model, onnx.ModelProto) else str(model)
    name = "ONNX model" if isinstance(model, onnx.ModelProto) else str(model)
    try:
        return ort.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a class of its own for each status code
        got = " ".join(str(error).split())[:160]
        remedy = "give a file written by 'beers-deploy export' or 'beers-deploy quantize'"
        raise ModelError(name, expected="a model that onnxruntime runs", got=got, remedy=remedy) from error


def run(session: ort.InferenceSession, image: np.ndarray) -> np.ndarray:
    """Restore (N, 1, H, W) float32 in [0, 1] to the same shape."""
    return np.asarray(session.run(None, {session.get_inputs()[0].name: image})[0])
