"""What surrounds the network on a hard case: simulator, traditional chain, training loss and metrics.

Figures or refusals, never a wrong number; the loss finite, its gradient finite and bounded.
"""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import tifffile
import torch
from torch import Tensor

from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import (
    FLAT_DN,
    Measure,
    differing,
    gain,
    mean_shift,
    not_finite,
    out_of_range,
    refused,
    ringing,
    torch_threads,
)
from deploy.stress.subject import Subject
from model.metrics.backbones import Backbone, read_tensors
from model.metrics.fidelity import MIN_SIDE_PX, psnr_db, ssim
from model.metrics.noise_level import NoiseLevel, noise_level
from model.metrics.perceptual import PUBLISHED, Lpips
from model.metrics.sharpness import EdgeMtf, edge_mtf
from model.shipped import SENSOR
from model.simulator.acquire import acquire
from model.simulator.detector import Draw
from model.simulator.mtf import mtf, sensor_transfer
from model.simulator.plan import ringing_of, scene_stats
from model.simulator.sampling import read_scene, sample, scene_spectrum
from model.traditional.pipeline import Chain, restore_strips, restore_traditional
from model.training.losses import LossWeights, RestorationLoss
from profiles import load_sensor
from profiles.errors import BeersError
from profiles.sensor import Sensor
from profiles.sensor_file import REFERENCE

RATIO = 2
FLOAT32_DN = 0.05
"""Of a transform in float32, at full scale."""


