"""Metrics of a hard case beside a noisy copy of it: figures or refusals, never a wrong number."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import Measure
from deploy.stress.simulator import sensor_of
from deploy.stress.subject import Subject
from model.metrics.fidelity import MIN_SIDE_PX, psnr_db, ssim
from model.metrics.noise_level import NoiseLevel, noise_level
from model.metrics.sharpness import EdgeMtf, edge_mtf
from profiles.errors import BeersError

ROUNDING = 1e-9
NOISE_DN = 5.0


def metrics(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """PSNR and SSIM with a reference; MTF and SNR without."""
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
