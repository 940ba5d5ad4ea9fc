"""What runs a network: onnxruntime by default, OpenVINO as an option."""

import hashlib
import os
from dataclasses import dataclass
from functools import partial

import onnx
import onnxruntime as ort

from deploy.cores import require_cores
from deploy.restore import Infer
from deploy.swath.openvino import open_openvino
from deploy.swath.options import Runtime
from profiles.errors import ModelError
from quant.onnx_file import parse_onnx
from quant.session import open_session, run

AT_ONCE = 4
"""Most tiles in work at a time. Each needs the memory of a network's maps, and some 4 % are gained by it."""


def tiles_at_once(threads: int, tiles: int) -> int:
    """How many tiles are best restored at a time; 0 threads takes every core."""
    cores = threads or os.cpu_count() or 1
    return max(count for count in range(1, AT_ONCE + 1) if cores % count == 0 and count <= max(tiles, 1))


def open_runtime(runtime: Runtime, model: onnx.ModelProto, threads: int, at_once: int = 1) -> tuple[Infer, str]:
    """A network ready to run, and the runtime's name and version.

    Args:
        runtime: which.
        model: the network.
        threads: in all; 0 takes every core.
        at_once: how many callers share the threads.

    Raises:
        MachineError: the runtime is not installed.
        ModelError: it refuses the model.
        OptionError: more threads than cores.
    """
    require_cores("--threads", threads)
    if runtime is Runtime.openvino:
        return open_openvino(model, threads, at_once=at_once)
    return partial(run, open_session(model, session_threads(threads, at_once))), f"onnxruntime {ort.__version__}"


def session_threads(threads: int, at_once: int) -> int:
    """What to ask onnxruntime for: its n are n - 1 of its own, which all callers share, and each caller."""
    return (threads or os.cpu_count() or 1) - at_once + 1 if at_once > 1 else threads


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
    return open_runtime(packed.runtime, parse_onnx(packed.content, "network"), packed.threads)
