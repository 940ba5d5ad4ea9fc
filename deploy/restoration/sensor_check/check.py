"""Check an image against the sensor that its user names, by its own pixels alone.

Noise and blur are measured in windows spread over the image (`model.metrics.instrument`), and
compared with those in the profile (`comparison`).

The noise of an image without a named sensor is compared with that of the quietest sensor in range.
Most satellite products are denoised and sharpened before they are delivered. A network that is not
given their sensor treats them as images of an average one, and sharpens them a second time.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import onnx

from beers_deploy.model.family import RANGES
from beers_deploy.model.metrics.instrument import AXES, axis_mtfs, image_blocks
from beers_deploy.model.metrics.noise_blocks import ROUNDING
from beers_deploy.model.metrics.noise_line import LEAST, fit_noise
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.figures import Figure, unavailable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.sensor_check.comparison import (
    QUIET_PERCENT,
    SNR,
    StatedSensor,
    compare_blur,
    compare_noise,
    mtf_name,
)

logger = logging.getLogger(__name__)

ABOVE = 0.001
"""A larger share of pixels above full scale does not occur in an image of the sensor."""

WINDOW_PX = 512
ACROSS = 4
"""The side of a window, and the largest number of windows along each axis."""


@dataclass(frozen=True)
class SensorCheck:
    """The result of comparing an image with the profile of its sensor.

    Attributes:
        figures: the SNR and the MTF measured in the image, by name, each with its interval or the
            reason why it cannot be measured; empty if there was no sensor to compare with.
        warnings: one sentence for each contradiction between image and profile.
    """

    figures: Mapping[str, Figure] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def text(self) -> dict[str, str]:
        """The result in words, under the key 'sensor check', for a row of results; empty if there
        was no sensor to compare with.
        """
        if not self.figures:
            return {}
        unknown = [name for name, figure in self.figures.items() if figure.value is None]
        words = "agrees"
        if len(unknown) == len(self.figures):
            words = "not measurable"
        elif unknown:
            words = f"agrees; not measurable: {', '.join(unknown)}"
        return {"sensor check": "; ".join(self.warnings) or words}

    def report(self, name: str, sensor: str, strict: bool) -> None:
        """Log a warning for each contradiction between the image and its sensor.

        Args:
            name: the name of the image, for messages.
            sensor: the name of the sensor's profile, for messages.
            strict: True to raise an error instead of logging warnings.

        Raises:
            ImageError: there is a contradiction, and `strict` is True.
        """
        if self.warnings and strict:
            raise ImageError(
                f"{name} contradicts the sensor {sensor}: {printable('; '.join(self.warnings))}. "
                "Name the image's own sensor, measure it with 'characterize', or leave `strict` "
                "out."
            )
        for warning in self.warnings:
            logger.warning("look at the sensor: %s", warning)


def checked_sensor(
    source: Source,
    sensors: Mapping[str, Sensor],
    full_scale: float,
    name: str,
    strict: bool,
) -> SensorCheck:
    """Compare an image with the sensors that a user names, and warn of each contradiction.

    Args:
        source: the image.
        sensors: the sensor by the name of the band; a sensor for all bands has the key "". If the
            mapping is empty or all sensors are named "blind", nothing is compared.
        full_scale: the pixel value that is the sensors' largest digital number.
        name: the name of the image, for messages.
        strict: True to raise an error for a contradiction instead of a warning.

    Raises:
        ImageError: there is a contradiction, and `strict` is True.
    """
    if all(sensor.name == BLIND for sensor in sensors.values()):
        return SensorCheck()
    ordered = in_order(sensors, source.raster)
    check = check_source(source, ordered, full_scale)
    names = " and ".join(dict.fromkeys(sensor.name for sensor in ordered))
    check.report(name, names, strict)
    return check


def check_source(source: Source, sensors: Sequence[Sensor], full_scale: float) -> SensorCheck:
    """Compare the noise and blur of each band of an image with the band's sensor.

    Args:
        source: the image.
        sensors: one sensor for all bands, or one for each in the order of the bands.
        full_scale: the pixel value that is the sensors' largest digital number.
    """
    checks = [
        check_windows(windows, sensors[band % len(sensors)], full_scale)
        for band, windows in enumerate(band_windows(source))
    ]
    if len(checks) == 1:
        return checks[0]
    figures = dict[str, Figure]()
    warnings = list[str]()
    for number, check in enumerate(checks, 1):
        figures |= {f"band {number}: {name}": figure for name, figure in check.figures.items()}
        warnings += [f"band {number}: {warning}" for warning in check.warnings]
    return SensorCheck(figures, tuple(warnings))


def check_windows(windows: Sequence[np.ndarray], sensor: Sensor, full_scale: float) -> SensorCheck:
    """Compare the noise and blur of one band, measured in windows of it, with a sensor's profile.

    Args:
        windows: parts of the band, raw values (h, w) each, 0 where pixels are missing.
        sensor: the profile. If it states ranges, every value within them agrees with it.
        full_scale: the pixel value that is the sensor's largest digital number.
    """
    step = integer_step(windows)
    if step is None:
        reason = (
            "the pixels are not whole numbers: they were scaled, and the noise of rounding "
            "is not known"
        )
        blurs = {mtf_name(axis): unavailable("%", reason) for axis in AXES}
        return SensorCheck({SNR: unavailable("ratio", reason), **blurs})
    # The noise model has the noise of rounding to integers, so pixels are counted in steps.
    pixels = [window / step for window in windows]
    clipped_at = full_scale / step
    stated = StatedSensor.of(sensor, clipped_at)
    blocks = image_blocks(pixels, clipped_at)
    line = fit_noise(blocks)
    figure, warnings = compare_noise(line, blocks, stated)
    figures = {SNR: figure}
    above = float(np.mean([(window > clipped_at).mean() for window in pixels]))
    if above > ABOVE:
        warnings.append(f"{above:.1%} of the pixels are above its full scale, {full_scale:g}")
    noise = stated.nominal_noise if isinstance(line, Refusal) else line.total
    for axis, blur in axis_mtfs(pixels, noise, clipped_at).items():
        figures[mtf_name(axis)], contradiction = compare_blur(axis, blur, stated)
        warnings += contradiction
    return SensorCheck(figures, tuple(warnings))


def band_windows(source: Source) -> list[list[np.ndarray]]:
    """Read windows that are spread evenly over an image, without overlap.

    Returns:
        For each band its windows, raw values (h, w) each, 0 where pixels are missing. All bands
        have the same windows.
    """
    raster = source.raster
    by_band: list[list[np.ndarray]] = [[] for _ in range(raster.bands)]
    for down in _spread(raster.height_px):
        rows = source.read(down.start, down.stop)
        values = np.where(raster.missing(rows), 0, np.ma.getdata(rows))
        for across in _spread(raster.width_px):
            for windows, window in zip(by_band, values[:, :, across], strict=True):
                windows.append(window)
    return by_band


def integer_step(windows: Sequence[np.ndarray]) -> int | None:
    """Return the step between pixel values: the largest integer that divides all pixels.

    Args:
        windows: parts of one band, (h, w) each.

    Returns:
        The step; 1 if all pixels are 0, None if a pixel is not an integer.
    """
    if any(window.dtype.kind == "f" for window in windows) and not all(
        (np.isfinite(window) & (window == np.rint(window))).all() for window in windows
    ):
        return None
    divisors = [np.gcd.reduce(window.astype(np.int64), axis=None) for window in windows]
    # The divisor of an image of zeros alone is 0.
    return max(int(np.gcd.reduce(divisors)), 1)


def _spread(size_px: int) -> list[slice]:
    """Return windows along a side, evenly spaced from end to end without overlap."""
    count = min(ACROSS, -(-size_px // WINDOW_PX))
    side_px = min(WINDOW_PX, size_px // count)
    starts = np.linspace(0, size_px - side_px, count)
    return [slice(int(start), int(start) + side_px) for start in starts]


FAR_BELOW = 0.4
"""A share of the variance of the quietest sensor, in a tenth of the blocks. An image with less is
not raw.

