"""Quantise one ONNX file to XINT8 with AMD Quark. `int8_peers.py` runs this script in Quark's
environment.

    PYTHON quark_child.py FLOAT SAMPLES OUT ADAROUND_STEPS

The script imports nothing of this project. SAMPLES is an .npy file (K, C, H, W) of images. With 0
steps there is no AdaRound.
"""

import sys

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader
from quark.onnx import AdaRoundConfig, ModelQuantizer, QConfig, QLayerConfig, XInt8Spec


class Reader(CalibrationDataReader):
    """A reader that returns one sample after the other, and starts again once it is rewound."""

    def __init__(self, name: str, samples: np.ndarray) -> None:
        self.name = name
        self.samples = samples
        self.rewind()

    def get_next(self) -> dict[str, np.ndarray] | None:
        """Return the next sample, or None after the last one."""
        sample = next(self.rest, None)
        return None if sample is None else {self.name: sample[None]}

    def rewind(self) -> None:
        """Start again from the first sample."""
        self.rest = iter(self.samples)


def main() -> None:
    """Quantise the file with the arguments of the command line."""
    network, samples, out, steps = sys.argv[1:]
    rounding = [AdaRoundConfig(num_iterations=int(steps))] if int(steps) else []
    layers = QLayerConfig(activation=XInt8Spec(), weight=XInt8Spec())
    reader = Reader(onnx.load(network).graph.input[0].name, np.load(samples))
    ModelQuantizer(QConfig(layers, algo_config=rounding)).quantize_model(network, out, reader)


if __name__ == "__main__":
    main()
