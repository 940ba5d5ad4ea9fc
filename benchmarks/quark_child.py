"""Quantise one ONNX file with AMD Quark: `int8_peers.py` runs it in Quark's own environment.

Imports nothing of ours.

    PYTHON quark_child.py FLOAT PATCHES OUT HOW
    PYTHON quark_child.py adjust FILE

FLOAT is a float ONNX file, PATCHES an .npy file (K, C, H, W) of what its input takes. HOW is vint8,
as AMD's tutorials of the VEK385 ask for it, or the iterations of AdaRound under XINT8, 0 for none.
Writes OUT, and prints seconds and peak resident memory as the last line, in JSON. `adjust` says how
many scales of a VINT8 file Quark's adjuster moves, and of how many convolutions it does not find
the scales.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader
from onnxruntime.quantization.onnx_model import ONNXModel
from quark.onnx import AdaRoundConfig, ModelQuantizer, QConfig, QLayerConfig, XInt8Spec
from quark.onnx.postprocess.refinement.refine import QuantPosManager, adjust_quantize_info
from quark.onnx.quantization.config import Config, get_default_config


class Reader(CalibrationDataReader):
    """One patch after the other, and again from the first once rewound."""

    def __init__(self, name: str, patches: np.ndarray) -> None:
        self.name = name
        self.patches = patches
        self.rewind()

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next patch, or None."""
        patch = next(self.rest, None)
        return None if patch is None else {self.name: patch[None]}

    def rewind(self) -> None:
        """Begin again."""
        self.rest = iter(self.patches)


def main() -> None:
    """Quantise and say what it took, or look at a file."""
    if sys.argv[1] == "adjust":
        print(json.dumps(adjusted(onnx.load(sys.argv[2]))))
        return
    network, patches, out, how = sys.argv[1:]
    reader = Reader(onnx.load(network).graph.input[0].name, np.load(patches))
    started = time.perf_counter()
    ModelQuantizer(config_of(how)).quantize_model(network, out, reader)
    seconds = time.perf_counter() - started
    print(json.dumps({"seconds": seconds, "peak_mb": peak_mb()}))


def config_of(how: str) -> QConfig | Config:
    """What Quark is asked for."""
    if how == "vint8":
        preset = get_default_config("VINT8")
        preset.enable_npu_cnn = True
        preset.extra_options["UseRandomData"] = False
        return Config(global_quant_config=preset)
    finetuning = [AdaRoundConfig(num_iterations=int(how))] if int(how) else []
    return QConfig(QLayerConfig(activation=XInt8Spec(), weight=XInt8Spec()), algo_config=finetuning)


def adjusted(model: onnx.ModelProto) -> dict[str, int]:
    """Scales that the adjuster moves, and convolutions whose scales it does not find, by their
    counts.
    """
    positions = QuantPosManager(ONNXModel(model))
    constants = model.graph.initializer
    before = {tensor.name: tensor.SerializeToString() for tensor in constants}
    finders = positions.get_ipos_name, positions.get_wpos_name, positions.get_opos_name
    convolutions = [node for node in model.graph.node if node.op_type in ("Conv", "ConvTranspose")]
    unseen = sum(any(find(node) is None for find in finders) for node in convolutions)
    adjust_quantize_info(ONNXModel(model))
    changed = sum(tensor.SerializeToString() != before[tensor.name] for tensor in constants)
    return {"moved": changed, "unseen": unseen, "convolutions": len(convolutions)}


def peak_mb() -> float:
    """Largest resident memory of this process; getrusage would count that of its parent before it
    too.
    """
    status = dict(
        line.split(":", 1)
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    )
    return int(status["VmHWM"].split()[0]) * 1024 / 1e6


if __name__ == "__main__":
    main()
