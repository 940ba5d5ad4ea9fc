"""The integer reference beside onnxruntime, layer by layer on the same image.

With the runtime's rule for halves both must give the same numbers; with the DPU's they part, and this counts by how
much: see `quant.integer`.
"""

from dataclasses import dataclass

import numpy as np
import onnx

from quant.core import IntCore
from quant.host_file import ZERO
from quant.integer import LayerReport, merged_correction, run_core
from quant.onnx_file import any_size, with_outputs
from quant.planes import split
from quant.session import open_session


@dataclass(frozen=True)
class LayerAgreement:
    """One operation's results, computed three times.

    Attributes:
        report: of the integer reference, which rounds halves up, as the DPU does.
        unequal: share of onnxruntime's results that are not the reference's when that rounds halves to even.
        moved: share of the results that the DPU's rule changes, here or in a layer before.
        moved_by: the largest of these changes, in units of 2^-position.
    """

    report: LayerReport
    unequal: float
    moved: float
    moved_by: int


@dataclass(frozen=True)
class Agreement:
    """All operations in order, and the correction (N, 1, H, W) of full scale with halves up, and to even."""

    layers: list[LayerAgreement]
    up: np.ndarray
    even: np.ndarray


def agreement(core: IntCore, host: onnx.ModelProto, image: np.ndarray) -> Agreement:
    """Run the core by both rules and in onnxruntime.

    Args:
        core: whole numbers.
        host: the same in the host's spelling.
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
