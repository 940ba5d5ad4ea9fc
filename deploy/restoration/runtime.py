"""The runtimes of a network: onnxruntime by default, OpenVINO as an option, with the same int8
results.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import version
from threading import Lock, get_ident
from typing import Any, Literal

import numpy as np
import onnx
import onnxruntime as ort
from onnx import helper, numpy_helper

from beers_deploy.model.processor import asked, require_cores
from beers_deploy.profiles.errors import ModelError, optional, reason_of
from beers_deploy.quant.kernels import with_exact_sums
from beers_deploy.quant.onnx_file import is_quantized, parse_onnx
from beers_deploy.quant.session import open_session, tensors_of
from beers_deploy.restoration.cluster import Cluster

Runtime = Literal["onnxruntime", "openvino"]
"""The library that runs a network."""

Infer = Callable[[np.ndarray], np.ndarray]
"""A network ready to run. It maps (1, C, h, w) float32 in [0, 1] to its result, of the shape that
its file states.
"""


@dataclass(frozen=True)
class Engine:
    """The library that runs the networks of a restoration, with its threads and machines.

    Attributes:
        runtime: the library that runs a network.
        threads: the number of threads of the runtime. 0 uses every core of this machine, or one
            thread for each call that a worker of a Dask scheduler runs.
        scheduler: the address of a Dask scheduler whose workers run the networks; None runs them on
            this machine.
    """

    runtime: Runtime = "onnxruntime"
    threads: int = 0
    scheduler: str | None = None

    def __post_init__(self) -> None:
        # It is not known here how many threads a worker of a scheduler may use.
        if self.scheduler is None:
            require_cores("threads", self.threads)

    def packed(self, model: onnx.ModelProto) -> "Packed":
        """Return a network in a form that can be sent to the workers of a Dask scheduler. It runs
        there with `threads` threads, or with one if `threads` is 0.
        """
        return Packed(model.SerializeToString(), self.runtime, self.threads or 1)


LOWEST = "openvino.lowest_uint8"


def open_openvino(model: onnx.ModelProto, threads: int, at_once: int = 1) -> tuple[Infer, str]:
    """Open a network on OpenVINO, with int8 results that equal those of onnxruntime.

    Args:
        model: the network.
        threads: the number of threads of all callers together; 0 uses every core.
        at_once: the number of callers that run the network at the same time.

    Returns:
        The network ready to run, and the runtime's name and version.

    Raises:
        MissingExtraError: OpenVINO is not installed.
        ModelError: at the first run, if OpenVINO cannot run the network.
    """
    openvino = optional("openvino", "runtime")
    # This fills a table. Two threads that call it first at the same time deadlock (2026.4).
    openvino.Type.f32.to_dtype()
    core = openvino.Core()
    # Without the hint OpenVINO rounds to bfloat16 where the processor has units for it.
    options = {
        "INFERENCE_PRECISION_HINT": "f32",
        "NUM_STREAMS": str(at_once),
        "ENABLE_CPU_PINNING": False,
    }
    options |= {"INFERENCE_NUM_THREADS": str(threads)} if threads else {}
    exact = model if not is_quantized(model) or _adds_exactly(core) else with_exact_sums(model)
    content = saturating_adds(exact).SerializeToString()

    @lru_cache(maxsize=2)
    def compiled(shape: tuple[int, ...]) -> Any:
        try:
            network = core.read_model(content)
            network.reshape(list(shape))
            return core.compile_model(network, "CPU", options)
        except RuntimeError as error:
            reason = reason_of(error)
            raise ModelError(
                f"OpenVINO does not run the network: {reason}. Use `runtime` onnxruntime."
            ) from error

    compiling = Lock()

    @lru_cache(maxsize=64)
    def request(shape: tuple[int, ...], _thread: int) -> Any:
        # Without the lock each thread would compile a network of its own at the first tile.
        with compiling:
            # A request serves one thread at a time.
            return compiled(shape).create_infer_request()

    def infer(image: np.ndarray) -> np.ndarray:
        return np.asarray(request(image.shape, get_ident()).infer([image], share_inputs=True)[0])

    return infer, f"openvino {version('openvino')}"


@lru_cache(maxsize=1)
def _adds_exactly(core: Any) -> bool:
    def convolve(model: bytes, image: np.ndarray) -> np.ndarray:
        network = core.compile_model(core.read_model(model), "CPU")
        return np.asarray(network.create_infer_request().infer([image])[0])

    return asked("openvino", convolve)


def saturating_adds(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a quantised model for OpenVINO, in which each QLinearAdd is replaced by
    DequantizeLinear, Add and QuantizeLinear.

    OpenVINO's own QLinearAdd wraps around where it should saturate (256 becomes 0). The three
    operators saturate, but OpenVINO fuses them with a convolution before them, which loses the
    rounding between the two. A Max with 0, which changes no uint8, prevents the fusion. The result
    equals onnxruntime's bit for bit (measured).
    """
    expanded = onnx.ModelProto()
    expanded.CopyFrom(model)
    expanded.graph.initializer.append(numpy_helper.from_array(np.array(0, np.uint8), LOWEST))
    del expanded.graph.node[:]
    for node in model.graph.node:
        if node.op_type != "QLinearAdd":
            expanded.graph.node.append(node)
            continue
        name = node.output[0]
        # Inputs of QLinearAdd: value, scale and zero point of A and of B, then those of the result.
        for side, (value, *scale) in {"a": node.input[:3], "b": node.input[3:6]}.items():
            # Max with 0 changes no uint8, but prevents OpenVINO from fusing the convolution into
            # the add, which would lose the rounding between the two.
            expanded.graph.node.extend(
                [
                    helper.make_node("Max", [value, LOWEST], [f"{name}.{side}"]),
                    helper.make_node(
                        "DequantizeLinear", [f"{name}.{side}", *scale], [f"{name}.{side}_real"]
                    ),
                ]
            )
        expanded.graph.node.extend(
            [
                helper.make_node("Add", [f"{name}.a_real", f"{name}.b_real"], [f"{name}.sum"]),
                helper.make_node("QuantizeLinear", [f"{name}.sum", *node.input[6:8]], [name]),
            ]
        )
    return expanded


