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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count, product

import numpy as np
from scipy.special import stdtrit

from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import edge_mtf, slanted_edge
from beers_deploy.model.simulator.acquire import NOISE, acquire
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import scene_spectrum
from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.studies.evaluation.methods import Method

TARGETS = "targets"
"""The name of the table."""

OVERSAMPLING = 5
"""Scene pixels per pixel of all targets but flat fields."""

Edges = Sequence[tuple[float, np.ndarray]]
"""Angle in degrees and image of each slanted edge."""


@dataclass(frozen=True)
class Points:
    """Points of light on a flat background: the same noise with and without them.

    Attributes:
        background: radiance in W/m2/sr/um.
        seen: the image that the degraded sensor acquires, (H, W) digital numbers.
        flat: the same without points, acquired with the same random draws.
        wanted: the light of the points alone as the reference sensor sees it without noise, (H, W)
            digital numbers.
    """

    background: float
    seen: np.ndarray
    flat: np.ndarray
    wanted: np.ndarray


@dataclass(frozen=True)
class Pattern:
    """Bars or a zone plate.

    Attributes:
        name: of the figure.
        seen: the image that the degraded sensor acquires, (H, W) digital numbers.
        wanted: the image that the reference sensor acquires without noise, likewise.
        measured: True where the restored image is compared, (H, W).
    """

    name: str
    seen: np.ndarray
    wanted: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True)
class Targets:
    """Acquired targets, (H, W) digital numbers.

    Attributes:
        sensor: the sensor that acquired them.
        edges: slanted edges, each with independent noise.
        flats: radiance in W/m2/sr/um, and the flat field.
        points: points of light, one image for each background.
        patterns: bars and zone plates; several of one name are measured together.
    """

    sensor: Instrument
    edges: Edges
    flats: Sequence[tuple[float, np.ndarray]]
    points: Sequence[Points]
    patterns: Sequence[Pattern]


def acquire_targets(sensor: Instrument, reference: Instrument, seed: int) -> Targets:
    """Acquire all targets.

    Args:
        sensor: the sensor of the degraded images.
        reference: the sensor that is aimed at.
        seed: seed of the noise and of the places of the points within their pixels.
    """
    sensors = sensor, reference.in_units_of(sensor)
    # The first numbers are those of the edges, which draw their own noise (`acquire_edges`).
    draws = (Draw(seed, number) for number in count(len(ANGLES_DEG) * REPEATS))
    flats = []
    for radiance in RADIANCES:
        field = np.full((FLAT_PX, FLAT_PX), radiance, np.float32)
        flats.append((radiance, _acquire(field, sensor, next(draws), ratio=1)))
    points = [
        _acquire_points(background, *sensors, next(draws)) for background in POINT_BACKGROUNDS
    ]
    scenes = [*_bars(), *_zone_plates()]
    patterns = [_acquire_pattern(*scene, *sensors, next(draws)) for scene in scenes]
    return Targets(sensor, acquire_edges(sensor, seed), flats, points, patterns)


def _acquire(
    scene: np.ndarray, sensor: Instrument, draw: Draw, ratio: int = OVERSAMPLING
) -> np.ndarray:
    return acquire(
        scene_spectrum(scene), scene.shape[1], sensor, ratio, draw, "degraded", margin_px=0
    )


def _without_noise(scene: np.ndarray, sensor: Instrument, draw: Draw) -> np.ndarray:
    spectrum = scene_spectrum(scene)
    return acquire(
        spectrum, scene.shape[1], sensor, OVERSAMPLING, draw, "reference", margin_px=0, skip=NOISE
    )


def mean_figures(method: Method, targets: Targets) -> dict[str, Figure]:
    """Return MTF at Nyquist in % and SNR in flat fields of the restored targets, for the table of
    means.
    """
    figures = {"MTF at Nyquist": restored_mtf(method, targets.edges, targets.sensor.max_dn)}
    for radiance, flat in targets.flats:
        figures[snr_name(radiance)] = flat_figure(
            _middle(method.restore(flat)) - targets.sensor.offset_dn
        )
    return figures