def simulator(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """From radiance (H, W) to digital numbers; missing radiance is refused where a file is read."""
    sensor = sensor_of(case)
    if case.pixels in ("missing", "infinite"):
        return [refused(lambda: _read_back(image, sensor))]
    acquired, again = (_acquired(image, sensor) for _ in range(2))
    whole = Measure("no whole number", float((acquired != np.rint(acquired)).sum()), 0, "px")
    measures = [not_finite(acquired), out_of_range(acquired), whole, differing("runs differ", acquired, again)]
    if case.large or case.pixels == "beyond":
        return measures
    return [*measures, _more_threads(image, sensor, acquired), *_linear(image, sensor)]


def sensor_of(case: Case) -> Sensor:
    """The profile's sensor, with the case's own MTF."""
    sensor = load_sensor(SENSOR).nominal()
    if case.mtf_nyquist is None:
        return sensor
    return replace(sensor, mtf_nyquist=case.mtf_nyquist, mtf_nyquist_along=None)


def _linear(image: np.ndarray, sensor: Sensor) -> list[Measure]:
    """Of the blurred, sampled signal, before noise and digitising."""
    signal = _signal(image, sensor)
    kernel = ringing_of(sensor, scene_stats(_radiance(image, sensor), RATIO))
    middle, reach = (image.max() + image.min()) / 2, kernel * (image.max() - image.min()) / 2
    beyond = float(np.maximum(np.abs(signal - middle) - reach, 0).max())
    change = gain(lambda pixels: _signal(pixels, sensor), image, signal, np.random.default_rng(0))
    truth = _signal_float64(image, sensor)
    return [
        mean_shift(signal, image, FLOAT32_DN),
        Measure("ringing beyond its proof", beyond, FLOAT32_DN),
        Measure("gain", change, kernel + FLOAT32_DN, "DN per DN"),
        Measure("error against float64", float(np.abs(signal - truth).max()), FLOAT32_DN),
    ]


def _radiance(image: np.ndarray, sensor: Sensor) -> Tensor:
    """Each pixel as RATIO x RATIO scene pixels, W/m2/sr/um."""
    fine = np.repeat(np.repeat(np.asarray(image, np.float32), RATIO, 0), RATIO, 1)
    return torch.from_numpy(fine / np.float32(sensor.gain_dn_per_radiance))


def _acquired(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    radiance = _radiance(image, sensor)
    spectrum = scene_spectrum(radiance)
    return acquire(spectrum, radiance.shape[-1], sensor, RATIO, Draw(0), "degraded", margin_px=0).numpy()


def _signal(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    radiance = _radiance(image, sensor)
    height, width = radiance.shape
    transfer = sensor_transfer(height, width, RATIO, sensor)
    sampled = sample(scene_spectrum(radiance), transfer, width, RATIO)
    return np.asarray(sampled.numpy() * np.float32(sensor.gain_dn_per_radiance))


def _signal_float64(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The same from the formulas: the whole transform in float64, then the samples between two scene pixels."""
    radiance = _radiance(image, sensor).double()
    height, width = radiance.shape
    fy, fx = (torch.fft.fftfreq(side, dtype=torch.float64) for side in (height, width))
    response = torch.from_numpy(mtf(RATIO * fx[None, :], RATIO * fy[:, None], sensor.mtf_axes))
    shift = torch.exp(1j * torch.pi * (RATIO - 1) * fy)[:, None] * torch.exp(1j * torch.pi * (RATIO - 1) * fx)
    blurred = torch.fft.ifft2(torch.fft.fft2(radiance) * response * shift).real
    return np.asarray(blurred[::RATIO, ::RATIO].numpy() * sensor.gain_dn_per_radiance)


def _more_threads(image: np.ndarray, sensor: Sensor, acquired: np.ndarray) -> Measure:
    with torch_threads(torch.get_num_threads() + 1):
        return differing("threads differ", acquired, _acquired(image, sensor))


def _read_back(image: np.ndarray, sensor: Sensor) -> object:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.tif"
        tifffile.imwrite(path, image * np.float32(1 / FULL_DN))
        return read_scene(path, sensor)


GAIN_DN = 64.0
CHAIN_FLOAT32_DN = 4.0
RINGING_PERCENT, REACH_PX = 100.0, 19
STRIP_PX, CROP_PX = 13, 64


def traditional(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """The chain for the case's sensor, at quality "fast", on 64 x 64 pixels of larger images (H, W)."""
    chain = Chain(sensor_of(case), load_sensor(REFERENCE).nominal(), "fast")
    if case.pixels == "infinite":
        return [refused(lambda: _restored(image, chain))]
    if not case.large:
        image = np.ascontiguousarray(image[:CROP_PX, :CROP_PX])
    result, known = _restored(image, chain), ~np.isnan(image)
    measures = [not_finite(result[known]), out_of_range(result)]
    if case.large:
        return measures
    measures += [differing("runs differ", result, _restored(image, chain)), _strips(image, chain, result)]
    measures.append(_chain_threads(image, chain, result))
    if case.pixels == "missing":
        return [*measures, differing("missing moved", result[~known], image[~known])]
    if case.pixels == "beyond":
        return measures
    return [*measures, *_faithful(image, chain, case, result)]


def _faithful(image: np.ndarray, chain: Chain, case: Case, result: np.ndarray) -> list[Measure]:
    exact = restore_traditional(torch.from_numpy(image).double(), chain).numpy()
    change = gain(lambda pixels: _restored(pixels, chain), image, result, np.random.default_rng(0))
    measures = [
        ringing(result, image, REACH_PX, RINGING_PERCENT),
        Measure("gain", change, GAIN_DN, "DN per DN"),
        Measure("error against float64", float(np.abs(result - exact).max()), CHAIN_FLOAT32_DN),
    ]
    return [*measures, mean_shift(result, image, FLAT_DN)] if case.flat else measures


def _restored(image: np.ndarray, chain: Chain) -> np.ndarray:
    return np.asarray(restore_traditional(torch.from_numpy(np.asarray(image, np.float32)), chain).numpy())


def _strips(image: np.ndarray, chain: Chain, result: np.ndarray) -> Measure:
    strips = [torch.from_numpy(image[top : top + STRIP_PX]) for top in range(0, len(image), STRIP_PX)]
    joined = torch.cat(list(restore_strips(strips, len(image), chain))).numpy()
    return differing("strips differ", result, joined)


def _chain_threads(image: np.ndarray, chain: Chain, result: np.ndarray) -> Measure:
    with torch_threads(torch.get_num_threads() + 1):
        return differing("threads differ", result, _restored(image, chain))


NOISE = 5.0 / FULL_DN
RELATIVE = 1e-4
LPIPS_GRADIENT = 1e4


def losses(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """L1 + 0.1 FFT, and LPIPS over random weights, on an image (H, W); of lost pixels none may give a number."""
    reference = torch.from_numpy(np.asarray(image, np.float32) / np.float32(FULL_DN))[None, None]
    noise = np.random.default_rng(0).standard_normal(image.shape).astype(np.float32)
    restored = reference + torch.from_numpy(NOISE * noise)
    if case.pixels in ("missing", "infinite"):
        value, _gradient = _with_gradient(RestorationLoss(), restored, reference)
        return [Measure("number from lost pixels", float(math.isfinite(value)), 0, "figures")]
    pairs = ((restored, reference), (reference, reference))
    measures = [measure for pair in pairs for measure in _loss(*pair)]
    if case.large or min(image.shape) < _lpips().backbone.spec.min_side_px:
        return measures
    return [*measures, *(measure for pair in pairs for measure in _perceptual(*pair))]


def _loss(restored: Tensor, reference: Tensor) -> list[Measure]:
    loss = RestorationLoss()
    value, gradient = _with_gradient(loss, restored, reference)
    again, gradient_again = _with_gradient(loss, restored, reference)
    pixels = gradient.numel()
    # Of the mean size of F, orthonormal, each pixel moves every F by 1 / sqrt(pixels) at most: proven.
    allowed = 1 + loss.weights.fft * math.sqrt(pixels)
    exact = _float64(loss.weights, restored.double(), reference.double())
    return [
        _lost(value, gradient),
        Measure("runs differ", float(value != again) + float((gradient != gradient_again).sum()), 0, "px"),
        Measure("gradient beyond its proof", pixels * float(gradient.abs().max()) / allowed, 1 + RELATIVE, "times"),
        Measure("error against float64", abs(value - exact) / max(exact, NOISE), RELATIVE, "relative"),
    ]


def _perceptual(restored: Tensor, reference: Tensor) -> list[Measure]:
    value, gradient = _with_gradient(_lpips(), restored, reference)
    largest = gradient.numel() * float(gradient.abs().max())
    return [_lost(value, gradient), Measure("LPIPS gradient", largest, LPIPS_GRADIENT, "per pixel")]


def _lost(value: float, gradient: Tensor) -> Measure:
    lost = float((~torch.isfinite(gradient)).sum()) + float(not math.isfinite(value))
    return Measure("not finite", lost, 0, "px")


def _with_gradient(loss: "RestorationLoss | Lpips", restored: Tensor, reference: Tensor) -> tuple[float, Tensor]:
    image = restored.clone().requires_grad_()
    result = loss(image, reference)
    total = result[0] if isinstance(result, tuple) else result.mean()
    total.backward()
    assert image.grad is not None  # noqa: S101 - it was asked for
    return float(total.detach()), image.grad


def _float64(weights: LossWeights, restored: Tensor, reference: Tensor) -> float:
    difference = restored - reference
    spectrum = torch.fft.rfft2(difference, norm="ortho").abs().mean()
    return float(weights.l1 * difference.abs().mean() + weights.fft * spectrum)


@lru_cache(maxsize=1)
def _lpips() -> Lpips:
    """Random weights: what is looked at is the arithmetic, not the figure."""
    generator = torch.Generator().manual_seed(0)
    backbone = Backbone("squeeze")
    with torch.no_grad():
        for value in backbone.parameters():
            value.normal_(0, 0.05, generator=generator)
    names = [f"lin{layer}" for layer in range(len(backbone.spec.taps))]
    heads = read_tensors(PUBLISHED / "lpips-squeeze.safetensors", names)
    return Lpips(backbone, [heads[name] for name in names])


ROUNDING = 1e-9
NOISE_DN = 5.0


def metrics(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """PSNR and SSIM with a reference, MTF and SNR without, of an image (H, W)."""
    noise = NOISE_DN * np.random.default_rng(0).standard_normal(image.shape)
    other = np.clip(np.rint(image + noise), 0, FULL_DN).astype(np.float32)
    measures = [Measure("instrument not finite", _instruments(case, image), 0, "figures")]
    if case.pixels != "sound":
        given = [_figure(partial(f, image, other, FULL_DN)) for f in (psnr_db, ssim)]
        lost = ~np.isfinite(image).all()
        wrong = sum(math.isfinite(value) == lost for value in given)
        return [*measures, Measure("number from lost pixels" if lost else "no number", wrong, 0, "figures")]
    same = psnr_db(image, image, FULL_DN)
    measures.append(Measure("PSNR of itself is a number", float(math.isfinite(same)), 0, "figures"))
    return measures if min(image.shape) < MIN_SIDE_PX else [*measures, *_ssim(image, other)]


def _ssim(image: np.ndarray, other: np.ndarray) -> list[Measure]:
    value, exact = ssim(image, other, FULL_DN), ssim(image.astype(np.float64), other.astype(np.float64), FULL_DN)
    nudged = ssim(image, np.where(other < FULL_DN, other + 1, other - 1), FULL_DN)
    return [
        Measure("SSIM beyond 1", max(abs(value) - 1, 0.0), ROUNDING, ""),
        Measure("SSIM of itself off 1", abs(ssim(image, image, FULL_DN) - 1), ROUNDING, ""),
        Measure("error against float64", abs(value - exact), ROUNDING, ""),
        Measure("order matters", abs(value - ssim(other, image, FULL_DN)), ROUNDING * 1e3, ""),
        Measure("gain", abs(nudged - value), 0.05, "SSIM per DN"),
    ]


def _instruments(case: Case, image: np.ndarray) -> float:
    """Figures that are not finite where no refusal says why."""
    edge = edge_mtf(image, saturated=FULL_DN)
    noise = noise_level(image, sensor_of(case).gain_dn_per_radiance, saturated=FULL_DN)
    figures = [edge.mtf_nyquist, *edge.interval] if isinstance(edge, EdgeMtf) else []
    figures += [noise.alpha, noise.beta] if isinstance(noise, NoiseLevel) else []
    return float(sum(not math.isfinite(value) for value in figures))


def _figure(work: Callable[[], float]) -> float:
    try:
        return work()
    except BeersError:
        return math.nan
