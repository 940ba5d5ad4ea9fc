"""An image held against the sensor it is said to be from: its noise and its blur, by its own pixels
alone.

Windows spread over the image give a noise line (`model.metrics.noise_line`) and straight edges
(`model.metrics.edge_blur`). Where their 95 % intervals lie off what the profile states, a sentence
says what was seen and what was told. Texture without edges tells no blur, a scene without even
ground no noise: then nothing is said.

Without a named sensor `restored_already` compares the noise with that of the quietest sensor in
range. Satellite products are mostly denoised and sharpened before they are delivered; a network
that is not given their sensor takes them for images of a middling one, and sharpens them a second
time.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import onnx

from beers_deploy.model.family import RANGES
from beers_deploy.model.metrics import edge_blur
from beers_deploy.model.metrics.edge_fit import EdgeBlur, Noise
from beers_deploy.model.metrics.noise_line import (
    LEAST,
    ROUNDING,
    Blocks,
    NoiseModel,
    cut_blocks,
    fit_noise_model,
    join,
)
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.raster.source import Source
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.bands import in_order

logger = logging.getLogger(__name__)

WINDOW_PX = 512
ACROSS = 4
"""Side of a window, and how many at most lie side by side, and below one another."""
EDGES = 20
"""Enough along an axis: more would take time and tell no more."""
STEP_PX = 4
CELL_PX = (8, 4)
FEW_WINDOWS = 4
"""Every so many rows are searched for edges, by such cells; an image of few windows may have few:
it is searched as thoroughly as by `characterize`.
"""
CANDIDATES = 6000
CANDIDATES_OF_WINDOW = 400
"""Steepest places along an axis that are compared with plain edges, of all windows and of each at
least.
"""
FITS = 128
FITS_OF_WINDOW = 8
"""Squares along an axis that are fitted, of all windows and of each at least: 1
ms each (measured).
"""
WINDOWS_AT_ONCE = 4
"""Whose squares are fitted together: fewer at a time take longer."""
DRAWS = 20
SEED = 0
"""Of sensors from a profile with ranges."""
NOISE_KEPT = 1.25
BLUR_KEPT = 1.15
"""Factors of the noise's variance, and of the MTF, that an interval may lie off by before anything
is said.
"""
SMOOTH = 0.45
QUIET_PERCENT = 10.0
"""Of the noise told: less in a tenth of the blocks is the work of a filter.