AT_ONCE = 4
"""The largest number of tiles in work at a time.

Each tile needs the memory of a network's maps, and the gain is about 4 %.
"""


def tiles_at_once(threads: int, tiles: int) -> int:
    """Return the number of tiles to restore at a time: at most `AT_ONCE`, and a divisor of the
    number of threads, so that each tile has the same number of them.

    Args:
        threads: the number of threads; 0 stands for one for each core.
        tiles: the number of tiles of the image, which the result does not exceed.
    """
    cores = threads or os.cpu_count() or 1
    return max(
        count for count in range(1, AT_ONCE + 1) if cores % count == 0 and count <= max(tiles, 1)
    )


def open_runtime(
    runtime: Runtime, model: onnx.ModelProto, threads: int, at_once: int = 1
) -> tuple[Infer, str]:
    """Open a network with the library that the user chooses.

    Args:
        runtime: the library that runs the network.
        model: the network.
        threads: the number of threads of all callers together; 0 uses every core.
        at_once: the number of callers that run the network at the same time and share the threads.

    Returns:
        The network ready to run, and the runtime's name and version.

    Raises:
        OptionError: this machine has fewer cores than `threads`.
        ModelError: the runtime cannot run the network.
    """
    require_cores("threads", threads)
    if runtime == "openvino":
        return open_openvino(model, threads, at_once)
    session = open_session(model, session_threads(threads, at_once))
    return lambda image: tensors_of(session, None, image)[0], f"onnxruntime {ort.__version__}"


def session_threads(threads: int, at_once: int) -> int:
    """Return the number of threads to request from onnxruntime.

    Of n requested threads, onnxruntime starts n - 1, which all callers share, and each caller adds
    its own thread. The threads of all callers together are then as many as the user allows.

    Args:
        threads: the number of threads that the user allows; 0 stands for one for each core.
        at_once: the number of callers that run the network at the same time.
    """
    return (threads or os.cpu_count() or 1) - at_once + 1 if at_once > 1 else threads


def at_first_call(open_network: Callable[[], tuple[Infer, str]]) -> Infer:
    """Return a network that is opened when it is first run, and stays open. Versions of a network
    for other exposures are opened in this way, because few images need all of them.

    Args:
        open_network: returns the network ready to run, and the name of the runtime.
    """
    opened = cache(open_network)
    opening = Lock()

    def infer(image: np.ndarray) -> np.ndarray:
        # Without the lock each thread would open a network of its own.
        with opening:
            network, _ = opened()
        return network(image)

    return infer


@dataclass(frozen=True)
class Packed:
    """A network as it is sent to the workers of a Dask scheduler. Each process opens it once, at
    its first call.

    Attributes:
        content: the bytes of the network's ONNX file.
        runtime: the library that runs the network.
        threads: the number of threads of the runtime in each process.
    """

    content: bytes
    runtime: Runtime
    threads: int

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Run the network on (1, C, h, w) float32 in [0, 1], and return its result."""
        # Without the lock each thread would open a network of its own.
        with _opening:
            infer = _opened(self)
        return infer(image)


NETWORKS_IN_MEMORY = 32
_opening = Lock()


@lru_cache(maxsize=NETWORKS_IN_MEMORY)
def _opened(packed: Packed) -> Infer:
    network = parse_onnx(packed.content, "network")
    return open_runtime(packed.runtime, network, packed.threads)[0]


def infer_on(cluster: Cluster, engine: Engine, model: onnx.ModelProto) -> Infer:
    """Return a network, ready to run, that the workers of a cluster run.

    The network is sent to them once. Each call of the returned function sends a tile and waits for
    its result.

    Args:
        cluster: the workers of a Dask scheduler.
        engine: the runtime and the number of threads on a worker.
        model: the network.
    """
    shared = cluster.share(engine.packed(model))
    return lambda image: cluster.result(cluster.pool.submit(Packed.__call__, shared, image))
