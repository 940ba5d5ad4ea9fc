"""Noise and MTF of a camera, from its raw frames."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from beers_deploy.model.metrics.edge_curve import (
    MOST_MISSING,
    WIDEST,
    MtfCurve,
    apart,
    measure_curve,
    search_curve,
)
from beers_deploy.model.metrics.edge_search import Edge, edge_in, find_edges
from beers_deploy.model.metrics.noise_line import (
    Blocks,
    NoiseModel,
    cut_blocks,
    cut_pair,
    fit_noise_model,
    join,
)
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.progress import steps
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.response import NYQUIST
from beers_deploy.restoration.sensor_check import NOISE_KEPT
from beers_deploy.studies.characterize.frames import Frames

SEED = 0
AXES = ("across", "along")
OWN_LEAK = 0.1
"""Of the finest detail of one frame, what may be texture where its noise is held against the
others'.
"""
STILL_STRUCTURE = 2.0
STILL_DRIFT = 0.02
"""Of the difference of two frames of a still scene: structure over noise, and the largest change of
level.
"""


@dataclass(frozen=True)
class Noise:
    """The noise of frames, above the dark, and whether it comes from pairs of frames of one still
    scene.
    """

    model: NoiseModel
    pairs: int


def measure_noise(frames: Frames) -> Noise:
    """Fit the noise line to all frames, or to the differences of those that
    show one still scene.
    """
    frame_blocks = [
        _above_dark(join([_cut(tile, frames) for tile in frames.tiles(path)]), frames)
        for path in frames.paths
    ]
    # The difference of two frames of a still scene holds no texture.
    still = [_above_dark(blocks, frames) for blocks in _still_pairs(frames)]
    model = fit_noise_model(
        join(still or frame_blocks), np.random.default_rng(SEED), incomplete=True
    )
    if isinstance(model, Refusal):
        raise ImageError(
            f"The noise of {frames.name} cannot be measured: {model.reason}. It is measured on "
            "blurred, raw ground from dark to bright: give more raw images of plain ground, dark "
            "and bright, neither restored nor resampled."
        )
    if not still:
        _require_one_sensor(frames, frame_blocks, math.sqrt(math.prod(model.measured_dn)))
    return Noise(model, len(still))


def _cut(pixels: np.ndarray, frames: Frames) -> Blocks:
    return cut_blocks(pixels, frames.full_scale_dn)


def _above_dark(blocks: Blocks, frames: Frames) -> Blocks:
    """The blocks with their means counted from the black level."""
    return blocks._replace(mean=np.maximum(blocks.mean - frames.black_dn, 0.0))


def _still_pairs(frames: Frames) -> list[Blocks]:
    """Differences of frames that show the same scene, pixel by pixel: photon transfer."""
    # Two frames of a still scene have one level: sorted by it, they are neighbours.
    by_level = sorted(frames.paths, key=lambda path: float(np.median(frames.read(path))))
    differences = []
    for one, other in pairwise(by_level):
        first = frames.read(one)
        second = frames.read(other)
        level = float(np.median(first))
        if (
            first.shape != second.shape
            or abs(float(np.median(second)) - level) > STILL_DRIFT * level
        ):
            continue
        blocks = cut_pair(first, second, frames.full_scale_dn)
        if not blocks.mean.size:
            continue
        # Structure that is left in the difference means that the scene or the camera moved.
        structure = blocks.structure / np.maximum(blocks.fine, 1e-9)
        if float(np.median(structure)) < STILL_STRUCTURE:
            differences.append(blocks)
    return differences


def _require_one_sensor(frames: Frames, frame_blocks: Sequence[Blocks], dn: float) -> None:
    """Refuse frames whose own noise at a digital number differs: of another gain, or processed."""
    if len(frame_blocks) == 1:
        return
    variances = {}
    for path, blocks in zip(frames.paths, frame_blocks, strict=True):
        line = fit_noise_model(blocks, np.random.default_rng(SEED), incomplete=True)
        # A frame whose finest detail may be texture tells too little of its noise.
        if isinstance(line, NoiseModel) and line.leak <= OWN_LEAK:
            variances[path.name] = line.at(dn)
    if not variances:
        return
    # The ends of the intervals are compared, so that frames which may be alike pass.
    least = min(variances, key=lambda name: variances[name].interval[1])
    most = max(variances, key=lambda name: variances[name].interval[0])
    if variances[most].interval[0] > NOISE_KEPT * variances[least].interval[1]:
        low, high = (f"{variances[name].value:.3g} DN^2 in {name}" for name in (least, most))
        raise ImageError(
            "The `images` must be of one sensor at one setting, but the noise variance at "
            f"{dn:.4g} DN above the dark is {low} and {high}: they differ in gain, or one was "
            "processed. Characterise them separately."
        )


@dataclass(frozen=True)
class Mtf:
    """The curve of each axis that edges show, and for each other axis why there is none."""

    curves: dict[str, MtfCurve]
    reasons: dict[str, str]


Variance = Callable[[np.ndarray], np.ndarray]


def measure_mtf(frames: Frames, boxes: Mapping[str, np.ndarray], noise: NoiseModel) -> Mtf:
    """Measure the MTF across (edges near the vertical) and along the track.

    Args:
        frames: of the camera.
        boxes: pixels (h, w) with one edge each, by the words that name them; none searches all
            frames.
        noise: of the pixels, above the dark.
    """

    def variance(dn: np.ndarray) -> np.ndarray:
        return noise.total(dn - frames.black_dn)

    edges = _pointed_at(frames, boxes, variance) if boxes else _found(frames, variance)
    # Edges in boxes all count; searched ones count if they are as sharp as the sharpest.
    measure = measure_curve if boxes else search_curve
    generator = np.random.default_rng(SEED)
    curves: dict[str, MtfCurve] = {}
    reasons: dict[str, str] = {}
    for axis in AXES:
        curve = measure(edges[axis], generator)
        if isinstance(curve, Refusal):
            reasons[axis] = curve.reason
        elif curve.missing_edges:
            reasons[axis] = _too_wide(curve)
        else:
            curves[axis] = curve
    if len(curves) == len(AXES):
        across, along = (curves[axis] for axis in AXES)
        curves = {"across": apart(across, along), "along": apart(along, across)}
    return Mtf(curves, reasons)


def _pointed_at(
    frames: Frames, boxes: Mapping[str, np.ndarray], variance: Variance
) -> dict[str, list[Edge]]:
    """The edges in boxes, those near the horizontal turned upright."""
    edges: dict[str, list[Edge]] = {axis: [] for axis in AXES}
    for words, region in boxes.items():
        lies = _rise(region.T) > _rise(region)
        # An edge near the horizontal is turned upright, because edges are measured along the rows.
        edge = edge_in(region.T if lies else region, variance, words)
        if region.min() <= 0 or region.max() >= frames.full_scale_dn:
            edge = Refusal("clipped pixels")
        if isinstance(edge, Refusal):
            raise ImageError(
                f"The box {words} must have one straight edge, from side to side, but it does "
                f"not: {edge.reason}. Box another edge, or draw a tighter box."
            )
        edges["along" if lies else "across"].append(edge)
    return edges


def _found(frames: Frames, variance: Variance) -> dict[str, list[Edge]]:
    """The edges of all frames, those near the horizontal turned upright."""
    edges: dict[str, list[Edge]] = {axis: [] for axis in AXES}
    with steps("looking for edges", len(frames.paths)) as bar:
        for path in frames.paths:
            for tile in frames.tiles(path):
                edges["across"] += find_edges(tile, variance, frames.full_scale_dn, path.name)
                edges["along"] += find_edges(tile.T, variance, frames.full_scale_dn, path.name)
            bar.advance()
    return edges


def _rise(region: np.ndarray) -> float:
    """How much brighter one side is than the other, along the rows."""
    first, *_, last = np.array_split(region, 3, axis=1)
    return abs(float(last.mean() - first.mean()))


def _too_wide(curve: MtfCurve) -> str:
    """Why a curve is not written, and what would help."""
    value, (low, high) = curve.at(NYQUIST)
    count = f"{curve.edges} edge{'' if curve.edges == 1 else 's'}"
    odd = (
        f"; these differ from the others: {', '.join(curve.contradicting)}"
        if curve.contradicting
        else ""
    )
    remedy = f"about {curve.missing_edges} more such edges would do"
    if curve.missing_edges == MOST_MISSING:
        remedy = "that is hardly any contrast, and more edges would not help"
    return (
        f"{count} leave {value:.2%} [{low:.2%}, {high:.2%}] at Nyquist, wider than a factor of "
        f"{WIDEST:g}: "
        f"{remedy}{odd}"
    )


@dataclass(frozen=True)
class Snr:
    """The SNR at one radiance, in W/m2/sr/um, with its 95 % interval (its end may be infinite)."""

    radiance: float
    value: float
    interval: tuple[float, float]
    extrapolated: bool


def snr_at(noise: NoiseModel, dn: float, gain: float) -> Snr:
    """The SNR at a digital number above the dark, the rounding not in it."""
    variance = noise.at(dn)
    # The lowest SNR belongs to the highest variance.
    low, value, high = (
        dn / math.sqrt(dn2) if dn2 > 0 else math.inf
        for dn2 in (variance.interval[1], variance.value, variance.interval[0])
    )
    return Snr(dn / gain, value, (low, high), variance.extrapolated)