def target_row(method: Method, targets: Targets) -> Row:
    """Return the row of a method in the table of targets: flux of points, and contrast transfer of
    patterns.
    """
    figures: dict[str, Figure] = {}
    for points in targets.points:
        figures |= flux_figures(method, points)
    for name in dict.fromkeys(pattern.name for pattern in targets.patterns):
        alike = [pattern for pattern in targets.patterns if pattern.name == name]
        figures[name] = transfer_figure(method, alike)
    return Row(TARGETS, method.name, figures, {"sensor": method.sensor_known})


def interval_of_mean(values: Sequence[float]) -> tuple[float, float]:
    """Return the 90 % interval of the mean of two or more independent values (Student's t)."""
    mean = float(np.mean(values))
    reach = (
        float(stdtrit(len(values) - 1, 0.95)) * float(np.std(values, ddof=1)) / len(values) ** 0.5
    )
    return mean - reach, mean + reach


# Slanted edges

ANGLES_DEG = (3.0, 5.0, 8.0, 11.0)
REPEATS = 3
SIDE_PX = 240
EDGE_PX = 80


def acquire_edges(sensor: Instrument, seed: int) -> Edges:
    """Acquire edges at several angles, each with independent noise."""
    edges = []
    for number, angle in enumerate(ANGLES_DEG * REPEATS):
        scene = slanted_edge(SIDE_PX, OVERSAMPLING, angle)
        edges.append((angle, _acquire(scene, sensor, Draw(seed, number))))
    return edges


def restored_mtf(method: Method, edges: Edges, max_dn: int) -> Figure:
    """Return the MTF at Nyquist in % of the edges that the method restored."""
    return mtf_figure(
        [edge_mtf(_middle(method.restore(edge)), angle, max_dn) for angle, edge in edges]
    )


