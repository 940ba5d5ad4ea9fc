"""The DPU's arithmetic in whole numbers, as documented, independent of any runtime (facts: UG1414 3.5, vai_q).

    convolution: int8 products added in int32, plus bias << shift_bias, ReLU, >> shift_cut rounded, to [-128, 127]
    add:         the finer input aligned to the coarser, sum shifted by shift_write rounded, to [-128, 127]

Activations round half up; a runtime that computes in float rounds half to even. Where a shifted sum ends in exactly
one half the two differ by one unit: `half_even` takes the runtime's rule, so that both can be proven and counted.
"""

from dataclasses import dataclass

import numpy as np

from quant.core import IntConv, IntCore
from quant.graph import CORRECTION, Add
from quant.planes import PLANES
from quant.positions import INT8_MAX, INT8_MIN

INT32_BITS = 31
"""Of an accumulator, without the sign."""


@dataclass(frozen=True)
class LayerReport:
    """What one operation did on the images it saw.

    Attributes:
        name: of the operation.
        peak_bits: bits that the largest accumulator needed, without the sign.
        proven_bits: bits that no input can exceed: 128 times the sum of the weights' sizes, plus the bias.
        saturated: share of the results that came to int8's ends.
        ties: share of the results whose rounding was decided by the rule for halves.
    """

    name: str
    peak_bits: float
    proven_bits: float
    saturated: float
    ties: float


def run_core(
    core: IntCore, planes: np.ndarray, half_even: bool = False
) -> tuple[dict[str, np.ndarray], list[LayerReport]]:
    """Every tensor of the core for int8 planes (N, 3, H, W), and a report a layer."""
    tensors, reports = {PLANES: planes.astype(np.int64)}, []
    for op in core.ops:
        sums, shift, bound = _conv(core, op, tensors) if isinstance(op, IntConv) else _add(core, op, tensors)
        tensors[op.output], ties = _shifted(sums, shift, half_even)
        result = tensors[op.output]
        ends = (result == INT8_MAX) | (result == INT8_MIN)
        peak = float(np.log2(max(int(np.abs(sums).max()), 1)))
        reports.append(LayerReport(op.name, peak, bound, float(ends.mean()), ties))
    return tensors, reports


def correction(core: IntCore, planes: np.ndarray, half_even: bool = False) -> np.ndarray:
    """The correction (N, 1 or 2, H, W) as float32 multiples of its scale, of int8 planes (N, 3, H, W)."""
    tensors, _ = run_core(core, planes, half_even)
    return np.asarray(tensors[CORRECTION] * np.float32(core.scale(CORRECTION)), np.float32)


def _conv(core: IntCore, op: IntConv, tensors: dict[str, np.ndarray]) -> tuple[np.ndarray, int, float]:
    """The accumulators (N, O, H, W), the shift to int8, and the bits that they cannot exceed."""
    product = op.weight_position + core.positions[op.input]
    bias = op.bias.astype(np.int64) << (product - op.bias_position)
    sums = _convolve(tensors[op.input], op.weight.astype(np.int64)) + bias[:, None, None]
    bound = 128 * np.abs(op.weight.astype(np.int64)).sum((1, 2, 3)) + np.abs(bias)
    if op.relu:
        sums = np.maximum(sums, 0)
    return sums, product - core.positions[op.output], float(np.log2(max(int(bound.max()), 1)))


def _convolve(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Same-size convolution with zero padding: one product of matrices a tap, exact in int64."""
    side = weight.shape[2]
    margin = side // 2
    wide = np.pad(image, ((0, 0), (0, 0), (margin, margin), (margin, margin)))
    height, width = image.shape[2:]
    sums = np.zeros((len(image), len(weight), height, width), np.int64)
    for dy in range(side):
        for dx in range(side):
            # float64 holds whole numbers exactly up to 2^53, and its product of matrices is the fast one
            part = wide[:, :, dy : dy + height, dx : dx + width].astype(np.float64)
            tap = weight[:, :, dy, dx].astype(np.float64)
            sums += np.einsum("oi,nihw->nohw", tap, part, optimize=True).astype(np.int64)
    return sums


def _add(core: IntCore, op: Add, tensors: dict[str, np.ndarray]) -> tuple[np.ndarray, int, float]:
    """The sum at the finer input's position, exact; the shift that remains; and its bits."""
    finest = max(core.positions[name] for name in op.inputs)
    aligned = [tensors[name] << (finest - core.positions[name]) for name in op.inputs]
    bound = sum(128 << (finest - core.positions[name]) for name in op.inputs)
    return aligned[0] + aligned[1], finest - core.positions[op.output], float(np.log2(bound))


def _shifted(sums: np.ndarray, shift: int, half_even: bool) -> tuple[np.ndarray, float]:
    """Sums divided by 2^shift, rounded and clipped to int8; and the share that lay half-way."""
    if shift <= 0:
        return np.clip(sums << -shift, INT8_MIN, INT8_MAX), 0.0
    half = 1 << (shift - 1)
    rounded = (sums + half) >> shift
    ties = (sums & ((1 << shift) - 1)) == half
    if half_even:
        rounded = rounded - (ties & (rounded % 2 == 1))
    return np.clip(rounded, INT8_MIN, INT8_MAX), float(ties.mean())
