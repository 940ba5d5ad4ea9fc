"""Figures of one method on targets whose truth is known: MTF, noise, flux of points and transfer of
faint contrast.

The degraded sensor acquires every target as it acquires scenes, and the method restores it.

1. Slanted edges with a step of 160 W/m2/sr/um give the MTF at Nyquist. A method that adapts to its
  input may treat faint texture otherwise, so 4. and 5. are needed too.
2. Flat fields give the SNR where there is nothing to see.
3. Points of light on a flat background give the flux: the light of a point after restoration over
  the light in the image that the reference sensor acquires without noise.
4. Sinusoidal bars, and 5. zone plates, give the contrast transfer: the slope of the least-squares
  fit of the restored image on the image that the reference sensor acquires without noise. It is 1
  if the method reaches the reference.

Restored images are measured away from their borders.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import edge_mtf
from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.target_scenes import (
    POINT_RADIANCES,
    POINT_STEP_PX,
    Edges,
    Pattern,
    Targets,
    point_places,
    point_radiance,
)

TARGETS = "targets"
"""The name of the table."""

EDGE_PX = 80
"""Side of the middle of edges and flat fields that is measured."""
APERTURE_PX = 33
"""Side of the square over which the light of a point is summed.

A restoration may move light by its receptive field, and the consistency step by two of its blocks,
16 px.
"""
OF_REFERENCE = "of the reference"
"""Unit of the contrast transfer: 1 is the contrast of the reference."""


def mean_figures(method: Method, targets: Targets) -> dict[str, Figure]:
    """Restore edges and flat fields by a method, and measure the MTF and the SNR of the results.

    Args:
        method: the method.
        targets: the acquired targets.

    Returns:
        The MTF at Nyquist in % and the SNR at each radiance, by name, for the table of means.
    """
    figures = {"MTF at Nyquist": restored_mtf(method, targets.edges, targets.sensor.max_dn)}
    for radiance, flat in targets.flats:
        figures[snr_name(radiance)] = flat_figure(
            _middle(method.restore(flat)) - targets.sensor.offset_dn
        )
    return figures


def target_row(method: Method, targets: Targets) -> Row:
    """Restore points and faint patterns by a method, and measure how much light and contrast is
    left.

    Args:
        method: the method.
        targets: the acquired targets.

    Returns:
        The row of the method in the table of targets: the flux of points in % (the light of a point
        over its light in the image that the reference sensor acquires without noise), and the
        contrast of patterns relative to the reference.
    """
    figures: dict[str, Figure] = {}
    for points in targets.points:
        # The difference from the same background without points, with the same noise, is much more
        # accurate than one with a ring around the point would be.
        light = method.restore(points.acquired).astype(np.float64) - method.restore(points.flat)
        values: dict[float, list[float]] = {radiance: [] for radiance in POINT_RADIANCES}
        for row, column in point_places():
            place = _aperture(row), _aperture(column)
            flux = 100 * float(light[place].sum() / points.expected[place].sum(dtype=np.float64))
            values[point_radiance(row, column)].append(flux)
        for radiance, fluxes in values.items():
            source = f"mean of {len(fluxes)} points in {APERTURE_PX} x {APERTURE_PX} px"
            figures[flux_name(radiance, points.background)] = _mean(fluxes, "%", source)
    for name in dict.fromkeys(pattern.name for pattern in targets.patterns):
        alike = [pattern for pattern in targets.patterns if pattern.name == name]
        figures[name] = transfer_figure(method, alike)
    return Row(TARGETS, method.name, figures, {"sensor": method.sensor_known})


def _mean(values: Sequence[float], unit: str, source: str) -> Figure:
    """Return the mean of two or more independent values, with its 90 % interval by Student's t
    distribution.
    """
    mean = float(np.mean(values))
    reach = (
        float(stdtrit(len(values) - 1, 0.95)) * float(np.std(values, ddof=1)) / len(values) ** 0.5
    )
    words = f"{source}, 90 % interval of the mean"
    return measured(mean, unit, words, (mean - reach, mean + reach))


def restored_mtf(method: Method, edges: Edges, max_dn: int) -> Figure:
    """Restore slanted edges by a method, and measure the MTF at Nyquist of the results in %.

    Args:
        method: the method.
        edges: angle in degrees and image, digital numbers (H, W), of each edge.
        max_dn: the largest digital number, at which pixels clip.
    """
    return mtf_figure(
        [edge_mtf(_middle(method.restore(edge)), angle, max_dn) for angle, edge in edges]
    )


def _middle(image: np.ndarray) -> np.ndarray:
    top, left = ((side - EDGE_PX) // 2 for side in image.shape)
    return image[top : top + EDGE_PX, left : left + EDGE_PX]


def mtf_figure(edges: Sequence[float | Refusal]) -> Figure:
    """Average the MTF at Nyquist over edges.

    Args:
        edges: the MTF of each edge as a share, or the reason why it could not be measured.

    Returns:
        The mean in % with its 90 % interval. It is unavailable if fewer than two edges, or fewer
        than half of them, were measured.
    """
    values = [100 * edge for edge in edges if not isinstance(edge, Refusal)]
    refusals = [edge for edge in edges if isinstance(edge, Refusal)]
    if len(values) < max(len(refusals), 2):
        return unavailable(
            "%", f"{len(refusals)} of {len(edges)} edges refused: {refusals[0].reason}"
        )
    return _mean(values, "%", f"{len(values)} of {len(edges)} simulated slanted edges")


def snr_name(radiance: float) -> str:
    """Return the name of the figure of the SNR in a flat field.

    Args:
        radiance: the radiance of the field in W/m2/sr/um.
    """
    return f"SNR at {radiance:g} W/m2/sr/um"


def flat_figure(flat: np.ndarray) -> Figure:
    """Return the SNR of a flat field as a ratio: its mean over its standard deviation.

    Args:
        flat: digital numbers (h, w) of a restored flat field, minus those of the dark.

    Returns:
        The figure. It is unavailable if a denoiser left no noise.
    """
    mean = float(flat.mean(dtype=np.float64))
    deviation = float(flat.std(dtype=np.float64, ddof=1))
    # A denoiser may leave a field flat, and its SNR would be infinite.
    if deviation <= 1e-6 * mean:
        return unavailable("ratio", "nothing is left of the noise in a flat field")
    return measured(
        mean / deviation, "ratio", f"one flat field of {flat.shape[1]} x {flat.shape[0]}, L / sigma"
    )


def flux_name(radiance: float, background: float) -> str:
    """Return the name of the figure of the flux of points.

    Args:
        radiance: the light of a point, in W/m2/sr/um over one pixel.
        background: the radiance of the background, in W/m2/sr/um.
    """
    return f"flux of points of {radiance:g} on {background:g} W/m2/sr/um"


def _aperture(number: int) -> slice:
    middle = number * POINT_STEP_PX + POINT_STEP_PX // 2
    return slice(middle - APERTURE_PX // 2, middle + APERTURE_PX // 2 + 1)


def transfer_figure(method: Method, patterns: Sequence[Pattern]) -> Figure:
    """Restore faint patterns by a method, and measure the contrast transfer: the contrast in the
    result relative to that in the image that the reference sensor acquires without noise.

    Args:
        method: the method.
        patterns: the acquired patterns of one name.

    Returns:
        The mean over the quarters of all patterns, with its 90 % interval; 1 is the contrast of the
        reference.
    """
    values = []
    for pattern in patterns:
        restored = method.restore(pattern.acquired)
        height, width = restored.shape
        for number in range(4):
            below, right = divmod(number, 2)
            rows = slice(below * height // 2, (below + 1) * height // 2)
            columns = slice(right * width // 2, (right + 1) * width // 2)
            mask = pattern.measured[rows, columns]
            truth = pattern.expected[rows, columns][mask].astype(np.float64)
            # Without the mean, the slope of the least-squares fit depends only on contrast, not on
            # the level of the image.
            truth -= truth.mean()
            values.append(float(truth @ restored[rows, columns][mask] / (truth @ truth)))
    source = f"{len(values)} parts of {len(patterns)} simulated patterns"
    return _mean(values, OF_REFERENCE, source)
