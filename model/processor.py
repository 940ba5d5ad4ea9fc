"""Identify this machine's processor, and test how the kernels of the installed runtimes compute.

The name has no effect. Lists of CPU features are not used either: an emulator shows those of its
host, other systems show none, and a runtime may not use them. Each question is therefore a tiny
computation with a known result, run at most once per process when it is needed.
"""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from beers_deploy.profiles.errors import OptionError

if TYPE_CHECKING:
    import numpy as np

CHANNELS = 32
SIDE_PX = 3
ACTIVATION = 255
WEIGHT = 127
"""Two neighbouring products of this weight sum to 64 770, twice the range of int16."""
RESULT = 200
"""The 8-bit result of the sum of a whole window."""

_decided: dict[str, str] = {}


def decided() -> dict[str, str]:
    """Return what this process has found out about its processor, for the log of a run.

    A key names the question, such as "int8 on onnxruntime"; its value is the answer in words.
    """
    return dict(_decided)


Convolve = Callable[[bytes, "np.ndarray"], "np.ndarray"]
"""A function that runs an ONNX model, given as bytes, on an image (1, C, H, W) uint8."""


@lru_cache(maxsize=1)
def int8_adds_exactly() -> bool:
    """Return True if onnxruntime adds products of uint8 and int8 without saturation;
    see `asked`.
    """

    def convolve(model: bytes, image: "np.ndarray") -> "np.ndarray":
        import numpy as np
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        return np.asarray(session.run(None, {"image": image})[0])

    return asked("onnxruntime", convolve)


def asked(runtime: str, convolve: Convolve) -> bool:
    """Return True if a runtime's integer convolutions add without saturation.

    x86 kernels without VNNI add pairs of products of uint8 and int8 in saturating int16. They
    return half of the sum of the largest numbers, with which this is tested.
    """
    import numpy as np
    from onnx import TensorProto, helper, numpy_helper

    # One window over the whole image, with all weights at their maximum and the sum scaled to
    # RESULT.
    weight = np.full((CHANNELS, CHANNELS, SIDE_PX, SIDE_PX), WEIGHT, np.int8)
    values = {
        "one": np.float32(1),
        "zero": np.uint8(0),
        "weight": weight,
        "signed_zero": np.int8(0),
        "scale": np.float32(ACTIVATION * WEIGHT * weight[0].size / RESULT),
    }
    feeds = ["image", "one", "zero", "weight", "one", "signed_zero", "scale", "zero"]
    ends = [
        helper.make_tensor_value_info(name, TensorProto.UINT8, [1, CHANNELS, px, px])
        for name, px in (("image", SIDE_PX), ("result", 1))
    ]
    constants = [numpy_helper.from_array(np.asarray(value), name) for name, value in values.items()]
    node = helper.make_node("QLinearConv", feeds, ["result"])
    graph = helper.make_graph([node], "largest", ends[:1], ends[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    image = np.full((1, CHANNELS, SIDE_PX, SIDE_PX), ACTIVATION, np.uint8)
    exact = bool((convolve(model.SerializeToString(), image) == RESULT).all())
    words = "add exactly" if exact else "saturate; layers are computed in ways that do not"
    _decided[f"int8 on {runtime}"] = f"its kernels {words}"
    return exact


COMM = Path("/proc/self/comm")
CPUINFO = Path("/proc/cpuinfo")
"""On Linux, the description of the processor: one block of lines per core."""
WINDOWS_KEY = r"HARDWARE\DESCRIPTION\System\CentralProcessor\0"


@lru_cache(maxsize=1)
def processor_name() -> str | None:
    """Return the name of the processor, such as "AMD EPYC 7763 64-Core Processor" or "Apple M2".

    None if the system states no name, and under user-mode emulation, where the stated name is that
    of the host's processor.
    """
    system = platform.system()
    name = ""
    try:
        if system == "Linux":
            name = _linux_name()
        elif system == "Darwin":
            command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            name = subprocess.run(  # noqa: S603
                command, capture_output=True, encoding="utf-8", timeout=5, check=True
            ).stdout
        elif sys.platform == "win32":
            import winreg

            with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, WINDOWS_KEY) as key:
                name = str(winreg.QueryValueEx(key, "ProcessorNameString")[0])
    except (OSError, subprocess.SubprocessError):
        return None
    return " ".join(name.split()) or None


def _linux_name() -> str:
    # User-mode emulation shows the name of the processor beneath the emulated one.
    if COMM.read_text(encoding="utf-8", errors="replace").startswith("qemu-"):
        return ""
    text = CPUINFO.read_text(encoding="utf-8", errors="replace")
    # Large and small cores differ in name. ARM's kernel knows numbers alone.
    for key, prefix in (("model name", ""), ("CPU part", "ARM part ")):
        names = re.findall(rf"^{key}[ \t]*:[ \t]*(\S.*)$", text, re.MULTILINE)
        if names:
            return prefix + ", ".join(dict.fromkeys(map(str.strip, names)))
    return ""


SEEDS = 2**62
"""The largest seed: torch accepts 64 bits, and other draws of a run add to it."""


def require_cores(option: str, asked: int) -> None:
    """Raise OptionError if more threads or processes are requested than this machine has logical
    cores.

    0 stands for the option's default.
    """
    cores = os.cpu_count() or 1
    if not 0 <= asked <= cores:
        raise OptionError(
            f"`{option}` must be 0 to {cores}, the cores of this machine, got {asked}. Leave it "
            "out for the default."
        )
