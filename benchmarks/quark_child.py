"""Quantise one ONNX file with AMD Quark: `int8_peers.py` runs it in Quark's own environment. Imports nothing of ours.

    PYTHON quark_child.py FLOAT PATCHES OUT ADAROUND_ITERATIONS

FLOAT is a float ONNX file, PATCHES an .npy file (K, C, H, W) of what its input takes; 0 iterations leave AdaRound
out. Writes OUT, and prints seconds and peak resident memory as the last line, in JSON.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader
from quark.onnx import AdaRoundConfig, ModelQuantizer, QConfig, QLayerConfig, XInt8Spec


class Reader(CalibrationDataReader):
    """One patch after the other, and again from the first once rewound."""

    def __init__(self, name: str, patches: np.ndarray) -> None:
        self.name, self.patches = name, patches
        self.rewind()

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next patch, or None."""
        patch = next(self.rest, None)
        return None if patch is None else {self.name: patch[None]}

    def rewind(self) -> None:
        """Begin again."""
        self.rest = iter(self.patches)


def main() -> None:
    """Quantise and say what it took."""
    network, patches, out, iterations = sys.argv[1:]
    reader = Reader(onnx.load(network).graph.input[0].name, np.load(patches))
    finetuning = [AdaRoundConfig(num_iterations=int(iterations))] if int(iterations) else []
    config = QConfig(QLayerConfig(activation=XInt8Spec(), weight=XInt8Spec()), algo_config=finetuning)
    started = time.perf_counter()
    ModelQuantizer(config).quantize_model(network, out, reader)
    seconds = time.perf_counter() - started
    print(json.dumps({"seconds": seconds, "peak_mb": peak_mb()}))


def peak_mb() -> float:
    """Largest resident memory of this process; getrusage would count that of its parent before it too."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines())
    return int(status["VmHWM"].split()[0]) * 1024 / 1e6


if __name__ == "__main__":
    main()
