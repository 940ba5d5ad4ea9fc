"""The stages of the battery: what is checked of the networks under test for a hard case."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from beers_deploy.quant.bounds import layer_bounds
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.studies.stress import checks
from beers_deploy.studies.stress.cases import FULL_DN, Case
from beers_deploy.studies.stress.networks import Runner, Subject, in_torch

GAIN_DN = 16.0
STEEPEST_DN = 64.0
FLOAT32_DN = 0.05
INT8_GAIN_DN = 128.0
"""The bound of the INT8 gain. A change of 1 DN can change a rounding in every layer, and move a
pixel from the fine gain to the coarse one.
"""
ROUNDING_DN = 128.0
"""The bound of the effect of the DPU's tie rounding (half up): one unit in any layer,
propagated.
"""
MORE_THREADS = 2
CROP_PX = 48
CORES_PX = (16, 29)
LARGE_CORE_PX = 250
"""The side of a tile without its two halos, for large images."""


def float32(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Check the float network in float32, and against float64 if it has only convolutions.

    Args:
        subject: the networks under test.
        case: the hard case that the image belongs to.
        image: the image (H, W) in DN.
    """
    network = subject.float32
    graph = subject.graph
    measures = restoration(network, case, image, GAIN_DN)
    if case.pixels == "valid" and not case.large and graph is not None:
        extended = network.extended(_fractions(image))
        exact = in_torch(graph, torch.from_numpy(extended).double()).numpy()
        error = FULL_DN * float(np.abs(network.infer()(extended) - exact).max())
        # The signs of the gradient of the middle pixel: to first order, this change of the input
        # moves it most.
        pixels = torch.from_numpy(extended).requires_grad_()
        middle = in_torch(graph, pixels)[0, 0, extended.shape[2] // 2, extended.shape[3] // 2]
        (gradient,) = torch.autograd.grad(middle, pixels)
        signs = gradient[0, 0, : image.shape[0], : image.shape[1]].sign().numpy()
        steepest = checks.change(network.restore, image, network.restore(image), signs)
        measures.append(checks.Measure("error against float64", error, FLOAT32_DN))
        measures.append(checks.Measure("gain, steepest", steepest, STEEPEST_DN, "DN per DN"))
    return measures


def int8(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Check the INT8 network with onnxruntime's integer kernels on an image (H, W) in DN."""
    network = subject.quantized
    measures = restoration(network, case, image, INT8_GAIN_DN)
    if case.pixels == "valid" and not case.large:
        apart = np.abs(network.restore(image) - subject.float32.restore(image))
        error = float(apart.mean())
        measures.append(checks.Measure("mean error against float", error, checks.FLAT_DN))
    return measures


def restoration(
    network: Runner, case: Case, image: np.ndarray, gain_dn: float
) -> list[checks.Measure]:
    """Run the checks that apply to a network of any precision: finite and in range, the same in
    every run, ringing, brightness and gain.

    Args:
        network: the network.
        case: the hard case that the image belongs to. If its pixels are infinite or beyond 12 bits,
            the network must refuse the image.
        image: the image (H, W) in DN.
        gain_dn: the largest change of a restored pixel that a change of 1 DN may cause.
    """
    if case.pixels in ("infinite", "beyond"):
        return [checks.refused(lambda: network.restore(image))]
    result = network.restore(image)
    valid = ~np.isnan(image)
    outside = (result < 0) | (result > FULL_DN)
    measures = [
        checks.not_finite(result[valid]),
        checks.Measure("out of range", float(outside.sum()), 0, "px"),
    ]
    if case.large:
        return measures
    measures.append(checks.differing("runs differ", result, network.restore(image)))
    measures.append(
        checks.differing("threads differ", result, network.restore(image, MORE_THREADS))
    )
    if case.pixels == "missing":
        return [*measures, checks.differing("missing moved", result[~valid], image[~valid])]
    largest = checks.gain(network.restore, image, result, np.random.default_rng(0))
    measures += checks.fidelity(image, result, network.tiling.halo_px, case.flat)
    return [*measures, checks.Measure("gain", largest, gain_dn, "DN per DN")]


def reference(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Check the INT8 network by the integer reference, layer by layer.

    The reference computes the integers of each layer in NumPy. The runtime must agree with it bit
    for bit, no accumulator may exceed its proven bound, and only layers whose bounds allow it may
    saturate. Rounding ties up, as a DPU does, may change the result by at most ROUNDING_DN. Images
    (H, W) in DN are cropped to CROP_PX, because the reference is slow.
    """
    core = subject.core
    network = subject.quantized
    if case.pixels != "valid":
        return []
    crop = network.extended(_fractions(image[:CROP_PX, :CROP_PX]))
    planes = core.host_part.encode(crop)
    # onnxruntime rounds ties to even, and the DPU rounds them up.
    even, reports = run_core(core, planes, half_even=True)
    up, _ = run_core(core, planes)
    by_rule, on_board = (
        core.host_part.finish(crop, merged_correction(core, tensors))[0, 0]
        for tensors in (even, up)
    )
    # A peak above its proof would mean that the proof is wrong, not the network.
    over = max(report.peak_bits - report.proven_bits for report in reports)
    can = {bound.name for bound in layer_bounds(core) if bound.saturates}
    unproven = [
        report.name for report in reports if report.saturated > 0 and report.name not in can
    ]
    return [
        checks.not_finite(by_rule),
        checks.differing("runtime differs", by_rule, network.infer()(crop)[0, 0]),
        checks.Measure(
            "DPU's tie rounding", FULL_DN * float(np.abs(on_board - by_rule).max()), ROUNDING_DN
        ),
        checks.Measure("accumulator beyond its proof", over, 0, "bits"),
        checks.Measure("saturation not reported", len(unproven), 0, "layers"),
    ]


def _fractions(image: np.ndarray) -> np.ndarray:
    return (np.asarray(image, np.float32) / np.float32(FULL_DN))[None, None]


def tiling(subject: Subject, case: Case, image: np.ndarray) -> list[checks.Measure]:
    """Compare both networks, tiled by several plans, with the whole image (H, W).

    The tiles must give the result of the whole image, bit for bit. If the pixels of the case are
    infinite or beyond 12 bits, the networks must refuse the image in tiles too.
    """
    measures = []
    cores_px = (LARGE_CORE_PX,) if case.large else CORES_PX
    for name, network in subject.by_name.items():
        ways = [
            partial(network.restore, image, tile_px=2 * network.tiling.halo_px + core_px)
            for core_px in cores_px
        ]
        if case.pixels in ("infinite", "beyond"):
            measures += [checks.refused(way) for way in ways]
        else:
            untiled = network.restore(image)
            measures += [checks.differing(f"{name} plans differ", way(), untiled) for way in ways]
    return measures


Stage = Callable[[Subject, Case, np.ndarray], list[checks.Measure]]

STAGES: dict[str, Stage] = {
    "float32": float32,
    "INT8": int8,
    "INT8 reference": reference,
    "tiling": tiling,
}
