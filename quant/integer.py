"""The DPU's arithmetic in whole numbers, as documented, independent of any runtime (facts: UG1414 3.5, vai_q).

    convolution: int8 products added in int32, plus bias << shift_bias, ReLU, >> shift_cut rounded, to [-128, 127]
    add:         the finer input aligned to the coarser, sum shifted by shift_write rounded, to [-128, 127]

Activations round half up; a runtime that computes in float rounds half to even. Where a shifted sum ends in exactly
one half the two differ by one unit: `half_even` takes the runtime's rule, so that both can be proven and counted.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import onnx
from numpy.lib.stride_tricks import sliding_window_view

from profiles.figures import Figure, Row, measured, predicted
from quant.core import INT8_MAX, INT8_MIN, IntConv, IntCore
from quant.encodings import ZERO
from quant.graph import CORRECTION, PLANES, Add, split
from quant.onnx_file import any_size, with_outputs
from quant.passes.stream import merge
from quant.session import few_crops, open_any_size, open_session, run

INT32_BITS = 31
"""Of an accumulator, without the sign."""

FLOAT32_WHOLE_MAX = 2**24
"""Up to here float32 holds whole numbers exactly, and sums them in any order."""

NARROW_BITS = 23
"""Of a 24-bit accumulator, without the sign: the documents hint at one (facts on the DPU's rules), int32 has 31."""
BITS_SOURCE = "128 times the sum of the weights' sizes, plus the bias: no input exceeds it"
STRIP_VALUES = 1 << 22
"""Values of the windows that are laid out at a time: 16 MB of float32."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong while the core runs, or is held in check.

    Attributes:
        shifts: wrong shifts, by operation and field: `shift_cut`, `shift_bias` of a convolution, `shift_write` of an
            add.
        touch: what becomes of a tensor, by name, between the operation that writes it and those that read it.
    """

    shifts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    touch: Callable[[str, np.ndarray], np.ndarray] = field(default=lambda _, tensor: tensor)

    def shift(self, op: str, name: str, meant: int) -> int:
        """The shift that an operation uses."""
        return self.shifts.get((op, name), meant)


SOUND = Faults()


@dataclass(frozen=True)
class LayerReport:
    """What one operation did on the images it saw.

    Attributes:
        name: of the operation.
        peak_bits: bits that the largest accumulator needed, without the sign.
        proven_bits: bits that no input can exceed: 128 times the sum of the weights' sizes, plus the bias.
        saturated: share of the results that came to int8's ends.
        ties: share of the results whose rounding was decided by tie rounding.
    """

    name: str
    peak_bits: float
    proven_bits: float
    saturated: float
    ties: float


def run_core(
    core: IntCore, planes: np.ndarray, half_even: bool = False, faults: Faults = SOUND
) -> tuple[dict[str, np.ndarray], list[LayerReport]]:
    """Every tensor of the core for int8 planes (N, 3, H, W), as int16, and a report a layer."""
    tensors, reports = {PLANES: faults.touch(PLANES, planes.astype(np.int16))}, []
    for op in core.ops:
        if isinstance(op, IntConv):
            sums, shift, bound = _conv(core, op, tensors, faults)
        else:
            sums, shift, bound = _add(core, op, tensors, faults)
        result, ties = _shifted(sums, shift, half_even)
        tensors[op.output] = faults.touch(op.output, result)
        ends = (result == INT8_MAX) | (result == INT8_MIN)
        peak = float(np.log2(max(int(np.abs(sums).max()), 1)))
        reports.append(LayerReport(op.name, peak, bound, float(ends.mean()), ties))
    return tensors, reports


def correction(core: IntCore, planes: np.ndarray, half_even: bool = False) -> np.ndarray:
    """The correction (N, 1 or 2, H, W) as float32 multiples of its scale, of int8 planes (N, 3, H, W)."""
    tensors, _ = run_core(core, planes, half_even)
    return np.asarray(tensors[CORRECTION] * np.float32(core.scale(CORRECTION)), np.float32)


def merged_correction(core: IntCore, tensors: Mapping[str, np.ndarray]) -> np.ndarray:
    """The correction (N, 1, H, W) of full scale as the host reads it, from the tensors of a run."""
    scale = core.scale(CORRECTION)
    return merge((tensors[CORRECTION] * np.float32(scale)).astype(np.float32), scale)


def _conv(
    core: IntCore, op: IntConv, tensors: dict[str, np.ndarray], faults: Faults
) -> tuple[np.ndarray, int, float]:
    """The accumulators (N, O, H, W), the shift to int8, and the bits that they cannot exceed."""
    product = op.weight_frac_bits + core.frac_bits[op.input]
    bias = _moved(op.bias.astype(np.int64), faults.shift(op.name, "shift_bias", product - op.bias_frac_bits))
    sums = _convolve(tensors[op.input], op.weight) + bias[:, None, None]
    bound = 128 * np.abs(op.weight.astype(np.int64)).sum((1, 2, 3)) + np.abs(bias)
    if op.relu:
        sums = np.maximum(sums, 0)
    cut = faults.shift(op.name, "shift_cut", product - core.frac_bits[op.output])
    return sums, cut, float(np.log2(max(int(bound.max()), 1)))


def _convolve(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Same-size convolution with zero padding, (N, I, H, W) by (O, I, k, k): a product of matrices a strip of rows.

    In floats that hold its sums exactly; the windows of a whole image would take kh kw times its memory.
    """
    largest = 128 * int(np.abs(weight.astype(np.int64)).sum((1, 2, 3)).max(initial=0))
    exact = np.float32 if largest <= FLOAT32_WHOLE_MAX else np.float64
    kernel, matrix = weight.shape[2], weight.reshape(len(weight), -1).astype(exact)
    ends = (kernel // 2, kernel // 2)
    wide = np.pad(image.astype(exact), ((0, 0), (0, 0), ends, ends))
    windows = sliding_window_view(wide, (kernel, kernel), (2, 3))
    count, _, height, width = image.shape
    sums = np.empty((count, len(weight), height, width), np.int64)
    rows = max(STRIP_VALUES // (matrix.shape[1] * width), 1)
    for number, top in product(range(count), range(0, height, rows)):
        strip = windows[number, :, top : top + rows].transpose(0, 3, 4, 1, 2).reshape(matrix.shape[1], -1)
        sums[number, :, top : top + rows] = (matrix @ strip).reshape(len(weight), -1, width)
    return sums


def _add(core: IntCore, op: Add, tensors: dict[str, np.ndarray], faults: Faults) -> tuple[np.ndarray, int, float]:
    """The sum at the finer input's scale, exact; the shift that remains; and its bits."""
    finest = max(core.frac_bits[name] for name in op.inputs)
    aligned = [tensors[name].astype(np.int64) << (finest - core.frac_bits[name]) for name in op.inputs]
    bound = sum(128 << (finest - core.frac_bits[name]) for name in op.inputs)
    coarsest = min(core.frac_bits[name] for name in op.inputs)
    write = faults.shift(op.name, "shift_write", coarsest - core.frac_bits[op.output])
    return aligned[0] + aligned[1], finest - coarsest + write, float(np.log2(bound))


def _moved(values: np.ndarray, shift: int) -> np.ndarray:
    """Shifted left, or right where a fault makes it so."""
    return values << shift if shift >= 0 else values >> -shift


def _shifted(sums: np.ndarray, shift: int, half_even: bool) -> tuple[np.ndarray, float]:
    """Sums divided by 2^shift, rounded and clipped to int8, as int16; and the share that lay half-way."""
    if shift <= 0:
        moved = np.clip(sums, INT8_MIN, INT8_MAX) << min(-shift, 8)  # by 8 all but 0 has come to an end
        return np.clip(moved, INT8_MIN, INT8_MAX).astype(np.int16), 0.0
    half = 1 << (shift - 1)
    rounded = (sums + half) >> shift
    ties = (sums & ((1 << shift) - 1)) == half
    if half_even:
        rounded = rounded - (ties & (rounded % 2 == 1))
    return np.clip(rounded, INT8_MIN, INT8_MAX).astype(np.int16), float(ties.mean())


@dataclass(frozen=True)
class LayerAgreement:
    """One operation's results, computed three times.

    Attributes:
        report: of the integer reference, which rounds ties up, as the DPU does.
        unequal: share of onnxruntime's results that are not the reference's when that rounds ties to even.
        moved: share of the results that the DPU's rule changes, here or in a layer before.
        moved_by: the largest of these changes, in units of 2^-n.
    """

    report: LayerReport
    unequal: float
    moved: float
    moved_by: int


@dataclass(frozen=True)
class Agreement:
    """All operations in order, and the correction (N, 1, H, W) of full scale with half up, and to even."""

    layers: list[LayerAgreement]
    up: np.ndarray
    even: np.ndarray


def agreement(core: IntCore, host: onnx.ModelProto, image: np.ndarray) -> Agreement:
    """Run the core by both rules and in onnxruntime.

    Args:
        core: whole numbers.
        host: the same in the host's encoding.
        image: (N, 1, H, W) in [0, 1].
    """
    names = [op.output for op in core.ops]
    session = open_session(with_outputs(any_size(host), dict.fromkeys(names, onnx.TensorProto.UINT8)))
    stored = session.run(names, {session.get_inputs()[0].name: image})
    up, reports = run_core(core, split(image))
    even, _ = run_core(core, split(image), half_even=True)
    layers = []
    for name, report, runtime in zip(names, reports, stored, strict=True):
        difference = np.abs(up[name] - even[name])
        unequal = float((runtime.astype(np.int16) - ZERO != even[name]).mean())
        layers.append(LayerAgreement(report, unequal, float((difference > 0).mean()), int(difference.max())))
    return Agreement(layers, merged_correction(core, up), merged_correction(core, even))


def integer_rows(
    model: onnx.ModelProto, core: IntCore, host: onnx.ModelProto, images: Iterable[np.ndarray]
) -> tuple[list[Row], Row]:
    """Each integer operation on a crop of a few images (1, 1, H, W), and what the DPU's tie rounding changes."""
    seen = few_crops(images)
    found = [agreement(core, host, crop) for crop in seen]
    source = f"the integer reference on {len(found)} calibration patches"
    layers = [_layer_row(list(same), source) for same in zip(*(one.layers for one in found), strict=True)]
    session = open_any_size(model)
    both = [
        [np.clip(crop + result, 0, 1) for result in (one.up, one.even)] for crop, one in zip(seen, found, strict=True)
    ]
    in_float = [np.clip(run(session, crop), 0, 1) for crop in seen]
    return layers, _rounding_row(in_float, both, source)


def _layer_row(layers: list[LayerAgreement], source: str) -> Row:
    proven = layers[0].report.proven_bits
    left = NARROW_BITS - proven

    def percent(shares: Iterable[float], of: str = source) -> Figure:
        return measured(100 * float(np.mean(list(shares))), "%", of)

    figures = {
        "accumulator, seen": measured(max(a.report.peak_bits for a in layers), "bits", source),
        "accumulator, proven": predicted(proven, "bits", (proven, proven), BITS_SOURCE),
        "left of 24 bits": predicted(left, "bits", (left, left), f"23 bits and a sign, less {BITS_SOURCE}"),
        "saturated": percent(a.report.saturated for a in layers),
        "ties": percent(a.report.ties for a in layers),
        "as onnxruntime": percent((1 - a.unequal for a in layers), f"{source}, half to even as there"),
        "moved by half up": percent((a.moved for a in layers), f"{source}, half up"),
        "at most by": measured(max(a.moved_by for a in layers), "units", f"{source}, half up"),
    }
    return Row("integer layers", layers[0].report.name, figures)


def _rounding_row(in_float: list[np.ndarray], both: list[list[np.ndarray]], source: str) -> Row:
    """How far the DPU's rounding of ties, up, leads away from the runtime's, to even; which is nearer to float."""
    up, even = (np.concatenate([results[k].ravel() for results in both]) for k in (0, 1))
    whole = np.concatenate([result.ravel() for result in in_float])

    def mae(one: np.ndarray, other: np.ndarray) -> Figure:
        return measured(float(np.abs(one - other).mean(dtype=np.float64)), "of full scale", source)

    figures = {
        "pixels that differ": measured(100 * float((up != even).mean()), "%", source),
        "MAE between them": mae(up, even),
        "MAE of half up": mae(up, whole),
        "MAE of half to even": mae(even, whole),
    }
    return Row("rounding", "half up (DPU) against half to even (onnxruntime)", figures)
