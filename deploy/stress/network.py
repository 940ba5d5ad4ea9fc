"""The float network on a hard case: in float32 by onnxruntime, and in bfloat16."""

import numpy as np
import torch

from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import (
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
from deploy.stress.exact import infer_in, steepest_signs
from deploy.stress.subject import Network, Subject, restore
from profiles.errors import BeersError

RINGING_PERCENT = 100.0
"""No more than the contrast around it."""
GAIN_DN, STEEPEST_DN = 16.0, 64.0
FLOAT32_DN, BFLOAT16_DN = 0.05, 82.0
MORE_THREADS = 2


def float32(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """In float32, against float64."""
    network = subject.float32
    measures = restoration(network, case, image, GAIN_DN)
    if case.pixels == "sound" and not case.large and not isinstance(subject.graph, BeersError):
        truth, signs = infer_in(subject.graph, torch.float64), steepest_signs(subject.graph, _fractions(image)[0, 0])
        measures.append(_error(network.infer()(_fractions(image)), truth(_fractions(image)), FLOAT32_DN))
        steepest = change(network.restore, image, network.restore(image), signs)
        measures.append(Measure("gain, steepest", steepest, STEEPEST_DN, "DN per DN"))
    return measures


def bfloat16(subject: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """In bfloat16 with a float32 sum, as training runs it, against float64."""
    if isinstance(subject.graph, BeersError):
        raise subject.graph
    infer, radius_px = infer_in(subject.graph, torch.bfloat16, torch.float32), subject.float32.radius_px
    if case.pixels in ("infinite", "beyond"):
        return [refused(lambda: restore(infer, image, radius_px))]
    result, again = (restore(infer, image, radius_px) for _ in range(2))
    known = ~np.isnan(image)
    measures = [not_finite(result[known]), out_of_range(result), differing("runs differ", result, again)]
    if case.pixels == "sound":
        truth = restore(infer_in(subject.graph, torch.float64), image, radius_px)
        measures.append(Measure("error against float64", float(np.abs(result - truth).max()), BFLOAT16_DN))
    return measures


def restoration(network: Network, case: Case, image: np.ndarray, gain_dn: float) -> list[Measure]:
    """What must hold of any network, by whatever it is run."""
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
    """What a restoration may not do to contrast and, on flat ground, to brightness."""
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