By chance they hold 0.6 of it.
"""
ABOVE = 0.001
"""Share of pixels above full scale that no image of the sensor has."""
FILTERED = ": restored, resampled or compressed before, or of another gain"
AXES = ("across", "along")


class Told(NamedTuple):
    """What a profile states, in the image's numbers: variance at a value, and the MTF at Nyquist of
    both axes.
    """

    instruments: Sequence[Instrument]
    unit: float

    def variances(self, value: np.ndarray | float) -> np.ndarray:
        """Of the noise at pixel values, without rounding, of each instrument: (I, ...)."""
        return np.stack(
            [
                self.variance(instrument, np.asarray(value, np.float64))
                for instrument in self.instruments
            ]
        )

    def variance(self, sensor: Instrument, value: np.ndarray) -> np.ndarray:
        """Of the noise at pixel values, of one instrument."""
        gain = sensor.gain_dn_per_radiance
        radiance = np.maximum(value / self.unit - sensor.offset_dn, 0) / gain
        return np.asarray((sensor.alpha * radiance + sensor.beta) * (gain * self.unit) ** 2)

    def mtf(self, axis: str) -> tuple[float, float]:
        """The least and the most contrast at Nyquist along an axis."""
        f = np.array([[NYQUIST]]), np.array([[0.0]])
        fx, fy = f if axis == AXES[0] else f[::-1]
        contrasts = [
            abs(complex(sensor_mtf(fx, fy, instrument).item())) for instrument in self.instruments
        ]
        return min(contrasts), max(contrasts)


@dataclass(frozen=True)
class SensorCheck:
    """What an image shows of its sensor.

    Attributes:
        figures: SNR and MTF as seen, each with its interval.
        doubts: a sentence for each that contradicts the profile.
    """

    figures: Mapping[str, Figure] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()

    @property
    def text(self) -> dict[str, str]:
        """For a row of results: whether the image contradicts its sensor, and how."""
        is_measured = any(figure.value is not None for figure in self.figures.values())
        words = "; ".join(self.doubts) or ("agrees" if is_measured else "cannot be seen")
        return {"sensor check": words} if self.figures else {}

    def settled(self, name: str, sensor: str, strict: bool) -> "SensorCheck":
        """Return this check, and log a warning for each contradiction.

        Args:
            name: of the image, for messages.
            sensor: its profile's name.
            strict: whether a contradiction is an error instead.

        Raises:
            ImageError: a contradiction, if `strict`.
        """
        if self.doubts and strict:
            raise ImageError(
                f"{name} contradicts the sensor {sensor}: {printable('; '.join(self.doubts))}. "
                "Name the image's own sensor, measure it with 'characterize', or leave `strict` "
                "out."
            )
        for doubt in self.doubts:
            logger.warning("look at the sensor: %s", doubt)
        return self


def checked_sensor(
    source: Source,
    sensors: Mapping[str, Sensor],
    full_scale: float,
    name: str,
    strict: bool,
) -> SensorCheck:
    """Compare an image with the sensor that a user names, and warn where it contradicts it.

    Args:
        source: the image.
        sensors: by band, under no name where one is for all; empty or blind where none is known.
        full_scale: the pixel value that is the sensors' largest digital number.
        name: of the image, for messages.
        strict: whether a contradiction is an error instead of a warning.
    """
    if all(sensor.name == BLIND for sensor in sensors.values()):
        return SensorCheck()
    ordered = in_order(sensors, source.raster)
    names = " and ".join(dict.fromkeys(sensor.name for sensor in ordered))
    return check_source(source, ordered, full_scale).settled(name, names, strict)


def check_source(source: Source, sensors: Sequence[Sensor], full_scale: float) -> SensorCheck:
    """Hold an image against its sensor, band by band.

    Args:
        source: the image.
        sensors: one of all bands, or one of each.
        full_scale: the pixel value that is the sensors' largest digital number.
    """
    bands = source.raster.bands
    windows = band_windows(source)
    checks = [
        held_against(pixels, sensors[band % len(sensors)], full_scale)
        for band, pixels in enumerate(windows)
    ]
    if bands == 1:
        return checks[0]
    figures = dict[str, Figure]()
    doubts = list[str]()
    for number, check in enumerate(checks, 1):
        figures |= {f"band {number}: {name}": figure for name, figure in check.figures.items()}
        doubts += [f"band {number}: {doubt}" for doubt in check.doubts]
    return SensorCheck(figures, tuple(doubts))


def band_windows(source: Source) -> list[list[np.ndarray]]:
    """Return windows (h, w) of each band, spread evenly over an image, 0 where
    pixels are missing.
    """
    return [list(windows) for windows in zip(*_windows(source), strict=True)]


def integer_step(windows: Sequence[np.ndarray]) -> int | None:
    """Return the largest integer of which all pixels are multiples; None if
    they are no integers.
    """
    if any(window.dtype.kind == "f" for window in windows) and not all(
        (np.isfinite(window) & (window == np.rint(window))).all() for window in windows
    ):
        return None
    divisors = [np.gcd.reduce(window.astype(np.int64), axis=None) for window in windows]
    # The divisor of an image of zeros alone is 0.
    return max(int(np.gcd.reduce(divisors)), 1)


def _windows(source: Source) -> Iterator[np.ndarray]:
    """Windows (bands, h, w) spread evenly over an image, 0 where pixels are missing."""
    raster = source.raster
    for down in _spread(raster.height_px):
        rows = source.read(down.start, down.stop)
        missing = raster.missing(rows) if raster.may_miss else None
        values = (
            np.ma.getdata(rows) if missing is None else np.where(missing, 0, np.ma.getdata(rows))
        )
        for across in _spread(raster.width_px):
            yield values[:, :, across]


def _spread(size_px: int) -> list[slice]:
    """Windows along a side, evenly from end to end and none over another."""
    count = min(ACROSS, -(-size_px // WINDOW_PX))
    side_px = min(WINDOW_PX, size_px // count)
    starts = np.linspace(0, size_px - side_px, count)
    return [slice(int(start), int(start) + side_px) for start in starts]


def held_against(windows: Sequence[np.ndarray], sensor: Sensor, full_scale: float) -> SensorCheck:
    """Hold windows of one band against a sensor.

    Args:
        windows: (h, w) each, raw values; 0 where pixels are missing.
        sensor: the profile; where it states ranges, all between their ends is as told.
        full_scale: the value that is the sensor's largest digital number.
    """
    step = integer_step(windows)
    if step is None:
        reason = (
            "the pixels are not whole numbers: they were scaled, and the noise of rounding "
            "is not known"
        )
        blurs = {f"MTF {axis} seen": unavailable("%", reason) for axis in AXES}
        return SensorCheck({"SNR seen": unavailable("ratio", reason), **blurs})
    # The noise model has the noise of rounding to integers, so pixels are counted in steps.
    pixels = [window / step for window in windows]
    clipped_at = full_scale / step
    profile = _told(sensor, clipped_at)
    blocks = join([cut_blocks(window, clipped_at) for window in pixels])
    line = fit_noise_model(blocks, np.random.default_rng(SEED))
    figures, doubts = _noise(line, blocks, profile)
    above = float(np.mean([(window > clipped_at).mean() for window in pixels]))
    if above > ABOVE:
        doubts.append(f"{above:.1%} of the pixels are above its full scale, {full_scale:g}")
    for axis, (figure, doubt) in zip(AXES, _blur(pixels, line, profile, clipped_at), strict=True):
        figures[f"MTF {axis} seen"] = figure
        doubts += doubt
    return SensorCheck(figures, tuple(doubts))


def _told(sensor: Sensor, clipped_at: float) -> Told:
    generator = np.random.default_rng(SEED)
    first = sensor.nominal()
    samples = (sensor.draw(generator) for _ in range(DRAWS))
    return Told(
        [first, *(sample for sample in samples if sample != first)], clipped_at / first.max_dn
    )


def _noise(
    line: NoiseModel | Refusal, blocks: Blocks, profile: Told
) -> tuple[dict[str, Figure], list[str]]:
    """The SNR in the middle of what was measured, and a sentence where it contradicts what was
    told.
    """
    if isinstance(line, Refusal):
        return {"SNR seen": unavailable("ratio", line.reason)}, _smoothed(blocks, profile)
    # The geometric mean of the two ends is the middle of the levels that were measured.
    value = math.sqrt(math.prod(line.measured_dn))
    variance = line.at(value)
    expected = profile.variances(value)
    first = profile.instruments[0]
    signal = max(value - profile.unit * first.offset_dn, 0)
    radiance = signal / (profile.unit * first.gain_dn_per_radiance)
    variances = variance.interval[1], variance.value, variance.interval[0], expected[0]
    low, snr, high, stated_snr = (signal / math.sqrt(v) if v > 0 else math.inf for v in variances)
    words = f"at {radiance:.3g} W/m2/sr/um, {line.blocks} blocks of 16 x 16; told {stated_snr:.3g}"
    figures = {"SNR seen": measured(snr, "ratio", words, (low, high))}
    if (
        variance.interval[0] > expected.max() * NOISE_KEPT
        or variance.interval[1] < expected.min() / NOISE_KEPT
    ):
        what = (
            f"noise at {radiance:.3g} W/m2/sr/um looks like SNR {snr:.3g}, the profile says "
            f"{stated_snr:.3g}"
        )
        return figures, [f"{what}{FILTERED}" if snr > stated_snr else what]
    return figures, _smoothed(blocks, profile)


def _smoothed(blocks: Blocks, profile: Told) -> list[str]:
    """A sentence where pixels hold less noise than any image of the sensor."""
    if not blocks.mean.size:
        return []
    expected = profile.variances(blocks.mean).min(0)
    share = float(np.percentile(blocks.fine / (expected + ROUNDING), QUIET_PERCENT))
    if share > SMOOTH:
        return []
    return [f"{share:.0%} of the noise that the profile says{FILTERED}"]


def _blur(
    pixels: Sequence[np.ndarray], line: NoiseModel | Refusal, profile: Told, clipped_at: float
) -> Iterator[tuple[Figure, list[str]]]:
    """The MTF along each axis, and a sentence where it contradicts what was told."""

    def noise(values: np.ndarray) -> np.ndarray:
        return profile.variance(profile.instruments[0], values) + ROUNDING

    total = noise if isinstance(line, Refusal) else line.total
    edges = [
        _edges(turned, total, clipped_at) for turned in (pixels, [window.T for window in pixels])
    ]
    for axis, own, others in zip(AXES, edges, edges[::-1], strict=True):
        if len(own) < edge_blur.MIN_FOUND:
            yield (
                unavailable("%", f"{len(own)} straight edges, {edge_blur.MIN_FOUND} are needed"),
                [],
            )
            continue
        blur = edge_blur.combine(own, others)
        least, most = profile.mtf(axis)
        low, high = blur.interval
        figure = measured(
            100 * blur.mtf_nyquist, "%", f"{blur.edges} edges", (100 * low, 100 * high)
        )
        # Few and soft edges do not tell the shape of the curve, so the profile's own shape must
        # be off as well.
        off = (
            min(low, blur.nearest) > most * BLUR_KEPT or max(high, blur.nearest) < least / BLUR_KEPT
        )
        bound = most if low > most else least
        what = (
            f"MTF {axis} the track looks like {blur.mtf_nyquist:.2%}, the profile says {bound:.2%}"
        )
        yield figure, [what] if off else []


def _edges(windows: Sequence[np.ndarray], noise: Noise, clipped_at: float) -> list[EdgeBlur]:
    """The blurs across near-vertical edges, of as many windows as it takes to find enough."""
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


FAR_BELOW = 0.4
"""Of the variance that the quietest sensor has, in a tenth of the blocks: less is no raw image.

