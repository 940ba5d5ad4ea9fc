"""A transposed convolution as an ordinary one: each of its output lattice's phases sees a part of the kernel."""

import numpy as np


def phases(weight: np.ndarray, stride: int) -> tuple[np.ndarray, int]:
    """The weights (stride^2 O, I, J, J) of a transposed convolution's phases, and their padding, J - 1.

    Output row q stride + f takes x[q - j] w[f + stride j]: a convolution over rows q - J + 1 .. q for each f. The
    phases come first in the channels, as ONNX's own DepthToSpace wants them.
    """
    outputs, inputs, *kernel = weight.shape
    reach = max(-(-k // stride) for k in kernel)
    padded = np.zeros((outputs, inputs, reach * stride, reach * stride), weight.dtype)
    padded[:, :, : kernel[0], : kernel[1]] = weight
    taps = padded.reshape(outputs, inputs, reach, stride, reach, stride)[:, :, ::-1, :, ::-1]
    return np.ascontiguousarray(taps.transpose(3, 5, 0, 1, 2, 4)).reshape(-1, inputs, reach, reach), reach - 1


def of_phases(weight: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """The weights (O, I, kh, kw) that `phases` made (stride^2 O, I, J, J) of."""
    outputs, inputs, rows, columns = shape
    reach = weight.shape[2]
    taps = weight.reshape(stride, stride, outputs, inputs, reach, reach).transpose(2, 3, 4, 0, 5, 1)
    padded = taps[:, :, ::-1, :, ::-1].reshape(outputs, inputs, reach * stride, reach * stride)
    return np.ascontiguousarray(padded[:, :, :rows, :columns])