def _middle(image: np.ndarray) -> np.ndarray:
    top, left = ((side - EDGE_PX) // 2 for side in image.shape)
    return image[top : top + EDGE_PX, left : left + EDGE_PX]


def mtf_figure(found: Sequence[float | Refusal]) -> Figure:
    """Return the mean over the edges with its 90 % interval; unavailable if most edges were
    refused.
    """
    values = [100 * edge for edge in found if not isinstance(edge, Refusal)]
    refusals = [edge for edge in found if isinstance(edge, Refusal)]
    if len(values) < max(len(refusals), 2):
        return unavailable(
            "%", f"{len(refusals)} of {len(found)} edges refused: {refusals[0].reason}"
        )
    source = f"{len(values)} of {len(found)} simulated slanted edges, 90 % interval of the mean"
    return measured(float(np.mean(values)), "%", source, interval_of_mean(values))


# Flat fields

FLAT_PX = 128
RADIANCES = (10.0, 25.0, 100.0)
"""Radiances of the flat fields, W/m2/sr/um."""


def snr_name(radiance: float) -> str:
    """Return the name of the SNR in a flat field of a radiance in W/m2/sr/um."""
    return f"SNR at {radiance:g} W/m2/sr/um"


def flat_figure(flat: np.ndarray) -> Figure:
    """Return the linear SNR of a flat field (h, w): its mean over its standard deviation."""
    mean = float(flat.mean(dtype=np.float64))
    deviation = float(flat.std(dtype=np.float64, ddof=1))
    # A denoiser may leave a field flat, and its SNR would be infinite.
    if deviation <= 1e-6 * mean:
        return unavailable("ratio", "nothing is left of the noise in a flat field")
    return measured(
        mean / deviation, "ratio", f"one flat field of {flat.shape[1]} x {flat.shape[0]}, L / sigma"
    )


# Points of light

POINT_BACKGROUNDS = (20.0, 100.0)
"""W/m2/sr/um."""
POINT_RADIANCES = (12.0, 40.0, 120.0)
"""Light of a point, as what it adds to the mean radiance of one pixel, W/m2/sr/um."""
POINTS_A_SIDE = 6
POINT_STEP_PX = 48
APERTURE_PX = 33
"""Side of the square over which the light of a point is added up.

A restoration may move light by its receptive field, and the consistency step by two of its blocks,
16 px.
"""


def flux_name(radiance: float, background: float) -> str:
    """Return the name of the flux of points of a radiance on a background, both in W/m2/sr/um."""
    return f"flux of points of {radiance:g} on {background:g} W/m2/sr/um"


def _acquire_points(
    background: float, sensor: Instrument, reference: Instrument, draw: Draw
) -> Points:
    # The same field without points, acquired with the same draws: the difference is their light.
    flat = np.full((POINTS_A_SIDE * POINT_STEP_PX * OVERSAMPLING,) * 2, background, np.float32)
    scene = flat.copy()
    generator = draw.generator("points")
    for row, column in _grid():
        # One scene pixel anywhere in its pixel: all phases of the sampling occur.
        y, x = ((at * POINT_STEP_PX + POINT_STEP_PX // 2) * OVERSAMPLING for at in (row, column))
        shift_y, shift_x = generator.integers(OVERSAMPLING, size=2)
        scene[y + shift_y, x + shift_x] += _point_radiance(row, column) * OVERSAMPLING**2
    light = _without_noise(scene, reference, draw) - _without_noise(flat, reference, draw)
    return Points(background, _acquire(scene, sensor, draw), _acquire(flat, sensor, draw), light)


def _grid() -> list[tuple[int, int]]:
    return [divmod(number, POINTS_A_SIDE) for number in range(POINTS_A_SIDE**2)]


def _point_radiance(row: int, column: int) -> float:
    return POINT_RADIANCES[(row + column) % len(POINT_RADIANCES)]


def flux_figures(method: Method, points: Points) -> dict[str, Figure]:
    """Return the flux in % of the points of each radiance.

    The background is what the method makes of the same flat field with the same random draws. Its
    noise is nearly the same at each pixel, so the difference measures far better than a ring around
    the point would.
    """
    light = method.restore(points.seen).astype(np.float64) - method.restore(points.flat)
    values: dict[float, list[float]] = {radiance: [] for radiance in POINT_RADIANCES}
    for row, column in _grid():
        place = _aperture(row), _aperture(column)
        flux = 100 * float(light[place].sum() / points.wanted[place].sum(dtype=np.float64))
        values[_point_radiance(row, column)].append(flux)
    figures = {}
    for radiance, fluxes in values.items():
        source = (
            f"mean of {len(fluxes)} points in {APERTURE_PX} x {APERTURE_PX} px, 90 % "
            "interval of the mean"
        )
        name = flux_name(radiance, points.background)
        figures[name] = measured(float(np.mean(fluxes)), "%", source, interval_of_mean(fluxes))
    return figures


def _aperture(number: int) -> slice:
    middle = number * POINT_STEP_PX + POINT_STEP_PX // 2
    return slice(middle - APERTURE_PX // 2, middle + APERTURE_PX // 2 + 1)


# Bars and zone plates

PATTERN_BACKGROUND = 100.0
"""W/m2/sr/um."""
OF_REFERENCE = "of the reference"
"""Unit of the contrast transfer: 1 is the contrast of the reference."""

BAR_CONTRASTS = (0.05, 0.10)
BAR_PERIODS_PX = (2.0, 8 / 3, 3.0)
"""Contrast is the amplitude of the wave over the background."""
BARS_PX = 144
BARS_MEASURED_PX = 64
"""The side is a multiple of all periods, since scenes wrap around at their borders."""

ZONE_CONTRASTS = (0.08, 0.30)
ZONE_BAND: tuple[float, float] = (0.35, 0.45)
"""Spatial frequencies that are measured, cycles per pixel."""
ZONE_PX = 288
ZONE_NYQUIST_PX = 96
"""Side, and the radius at which the pattern reaches half a cycle per pixel and ends."""


def _bars() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return the bars, each across and along the track: name, contrast (S, S) in scene pixels and
    the mask (H, W) of measured pixels.
    """
    middle = np.zeros((BARS_PX, BARS_PX), bool)
    place = slice((BARS_PX - BARS_MEASURED_PX) // 2, (BARS_PX + BARS_MEASURED_PX) // 2)
    middle[place, place] = True
    bars = []
    for contrast, period_px in product(BAR_CONTRASTS, BAR_PERIODS_PX):
        # The crests lie on the centres of pixels: otherwise bars of a period of 2 px would be lost
        # in the sampling.
        wave = np.cos(2 * math.pi * _places_px(BARS_PX) / period_px)
        across = np.broadcast_to(contrast * wave, (wave.size, wave.size))
        name = f"bars of {contrast:.0%}, period {period_px:.3g} px"
        bars += [(name, across, middle), (name, across.T, middle)]
    return bars


def _zone_plates() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return zone plates, cos(pi / 2 r^2 / R): r / 2R cycles per pixel at the radius r."""
    frequency = _radius_px(ZONE_PX, 1) / (2 * ZONE_NYQUIST_PX)
    ring = (frequency >= ZONE_BAND[0]) & (frequency <= ZONE_BAND[1])
    radius_px = _radius_px(ZONE_PX, OVERSAMPLING)
    # It ends at the radius where it reaches Nyquist: beyond it the sampling would alias.
    chirp = np.cos(math.pi / 2 * radius_px**2 / ZONE_NYQUIST_PX) * (radius_px < ZONE_NYQUIST_PX)
    return [
        (f"zone plate of {contrast:.0%}", contrast * chirp, ring) for contrast in ZONE_CONTRASTS
    ]


def _places_px(side_px: int, ratio: int = OVERSAMPLING) -> np.ndarray:
    """Return where the scene pixels of a side lie, in pixels: 0 is the centre
    of the first pixel.
    """
    return (np.arange(side_px * ratio) - (ratio - 1) / 2) / ratio


def _radius_px(side_px: int, ratio: int) -> np.ndarray:
    """Return the distance of every scene pixel from the middle, (side_px *
    ratio,) * 2, in pixels.
    """
    place = _places_px(side_px, ratio) - (side_px - 1) / 2
    return np.hypot(place[:, None], place)


def _acquire_pattern(
    name: str,
    contrast: np.ndarray,
    mask: np.ndarray,
    sensor: Instrument,
    reference: Instrument,
    draw: Draw,
) -> Pattern:
    scene = (PATTERN_BACKGROUND * (1 + contrast)).astype(np.float32)
    return Pattern(
        name, _acquire(scene, sensor, draw), _without_noise(scene, reference, draw), mask
    )


def transfer_figure(method: Method, patterns: Sequence[Pattern]) -> Figure:
    """Return the mean contrast transfer over the quarters of each pattern, with
    its 90 % interval.
    """
    values: list[float] = []
    for pattern in patterns:
        values += _transfers(method.restore(pattern.seen), pattern)
    source = f"{len(values)} parts of {len(patterns)} simulated patterns, 90 % interval of the mean"
    return measured(float(np.mean(values)), OF_REFERENCE, source, interval_of_mean(values))


def _transfers(restored: np.ndarray, pattern: Pattern) -> list[float]:
    """Return the slope of the least-squares fit of a restored pattern on the wanted one, in each
    quarter.
    """
    slopes = []
    height, width = restored.shape
    for number in range(4):
        below, right = divmod(number, 2)
        rows = slice(below * height // 2, (below + 1) * height // 2)
        columns = slice(right * width // 2, (right + 1) * width // 2)
        mask = pattern.measured[rows, columns]
        truth = pattern.wanted[rows, columns][mask].astype(np.float64)
        # Without the mean the slope tells contrast alone, whatever the level of the image.
        truth -= truth.mean()
        slopes.append(float(truth @ restored[rows, columns][mask] / (truth @ truth)))
    return slopes
