"""The INT8 network on a hard case: by onnxruntime against float, and in whole numbers against onnxruntime."""

import numpy as np

from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import FLAT_DN, Measure, differing, not_finite
from deploy.stress.network import restoration
from deploy.stress.subject import Network, Subject
from profiles.errors import BeersError, ModelError
from quant.core import IntConv, IntCore
from quant.int_bounds import saturable
from quant.integer import LayerReport, merged_correction, run_core
from quant.planes import split

GAIN_DN = 128.0
"""A change of 1 DN can move a rounding in every layer, and a pixel from the fine gain to the coarse one."""
ROUNDING_DN = 128.0
"""What the DPU's rule for halves may change: one unit in any layer, carried on."""
CROP_PX = 48


def runtime(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """By onnxruntime's integer kernels."""
    network = _int8(subject)
    measures = restoration(network, case, image, GAIN_DN)
    if case.pixels == "sound" and not case.large:
        apart = np.abs(network.restore(image) - subject.float32.restore(image))
        measures.append(Measure("mean error against float", float(apart.mean()), FLAT_DN))
    return measures


def reference(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """By whole numbers alone, 48 x 48 pixels of larger images."""
    core, network = core_of(subject), _int8(subject)
    if case.pixels != "sound":
        return []
    crop = (np.asarray(image[:CROP_PX, :CROP_PX], np.float32) / np.float32(FULL_DN))[None, None]
    planes = planes_of(core, crop)
    even, reports = run_core(core, planes, half_even=True)
    up, _ = run_core(core, planes)
    by_runtime, by_rule, on_board = (
        network.infer()(crop)[0, 0],
        _restored(core, crop, even),
        _restored(core, crop, up),
    )
    over = max(report.peak_bits - report.proven_bits for report in reports)
    return [
        not_finite(by_rule),
        differing("runtime differs", by_rule, by_runtime),
        Measure("DPU's halves", FULL_DN * float(np.abs(on_board - by_rule).max()), ROUNDING_DN),
        Measure("accumulator beyond its proof", over, 0, "bits"),
        _unproven(core, reports),
    ]


def core_of(subject: Subject) -> IntCore:
    """The whole numbers of the INT8 file.

    Raises:
        ModelError: no file, or one whose numbers cannot be told.
    """
    _int8(subject)
    core = subject.core
    if isinstance(core, BeersError):
        raise core
    assert core is not None  # noqa: S101 - there is a file
    return core


def planes_of(core: IntCore, image: np.ndarray) -> np.ndarray:
    """As many planes (N, 2 or 3, H, W) as the core reads."""
    first = core.ops[0]
    planes = split(image)
    return planes[:, : first.weight.shape[1]] if isinstance(first, IntConv) else planes


def _restored(core: IntCore, image: np.ndarray, tensors: dict[str, np.ndarray]) -> np.ndarray:
    return np.asarray(np.clip(image + merged_correction(core, tensors), 0, 1)[0, 0])


def _unproven(core: IntCore, reports: list[LayerReport]) -> Measure:
    """Layers that saturate although the proof says they cannot."""
    can = saturable(core)
    ends = [report.name for report in reports if report.saturated > 0 and not can[report.name]]
    return Measure("saturation not reported", len(ends), 0, "layers")


def _int8(subject: Subject) -> Network:
    if subject.int8 is None:
        remedy = "give it as the second argument"
        raise ModelError("INT8 network", expected="a file", got="none", remedy=remedy)
    return subject.int8
