"""The network on a hard case: float32 and bfloat16 beside float64, INT8 beside float and beside whole numbers, tiled.

Whatever the tile plan, no bit of the result may depend on it.
"""

import numpy as np
import torch

from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import (
    FLAT_DN,
    Measure,
    change,
    differing,
    gain,
    inside,
    mean_shift,
    not_finite,
    out_of_range,
    refused,
    ringing,
)
from deploy.stress.subject import Network, Subject, infer_in, restore, steepest_signs
from profiles.errors import BeersError, ModelError
from quant.bounds import saturable
from quant.core import IntCore
from quant.integer import LayerReport, merged_correction, run_core

RINGING_PERCENT = 100.0
"""No more than the contrast around it."""
GAIN_DN, STEEPEST_DN = 16.0, 64.0
FLOAT32_DN, BFLOAT16_DN = 0.05, 82.0
MORE_THREADS = 2


def float32(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """The float network in float32, against float64, on an image (H, W) in DN."""
    network = subject.float32
    measures = restoration(network, case, image, GAIN_DN)
    if case.pixels == "sound" and not case.large and not isinstance(subject.graph, BeersError):
        truth, whole = infer_in(subject.graph, torch.float64), network.extended(_fractions(image))
        measures.append(_error(network.infer()(whole), truth(whole), FLOAT32_DN))
        signs = steepest_signs(subject.graph, whole[0, 0])[: image.shape[0], : image.shape[1]]
        steepest = change(network.restore, image, network.restore(image), signs)
        measures.append(Measure("gain, steepest", steepest, STEEPEST_DN, "DN per DN"))
    return measures


def bfloat16(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """The float network in bfloat16 with a float32 sum, as training runs it, on an image (H, W) in DN."""
    if isinstance(subject.graph, BeersError):
        raise subject.graph
    infer, tiling = infer_in(subject.graph, torch.bfloat16, torch.float32), subject.float32.tiling
    if case.pixels in ("infinite", "beyond"):
        return [refused(lambda: restore(infer, image, tiling))]
    result, again = (restore(infer, image, tiling) for _ in range(2))
    known = ~np.isnan(image)
    measures = [not_finite(result[known]), out_of_range(result), differing("runs differ", result, again)]
    if case.pixels == "sound":
        truth = restore(infer_in(subject.graph, torch.float64), image, tiling)
        measures.append(Measure("error against float64", float(np.abs(result - truth).max()), BFLOAT16_DN))
    return measures


def restoration(network: Network, case: Case, image: np.ndarray, gain_dn: float) -> list[Measure]:
    """What must hold of any network on an image (H, W) in DN, by whatever it is run."""
    if case.pixels in ("infinite", "beyond"):
        return [refused(lambda: network.restore(image))]
    result = network.restore(image)
    known = ~np.isnan(image)
    measures = [not_finite(result[known]), out_of_range(result)]
    if case.large:
        return measures
    measures.append(differing("runs differ", result, network.restore(image)))
    measures.append(differing("threads differ", result, network.restore(image, MORE_THREADS)))
    if case.pixels == "missing":
        return [*measures, differing("missing moved", result[~known], image[~known])]
    measures += fidelity(case, image, result, network.radius_px)
    largest = gain(network.restore, image, result, np.random.default_rng(0))
    return [*measures, Measure("gain", largest, gain_dn, "DN per DN")]


def fidelity(case: Case, image: np.ndarray, result: np.ndarray, radius_px: int) -> list[Measure]:
    """What a restoration (H, W) may not do to contrast and, on flat ground, to brightness."""
    inner = inside(result, radius_px)
    measures = [ringing(inner, inside(image, radius_px), radius_px, RINGING_PERCENT)]
    if case.flat:
        measures += [mean_shift(inner, image), _border(result, image)]
    return measures


def _border(result: np.ndarray, image: np.ndarray) -> Measure:
    """On flat ground all that is lost at the border is the padding's doing."""
    return Measure("border", float(np.abs(result - image).max()), 0.02 * FULL_DN)


def _error(result: np.ndarray, truth: np.ndarray, allowed: float) -> Measure:
    return Measure("error against float64", FULL_DN * float(np.abs(result - truth).max()), allowed)


def _fractions(image: np.ndarray) -> np.ndarray:
    return (np.asarray(image, np.float32) / np.float32(FULL_DN))[None, None]


INT8_GAIN_DN = 128.0
"""A change of 1 DN can move a rounding in every layer, and a pixel from the fine gain to the coarse one."""
ROUNDING_DN = 128.0
"""What the DPU's tie rounding (half up) may change: one unit in any layer, carried on."""
CROP_PX = 48


def runtime(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """The INT8 network by onnxruntime's integer kernels, on an image (H, W) in DN."""
    network = _int8(subject)
    measures = restoration(network, case, image, INT8_GAIN_DN)
    if case.pixels == "sound" and not case.large:
        apart = np.abs(network.restore(image) - subject.float32.restore(image))
        measures.append(Measure("mean error against float", float(apart.mean()), FLAT_DN))
    return measures


def reference(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """The INT8 network in whole numbers alone, on 48 x 48 pixels of larger images (H, W)."""
    core, network = core_of(subject), _int8(subject)
    if case.pixels != "sound":
        return []
    crop = network.extended(_fractions(image[:CROP_PX, :CROP_PX]))
    planes = core.ends.split(crop)
    even, reports = run_core(core, planes, half_even=True)
    up, _ = run_core(core, planes)
    by_runtime, by_rule, on_board = (
        network.infer()(crop)[0, 0],
        _restored(core, crop, even),
        _restored(core, crop, up),
    )
    # A peak above its proof would mean that the proof is wrong, not the network.
    over = max(report.peak_bits - report.proven_bits for report in reports)
    return [
        not_finite(by_rule),
        differing("runtime differs", by_rule, by_runtime),
        Measure("DPU's tie rounding", FULL_DN * float(np.abs(on_board - by_rule).max()), ROUNDING_DN),
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


def _restored(core: IntCore, image: np.ndarray, tensors: dict[str, np.ndarray]) -> np.ndarray:
    return np.asarray(core.ends.finished(image, merged_correction(core, tensors))[0, 0])


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


CORES_PX = (16, 29)
"""What a tile keeps beside its two halos."""
LARGE_CORE_PX = 250


def plans(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """Both networks, tiled by several plans, against the whole image (H, W); plans refuse unsound pixels."""
    networks = [network for network in (subject.float32, subject.int8) if network is not None]
    names = ("float32 plans differ", "INT8 plans differ")
    return [
        measure
        for network, name in zip(networks, names, strict=False)
        for measure in _one(network, name, case, image)
    ]


def _one(network: Network, name: str, case: Case, image: np.ndarray) -> list[Measure]:
    cores = (LARGE_CORE_PX,) if case.large else CORES_PX
    tiles = [2 * network.radius_px + core for core in cores]
    if case.pixels in ("infinite", "beyond"):
        return [refused(lambda tile=tile: network.restore(image, tile_px=tile)) for tile in tiles]  # type: ignore[misc]
    whole = network.restore(image)
    return [differing(name, network.restore(image, tile_px=tile), whole) for tile in tiles]
