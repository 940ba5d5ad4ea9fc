"""MONAI's SlidingWindowInferer on one image, a turn for each line that comes in: `swath.py
--monai-python` runs it.

    python monai_child.py MODEL.onnx IN.tif OUT.tif TILE_PX OVERLAP THREADS

MONAI lives in an environment of its own, and the network runs on onnxruntime there as it does here.
Without the CPU build of torch, pip would fetch gigabytes of CUDA packages:

    python3 -m venv monai
    monai/bin/pip install torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu
    monai/bin/pip install monai==1.6.1 onnxruntime==1.31.1 tifffile

A turn opens the network, reads the whole image, restores it and writes it, and answers with its
seconds of the processor in JSON. Windows overlap by OVERLAP, a share of the tile, and are blended
with equal weights, as MONAI does unless told otherwise.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime as ort
import tifffile
import torch
from monai.inferers import SlidingWindowInferer

FULL_SCALE = np.float32(4095)


def main() -> None:
    """Wait for turns until the input ends."""
    model, source, out = sys.argv[1:4]
    tile_px = int(sys.argv[4])
    overlap = float(sys.argv[5])
    threads = int(sys.argv[6])
    torch.set_num_threads(threads)
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    inferer = SlidingWindowInferer((tile_px, tile_px), sw_batch_size=1, overlap=overlap)
    for _ in sys.stdin:
        before_s = time.process_time()
        session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        image = torch.from_numpy(tifffile.imread(source).astype(np.float32) / FULL_SCALE)[
            None, None
        ]
        with torch.inference_mode():
            restored = inferer(image, predictor(session))[0, 0].numpy()
        dn = np.rint(np.clip(restored * FULL_SCALE, 0, FULL_SCALE)).astype(np.uint16)
        packed: dict[str, Any] = {
            "compression": "zlib",
            "compressionargs": {"level": 1},
            "predictor": 2,
        }
        tifffile.imwrite(out, dn, tile=(256, 256), maxworkers=os.cpu_count(), **packed)
        print(json.dumps({"cpu_seconds": time.process_time() - before_s}), flush=True)


def predictor(session: ort.InferenceSession) -> Callable[[torch.Tensor], torch.Tensor]:
    """The network as MONAI calls it."""

    def predict(window: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(session.run(None, {"image": window.numpy()})[0])

    return predict


if __name__ == "__main__":
    main()
