"""Quantise one network our way or onnxruntime's: `int8_peers.py` runs it in a process of its own,
to see its memory.

    python int8_child.py WAY FLOAT PATCHES OUT     WAY: ours, minmax or percentile

PATCHES is an .npy file (K, C, H, W) of what the network takes. Writes OUT, and prints seconds and
peak resident memory as the last line, in JSON.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from beers_deploy.quant.graph import PLANES, PLANES_FRAC_BITS

STRIDE = 16
"""Patches that onnxruntime's calibration looks at together; with 64 at once the network of 16 x 64
takes 20 GB.
"""


def main() -> None:
    """Quantise and say what it took."""
    way = sys.argv[1]
    network, stored, out = map(Path, sys.argv[2:])
    started = time.perf_counter()
    if way == "ours":
        ours(network, np.load(stored), out)
    else:
        onnxruntimes(way, network, np.load(stored), out)
    seconds = time.perf_counter() - started
    print(json.dumps({"seconds": seconds, "peak_mb": peak_mb()}))


def ours(network: Path, images: np.ndarray, out: Path) -> None:
    """The host file of `quantize`, of these images (K, 1, H, W) in [0, 1]."""
    from beers_deploy.quant.quantize import quantize_model
    from beers_deploy.quant.samples.patches import Patches, Regenerated

    def image(number: int) -> np.ndarray:
        return images[number : number + 1]

    count = len(images)
    patches = Patches(Regenerated(lambda k: (image(k), image(k)), count), Regenerated(image, count))
    model = onnx.load(network)
    onnx.save(quantize_model(model, patches, {}).host, out)


def onnxruntimes(way: str, network: Path, inputs: np.ndarray, out: Path) -> None:
    """QDQ by `quantize_static`: per-channel int8 weights, asymmetric uint8 activations, float
    scales.

    By percentile its memory grows with the patches that it looks at together, so it gets STRIDE of
    them at a time: gigabytes all the same. The planes' scale is given: they are whole numbers of
    2^-7 by construction, and no statistics would find that out.
    """
    from onnxruntime import quantization as ort

    class Reader(ort.CalibrationDataReader):
        def __init__(self) -> None:
            self.rest = iter(inputs)

        def __len__(self) -> int:
            return len(inputs)

        def set_range(self, start_index: int, end_index: int) -> None:
            self.rest = iter(inputs[start_index:end_index])

        def get_next(self) -> dict[str, np.ndarray] | None:
            patch = next(self.rest, None)
            return None if patch is None else {name: patch[None]}

    name = onnx.load(network).graph.input[0].name
    unit = {
        "scale": np.array(2.0**-PLANES_FRAC_BITS, np.float32),
        "zero_point": np.array(128, np.uint8),
    }
    options: dict[str, Any] = {"CalibPercentile": 99.99, "CalibStridedMinMax": STRIDE}
    options |= (
        {"TensorQuantOverrides": {PLANES: [{**unit, "quant_type": ort.QuantType.QUInt8}]}}
        if name == PLANES
        else {}
    )
    method = {
        "minmax": ort.CalibrationMethod.MinMax,
        "percentile": ort.CalibrationMethod.Percentile,
    }[way]
    kinds = {
        "activation_type": ort.QuantType.QUInt8,
        "weight_type": ort.QuantType.QInt8,
        "per_channel": True,
    }
    ort.quantize_static(
        network, out, Reader(), calibrate_method=method, extra_options=options, **kinds
    )


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
