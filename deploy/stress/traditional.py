"""The traditional chain on a hard case: stabilise, NL-Bayes, MTF compensation."""

import numpy as np
import torch

from deploy.stress.cases import Case
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
from deploy.stress.simulator import sensor_of
from deploy.stress.subject import Subject
from model.traditional.pipeline import Chain, restore_strips, restore_traditional
from profiles import load_sensor

REFERENCE = "pleiades-reference"
GAIN_DN = 64.0
FLOAT32_DN = 4.0
RINGING_PERCENT, REACH_PX = 100.0, 19
STRIP_PX, CROP_PX = 13, 64


def traditional(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """The chain for the case's sensor, at quality "fast", on 64 x 64 pixels of larger images."""
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
    measures.append(_threads(image, chain, result))
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
        Measure("error against float64", float(np.abs(result - exact).max()), FLOAT32_DN),
    ]
    return [*measures, mean_shift(result, image, FLAT_DN)] if case.flat else measures


def _restored(image: np.ndarray, chain: Chain) -> np.ndarray:
    return np.asarray(restore_traditional(torch.from_numpy(np.asarray(image, np.float32)), chain).numpy())


def _strips(image: np.ndarray, chain: Chain, result: np.ndarray) -> Measure:
    strips = [torch.from_numpy(image[top : top + STRIP_PX]) for top in range(0, len(image), STRIP_PX)]
    joined = torch.cat(list(restore_strips(strips, len(image), chain))).numpy()
    return differing("strips differ", result, joined)


def _threads(image: np.ndarray, chain: Chain, result: np.ndarray) -> Measure:
    with torch_threads(torch.get_num_threads() + 1):
        return differing("threads differ", result, _restored(image, chain))
