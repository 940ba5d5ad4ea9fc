"""Run a board's file in Eclipse Aidge: MODEL.onnx PLANES.npy RESULT.npy.

It runs in Aidge's own environment (see `benchmarks.executors`), so it imports nothing of ours.
"""

import sys

import aidge_backend_cpu  # noqa: F401 - registers the kernels
import aidge_core
import aidge_onnx
import numpy as np


def main(model: str, planes: str, result: str) -> None:
    """Compute each tile of the planes (N, P, H, W) separately, because the file has a batch of
    one.
    """
    tiles = np.load(planes)
    graph = aidge_onnx.load_onnx(model)
    graph.set_backend("cpu")
    graph.set_datatype(aidge_core.dtype.float32)
    graph.forward_dims([tiles[:1].shape], True)
    scheduler = aidge_core.SequentialScheduler(graph)
    outputs = []
    for tile in tiles:
        tensor = aidge_core.Tensor(np.ascontiguousarray(tile[None]))
        tensor.set_backend("cpu")
        scheduler.forward(data=[tensor])
        (last,) = graph.get_output_nodes()
        outputs.append(np.array(last.get_operator().get_output(0)))
    np.save(result, np.concatenate(outputs))


if __name__ == "__main__":
    main(*sys.argv[1:])
