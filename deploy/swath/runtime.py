"""What runs a network: onnxruntime by default, OpenVINO as an option."""

from functools import partial

import onnx
import onnxruntime as ort

from deploy.restore import Infer
from deploy.swath.openvino import open_openvino
from deploy.swath.options import Runtime
from quant.session import open_session, run


def open_runtime(runtime: Runtime, model: onnx.ModelProto, threads: int) -> tuple[Infer, str]:
    """A network ready to run, and the runtime's name and version; `threads` 0 takes every core.

    Raises:
        MachineError: the runtime is not installed.
        ModelError: it refuses the model.
    """
    if runtime is Runtime.openvino:
        return open_openvino(model, threads)
    return partial(run, open_session(model, threads)), f"onnxruntime {ort.__version__}"
