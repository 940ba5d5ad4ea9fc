"""Measure the blur and noise of a sensor on raw images of any scene.

`characterize` writes them into a profile; the sensor check compares them with one.

- Noise: blocks of 16 x 16 pixels (`noise_blocks`), and the line that fits them (`noise_line`).
- Blur: straight edges along both axes. Short ones give the MTF at Nyquist by the curve that a
  profile states (`edge_blur`); all edges jointly give a curve of any shape (`edge_curve`).
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from beers_deploy.model.metrics import edge_blur
from beers_deploy.model.metrics.edge_blur import AxisMtf
from beers_deploy.model.metrics.edge_curve import (
    MOST_MISSING,
    WIDEST,
    MtfCurve,
    apart,
    measure_curve,
    search_curve,
)
from beers_deploy.model.metrics.edge_fit import EdgeBlur, Noise
from beers_deploy.model.metrics.edge_search import Edge
from beers_deploy.model.metrics.noise_blocks import Blocks, cut_blocks, join
from beers_deploy.model.metrics.noise_line import SEED, Variance
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.response import NYQUIST

AXES = ("across", "along")
"""The axes relative to the track. Edges near the vertical show the blur across it."""
EDGES = 20
"""The number of short edges that suffices along an axis. More would take time without improving the
result.
"""
STEP_PX = 4
CELL_PX = (8, 4)
FEW_WINDOWS = 4
"""The search for short edges: every STEP_PX-th row, in cells of CELL_PX. An image of at most this
number of windows may have few edges, so it is searched as thoroughly as by `characterize`.
"""
CANDIDATES = 6000
CANDIDATES_OF_WINDOW = 400
"""The number of steepest places along an axis that are compared with plain edges: of all windows,
and at least of each.
"""
FITS = 128
FITS_OF_WINDOW = 8
"""The number of squares along an axis that are fitted: of all windows, and at least of each. A fit
takes 1 ms (measured).
"""
WINDOWS_AT_ONCE = 4
"""The number of windows whose squares are fitted together; fewer at a time take longer."""


def image_blocks(images: Iterable[np.ndarray], clipped_at: float, black_dn: float = 0.0) -> Blocks:
    """Cut images of one sensor into the blocks of 16 x 16 pixels from which its noise is measured.

    Args:
        images: digital numbers (H, W) of each image.
        clipped_at: the smallest digital number that counts as clipped. Blocks with such a pixel, or
            with one of 0, are left out.
        black_dn: the digital number without light, which is subtracted from the means of the
            blocks; these end at 0.
    """
    return above_black(join([cut_blocks(image, clipped_at) for image in images]), black_dn)


def above_black(blocks: Blocks, black_dn: float) -> Blocks:
    """Return blocks with the black level, the digital number without light, subtracted from their
    means.
    """
    return blocks._replace(mean=np.maximum(blocks.mean - black_dn, 0.0))


def snr(signal_dn: float, variance: Variance) -> tuple[float, tuple[float, float]]:
    """Compute the SNR of a signal and its 95 % interval; infinite without noise.

    Args:
        signal_dn: the signal in DN above the digital number without light.
        variance: the variance of the noise at this signal.
    """
    # The lowest SNR belongs to the highest variance.
    low, value, high = (
        signal_dn / math.sqrt(dn2) if dn2 > 0 else math.inf
        for dn2 in (variance.interval[1], variance.value, variance.interval[0])
    )
    return value, (low, high)


def axis_mtfs(
    windows: Sequence[np.ndarray], noise: Noise, clipped_at: float
) -> dict[str, AxisMtf | Refusal]:
    """Measure the MTF at Nyquist along both axes by short edges in windows of an image.

    Args:
        windows: (h, w) each, finite values; 0 where pixels are missing.
        noise: returns the variance of the noise of pixels of given values.
        clipped_at: the smallest value that counts as clipped.

    Returns:
        For each of "across" and "along" the track the MTF, or the reason why there is none.
    """
    turned = [window.T for window in windows]
    across = _short_edges(windows, noise, clipped_at)
    along = _short_edges(turned, noise, clipped_at)
    return {"across": _combined(across, along), "along": _combined(along, across)}


def _combined(own: Sequence[EdgeBlur], others: Sequence[EdgeBlur]) -> AxisMtf | Refusal:
    if len(own) < edge_blur.MIN_EDGES:
        return Refusal(f"{len(own)} straight edges, {edge_blur.MIN_EDGES} are needed")
    return edge_blur.combine(own, others)


def _short_edges(windows: Sequence[np.ndarray], noise: Noise, clipped_at: float) -> list[EdgeBlur]:
    """Return blurs across near-vertical edges, from as many windows as are needed."""
    blurs = list[EdgeBlur]()
    count = len(windows)
    # An image of one window has few edges. With 400 candidates a wrong MTF was seen in 7 and 22 of
    # 40 drawn towns (a third less, a third more), with 6000 of every row in 14 and 27.
    effort = edge_blur.Effort(
        step_px=1 if count <= FEW_WINDOWS else STEP_PX,
        cell_px=edge_blur.THOROUGH.cell_px if count <= FEW_WINDOWS else CELL_PX,
        candidates=max(CANDIDATES // count, CANDIDATES_OF_WINDOW),
        fits=max(FITS // count, FITS_OF_WINDOW),
    )
    for first in range(0, count, WINDOWS_AT_ONCE):
        if len(blurs) < EDGES:
            several = windows[first : first + WINDOWS_AT_ONCE]
            squares = [
                edge_blur.plain_squares(window, noise, clipped_at, effort) for window in several
            ]
            blurs += edge_blur.blurs_of(np.concatenate(squares), noise)
    return blurs[:EDGES]


def axis_curves(
    edges: Mapping[str, Sequence[Edge]], searched: bool
) -> dict[str, MtfCurve | Refusal]:
    """Measure the whole MTF curve along both axes.

    Args:
        edges: the edges by the axis whose blur they show, "across" or "along" the track. Those near
            the horizontal are transposed.
        searched: True if the edges were found by search, so that only the sharpest are used; False
            if a person confirms them.

    Returns:
        For each of "across" and "along" the curve, or the reason why there is none.
    """
    measure = search_curve if searched else measure_curve
    generator = np.random.default_rng(SEED)
    across, along = (_narrow(measure(edges[axis], generator)) for axis in AXES)
    if isinstance(across, MtfCurve) and isinstance(along, MtfCurve):
        return {"across": apart(across, along), "along": apart(along, across)}
    return {"across": across, "along": along}


def _narrow(curve: MtfCurve | Refusal) -> MtfCurve | Refusal:
    """Return the curve; if it is too uncertain, return the reason and what would help."""
    if isinstance(curve, Refusal) or not curve.missing_edges:
        return curve
    value, (low, high) = curve.at(NYQUIST)
    count = counted(curve.edges, "edge")
    odd = (
        f"; these differ from the others: {', '.join(curve.contradicting)}"
        if curve.contradicting
        else ""
    )
    remedy = f"about {curve.missing_edges} more such edges would do"
    if curve.missing_edges == MOST_MISSING:
        remedy = "that is hardly any contrast, and more edges would not help"
    return Refusal(
        f"{count} leave {value:.2%} [{low:.2%}, {high:.2%}] at Nyquist, wider than a factor of "
        f"{WIDEST:g}: {remedy}{odd}"
    )
