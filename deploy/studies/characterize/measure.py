"""Measure noise and MTF of a sensor from its raw frames (`model.metrics.instrument`)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from beers_deploy.model.metrics.edge_curve import MtfCurve
from beers_deploy.model.metrics.edge_search import Edge, edge_in, find_edges
from beers_deploy.model.metrics.instrument import (
    AXES,
    above_black,
    axis_curves,
    image_blocks,
)
from beers_deploy.model.metrics.noise_blocks import Blocks, cut_pair, join
from beers_deploy.model.metrics.noise_line import NoiseModel, fit_noise
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.progress import steps
from beers_deploy.profiles.errors import ImageError
from beers_deploy.restoration.sensor_check.comparison import NOISE_FACTOR
from beers_deploy.studies.characterize.frames import Frames

OWN_LEAK = 0.1
"""The share of the finest detail of one frame that may be texture when its noise is compared with
that of others.
"""
STILL_STRUCTURE = 2.0
STILL_DRIFT = 0.02
"""Limits for the difference of two frames of a still scene: structure over noise, and the largest
change of level.
"""


@dataclass(frozen=True)
class Noise:
    """The noise of a camera, as measured in its raw images.

    Attributes:
        model: the variance of the noise as a straight line over the digital number above the black
            level.
        pairs: the number of pairs of images of one still scene whose differences the line was
            fitted to; 0 if it was fitted to single images.
    """

    model: NoiseModel
    pairs: int


def measure_noise(frames: Frames) -> Noise:
    """Measure the noise of a camera in its raw images.

    If some images show the same scene pixel by pixel, their differences are used, because these
    contain no texture; otherwise the even ground in all images.

    Raises:
        ImageError: the noise cannot be measured, or the images differ in noise, so that they are
            not of one sensor at one setting.
    """
    frame_blocks = [
        image_blocks(frames.tiles(path), frames.full_scale_dn, frames.black_dn)
        for path in frames.paths
    ]
    still = [above_black(blocks, frames.black_dn) for blocks in _still_pairs(frames)]
    model = fit_noise(join(still or frame_blocks), incomplete=True)
    if isinstance(model, Refusal):
        raise ImageError(
            f"The noise of {frames.name} cannot be measured: {model.reason}. It is measured on "
            "blurred, raw ground from dark to bright: give more raw images of plain ground, dark "
            "and bright, neither restored nor resampled."
        )
    if not still and len(frame_blocks) > 1:
        _require_one_sensor(frames, frame_blocks, math.sqrt(math.prod(model.measured_dn)))
    return Noise(model, len(still))


def _still_pairs(frames: Frames) -> Iterator[Blocks]:
    """Yield the blocks of the difference of each two frames that show the same scene.

    Pixel by pixel, such a difference holds no texture (photon transfer).
    """
    # Two frames of a still scene have one level: sorted by it, they are neighbours.
    by_level = sorted(frames.paths, key=lambda path: float(np.median(frames.read(path))))
    for one, other in pairwise(by_level):
        first = frames.read(one)
        second = frames.read(other)
        level = float(np.median(first))
        drift = abs(float(np.median(second)) - level)
        if first.shape != second.shape or drift > STILL_DRIFT * level:
            continue
        blocks = cut_pair(first, second, frames.full_scale_dn)
        if not blocks.mean.size:
            continue
        # Structure that is left in the difference means that the scene or the camera moved.
        structure = blocks.structure / np.maximum(blocks.fine, 1e-9)
        if float(np.median(structure)) < STILL_STRUCTURE:
            yield blocks


def _require_one_sensor(frames: Frames, frame_blocks: Sequence[Blocks], dn: float) -> None:
    """Raise ImageError if the frames' noise at a digital number differs, because they have another
    gain or were processed.
    """
    variances = {}
    for path, blocks in zip(frames.paths, frame_blocks, strict=True):
        line = fit_noise(blocks, incomplete=True)
        # A frame whose finest detail may be texture shows too little of its noise.
        if isinstance(line, NoiseModel) and line.leak <= OWN_LEAK:
            variances[path.name] = line.at(dn)
    if not variances:
        return
    # The limits of the intervals are compared, so that frames which may be equal pass.
    least = min(variances, key=lambda name: variances[name].interval[1])
    most = max(variances, key=lambda name: variances[name].interval[0])
    if variances[most].interval[0] > NOISE_FACTOR * variances[least].interval[1]:
        low, high = (f"{variances[name].value:.3g} DN^2 in {name}" for name in (least, most))
        raise ImageError(
            "The `images` must be of one sensor at one setting, but the noise variance at "
            f"{dn:.4g} DN above the dark is {low} and {high}: they differ in gain, or one was "
            "processed. Characterise them separately."
        )


def measure_mtf(
    frames: Frames, boxes: Mapping[str, np.ndarray], noise: NoiseModel
) -> dict[str, MtfCurve | Refusal]:
    """Measure the MTF of a camera across and along the track, from straight edges in its images.

    Args:
        frames: the raw images of the camera.
        boxes: digital numbers (h, w) with one edge each, by the text of the box; if empty, edges
            are searched in all images.
        noise: the noise as a function of the digital number above the black level.

    Returns:
        By the axis, "across" (from edges near the vertical) and "along", the measured curve, or the
        reason why there is none.

    Raises:
        ImageError: a box has no straight edge from side to side.
    """

    def variance(dn: np.ndarray) -> np.ndarray:
        return noise.total(dn - frames.black_dn)

    full_scale_dn = frames.full_scale_dn
    edges: dict[str, list[Edge]] = {axis: [] for axis in AXES}
    for words, region in boxes.items():
        lies = _rise(region.T) > _rise(region)
        # An edge near the horizontal is turned upright, because edges are measured along the rows.
        edge = edge_in(region.T if lies else region, variance, words)
        if region.min() <= 0 or region.max() >= full_scale_dn:
            edge = Refusal("clipped pixels")
        if isinstance(edge, Refusal):
            raise ImageError(
                f"The box {words} must have one straight edge, from side to side, but it does "
                f"not: {edge.reason}. Box another edge, or draw a tighter box."
            )
        edges["along" if lies else "across"].append(edge)
    if not boxes:
        with steps("looking for edges", len(frames.paths)) as bar:
            for path in frames.paths:
                for tile in frames.tiles(path):
                    edges["across"] += find_edges(tile, variance, full_scale_dn, path.name)
                    edges["along"] += find_edges(tile.T, variance, full_scale_dn, path.name)
                bar.advance()
    # Edges in boxes all count; searched ones count if they are as sharp as the sharpest.
    return axis_curves(edges, searched=not boxes)


def _rise(region: np.ndarray) -> float:
    """Return the difference in brightness between both sides, along the rows."""
    first, *_, last = np.array_split(region, 3, axis=1)
    return abs(float(last.mean() - first.mean()))


@dataclass(frozen=True)
class Snr:
    """The SNR of a camera at one radiance.

    Attributes:
        radiance: the radiance in W/m2/sr/um.
        value: the SNR as a ratio; infinite without noise.
        interval: the lower and upper end of its 95 % interval, which may be infinite.
        extrapolated: True if no pixels of this radiance were measured.
    """

    radiance: float
    value: float
    interval: tuple[float, float]
    extrapolated: bool
