"""What runs a network: onnxruntime by default, OpenVINO as an option."""

import hashlib
from dataclasses import dataclass
from functools import partial

import onnx
import onnxruntime as ort

from deploy.restore import Infer
from deploy.swath.openvino import open_openvino
from deploy.swath.options import Runtime
from profiles.errors import ModelError
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


@dataclass(frozen=True)
class Packed:
    """A network on its way to another process: an ONNX file's bytes, their digest, and how it is to be run."""

    content: bytes
    digest: str
    runtime: Runtime
    threads: int


def pack(model: onnx.ModelProto, runtime: Runtime, threads: int) -> Packed:
    """A network made ready to be sent."""
    content = model.SerializeToString()
    return Packed(content, hashlib.sha256(content).hexdigest(), runtime, threads)


def open_packed(packed: Packed) -> tuple[Infer, str]:
    """As `open_runtime`, where it arrived.

    Raises:
        ModelError: not as it was sent.
    """
    if hashlib.sha256(packed.content).hexdigest() != packed.digest:
        got, remedy = "others", "check the connection between the machines"
        raise ModelError("network", expected=f"bytes of digest {packed.digest[:12]}", got=got, remedy=remedy)
    return open_runtime(packed.runtime, onnx.load_model_from_string(packed.content), packed.threads)
