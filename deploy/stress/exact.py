"""The float network operation by operation in torch: float64 as the truth, bfloat16 as in training, gradients."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from deploy.restore import Infer
from quant.graph import CORRECTION, IMAGE, Add, Graph


def infer_in(graph: Graph, dtype: torch.dtype, sum_dtype: torch.dtype = torch.float64) -> Infer:
    """The image plus the graph's correction, the correction computed in `dtype`, the sum in `sum_dtype`.

    bfloat16 is what training computes in where autocast is on; the global add stays in float32 there.
    """

    def infer(image: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            restored = _as(image, sum_dtype) + _correction(graph, _as(image, dtype)).to(sum_dtype)
        return np.asarray(restored.numpy())

    return infer


def steepest_signs(graph: Graph, image: np.ndarray) -> np.ndarray:
    """The change (H, W) of -1, 0 or 1 that moves the middle pixel most, to first order: its gradient's signs."""
    pixels = _as(image, torch.float32)[None, None].requires_grad_()
    restored = pixels + _correction(graph, pixels)
    (gradient,) = torch.autograd.grad(restored[0, 0, image.shape[0] // 2, image.shape[1] // 2], pixels)
    return np.asarray(gradient[0, 0].sign().numpy())


def _correction(graph: Graph, image: Tensor) -> Tensor:
    tensors = {IMAGE: image}
    for op in graph:
        if isinstance(op, Add):
            tensors[op.output] = tensors[op.inputs[0]] + tensors[op.inputs[1]]
            continue
        weight, bias = (_as(values, image.dtype) for values in (op.weight, op.bias))
        result = conv2d(tensors[op.input], weight, bias, padding=op.pad_px)
        tensors[op.output] = torch.relu(result) if op.relu else result
    return tensors[CORRECTION]


def _as(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).to(dtype)