Four Pleiades products hold 0.01 to 0.04 of it. Of images simulated by sensors of the range, at 1,
1/4 and 1/20 of the light, the lowest holds 0.76, and chance alone may leave 0.6. An 11-bit image
taken for one of 12 bits keeps half of it.
"""
OFFSET = 0.01
"""Of full scale, the largest value of the dark that an image may have."""
SEEN = 3 * ROUNDING
"""Least expected variance: below, rounding to integers hides the noise of a raw image as well."""
FILLED = 1e-9
"""Variance of blocks that are constant: filled, and not acquired."""


def restored_already(source: Source, networks: Sequence[onnx.ModelProto], full_scale: float) -> str:
    """Return a sentence if an image of no named sensor looks restored already; else nothing.

    Args:
        source: the image.
        networks: that are to restore it; the range is known of networks that state their sensor,
            "blind" included.
        full_scale: the pixel value that is 1.0 to them.
    """
    if not all(metadata(network).get("sensor") for network in networks):
        return ""
    # Satellite products are mostly denoised before delivery: their noise gives them away.
    shares = [_noise_share(windows, full_scale) for windows in band_windows(source)]
    quiet = [k for k, share in enumerate(shares, 1) if share is not None and share < FAR_BELOW]
    if not quiet:
        return ""
    least = min(share for share in shares if share is not None)
    some = "" if len(quiet) == len(shares) else f" in band {', '.join(map(str, quiet))}"
    return (
        f"look at the image: it looks restored already{some}, with {least:.0%} of the noise "
        "variance of the quietest "
        f"sensor that the network knows at full scale {full_scale:g}; a restoration "
        "over-sharpens it: give the raw "
        "image, or its own sensor or full scale"
    )


def _noise_share(windows: Sequence[np.ndarray], full_scale: float) -> float | None:
    """Return the noise's variance over the least of any sensor in range, in quiet blocks; None if
    it is not seen.

    Args:
        windows: (h, w) each, raw values; 0 where pixels are missing.
        full_scale: the value that is the sensors' largest digital number.
    """
    step = integer_step(windows)
    # Pixels that were scaled have an unknown noise of rounding.
    if step is None:
        return None
    top = full_scale / step
    blocks = join([cut_blocks(window / step, top) for window in windows])
    expected = _least_variance(blocks.mean, top)
    judged = (expected >= SEEN) & (blocks.fine > FILLED)
    if int(judged.sum()) < LEAST:
        return None
    return float(np.percentile(blocks.fine[judged] / (expected[judged] + ROUNDING), QUIET_PERCENT))


def _least_variance(values: np.ndarray, full_scale: float) -> np.ndarray:
    """Return the least variance of the noise at pixel values, of any sensor that the networks were
    trained for.

    It is stated at 1/16 and at 1/4 of full scale. A straight line through 0 and the first, and a
    constant from the second on, lie below the noise line of every sensor of the range, also where
    the dark is above 0.
    """
    # The variance of the noise is stated at 1/16 of full scale, hence 16 times the light.
    light = np.maximum(values / full_scale - OFFSET, 0)
    dark = RANGES["sigma_dark"][0] ** 2
    bright = RANGES["sigma_bright"][0] ** 2
    return np.asarray(full_scale**2 * np.minimum(16 * dark * light, bright))
