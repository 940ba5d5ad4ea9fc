"""The small networks of `benchmarks/small_networks.py`, and their INT8 files.

    PYTHONPATH=. python tests/golden/small_networks.py

trains them briefly and writes their weights to `small_networks.safetensors`, in 16 bits. They are
stored because training on another processor gives other weights, and so other integers.
"""

import sys
from pathlib import Path

import numpy as np
from safetensors.torch import load_file, save_file

from beers_deploy import quantize
from beers_deploy.quant.onnx_file import save_onnx
from benchmarks.small_networks import NETWORKS, Drawn, save, slug, trained

WEIGHTS = Path(__file__).with_suffix(".safetensors")
STEPS = 30
SIDE_PX = 32
SAMPLES = 2
"""Number of calibration samples: few and small, so that all networks take half a minute."""


def save_weights() -> None:
    """Train all networks, and write their weights."""
    tensors = {}
    for name in NETWORKS:
        for key, value in trained(name, None, STEPS).state_dict().items():
            tensors[f"{slug(name)}.{key}"] = value.half().contiguous()
        sys.stdout.write(f"{name}\n")
    save_file(tensors, WEIGHTS)


def quantized(name: str, folder: Path) -> Path:
    """Quantize the network of that name, and return the INT8 file."""
    kind, make = NETWORKS[name]
    prefix = f"{slug(name)}."
    tensors = {
        key.removeprefix(prefix): value.float()
        for key, value in load_file(WEIGHTS).items()
        if key.startswith(prefix)
    }
    network = make()
    network.load_state_dict(tensors)
    side_px = SIDE_PX // (2 if kind == "espcn" else 1)
    path = folder / f"{slug(name)}.onnx"
    save(network.eval(), side_px, path)
    samples = Drawn.of(kind, None, 5, 1).images[:SAMPLES, :, :side_px, :side_px]
    int8 = path.with_suffix(".int8.onnx")
    save_onnx(quantize(path, samples=np.ascontiguousarray(samples), progress=False).model, int8)
    return int8


if __name__ == "__main__":
    save_weights()