Four Pleiades products have 0.01 to 0.04. Of images simulated by sensors of the range, at 1, 1/4 and
1/20 of the light, the lowest has 0.76, and chance alone may leave 0.6. An 11-bit image that is
mistaken for 12 bits retains half of it.
"""
OFFSET = 0.01
"""The largest dark level that an image may have, as a share of full scale."""
LEAST_EXPECTED = 3 * ROUNDING
"""The least expected variance. Below this, rounding to integers hides the noise of a raw image as
well.
"""
FILLED = 1e-9
"""Blocks with less variance are constant, so they are filled and not acquired."""


def restored_already(source: Source, networks: Sequence[onnx.ModelProto], full_scale: float) -> str:
    """Return the warning that an image without a named sensor looks restored already.

    An image has been denoised, and so is not raw, if its noise is far below that of the quietest
    sensor that the networks were trained for.

    Args:
        source: the image.
        networks: the networks that are to restore the image. The sensors that they were trained for
            are known only if each states a sensor in its metadata, "blind" included.
        full_scale: the pixel value that is 1.0 to the networks.

    Returns:
        The warning; empty if the image looks raw, its noise cannot be measured, or the sensors are
        not known.
    """
    if not all(metadata(network).get("sensor") for network in networks):
        return ""
    # Most satellite products are denoised before delivery, which their noise reveals.
    shares = [_noise_share(windows, full_scale) for windows in band_windows(source)]
    quiet = [k for k, share in enumerate(shares, 1) if share is not None and share < FAR_BELOW]
    if not quiet:
        return ""
    least = min(share for share in shares if share is not None)
    some = "" if len(quiet) == len(shares) else f" in band {', '.join(map(str, quiet))}"
    return (
        f"look at the image: it looks restored already{some}, with {least:.0%} of the noise "
        "variance of the quietest sensor that the network knows at full scale "
        f"{full_scale:g}; a restoration over-sharpens it: give the raw image, or its own sensor "
        "or full scale"
    )


def _noise_share(windows: Sequence[np.ndarray], full_scale: float) -> float | None:
    """Return the noise's variance relative to the least of any sensor in range, in quiet blocks, or
    None if it cannot be measured.

    Args:
        windows: (h, w) each, raw values; 0 where pixels are missing.
        full_scale: the value that is the sensors' largest digital number.
    """
    step = integer_step(windows)
    # Pixels that were scaled have an unknown noise of rounding.
    if step is None:
        return None
    top = full_scale / step
    blocks = image_blocks((window / step for window in windows), top)
    # The least variance over all sensors that the networks were trained for. It is defined at 1/16
    # and at 1/4 of full scale. A straight line through 0 and the first, and a constant from the
    # second on, lie below the noise line of every sensor of the range, also where the dark is above
    # 0.
    light = np.maximum(blocks.mean / top - OFFSET, 0)
    dark = RANGES["sigma_dark"][0] ** 2
    bright = RANGES["sigma_bright"][0] ** 2
    expected = top**2 * np.minimum(16 * dark * light, bright)
    judged = (expected >= LEAST_EXPECTED) & (blocks.fine > FILLED)
    if int(judged.sum()) < LEAST:
        return None
    return float(np.percentile(blocks.fine[judged] / (expected[judged] + ROUNDING), QUIET_PERCENT))
