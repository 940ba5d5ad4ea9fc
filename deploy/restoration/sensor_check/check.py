"""Check an image against the sensor that its user names, by its own pixels alone.

Noise and blur are measured in windows spread over the image (`model.metrics.instrument`), and
compared with those in the profile (`comparison`).
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from beers_deploy.model.metrics.instrument import AXES, axis_mtfs, image_blocks
from beers_deploy.model.metrics.noise_line import fit_noise
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.figures import Figure, unavailable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.sensor_check.comparison import (
    SNR,
    StatedSensor,
    compare_blur,
    compare_noise,
    mtf_name,
)
from beers_deploy.restoration.sensor_check.windows import band_windows, integer_step

logger = logging.getLogger(__name__)

ABOVE = 0.001
"""A larger share of pixels above full scale does not occur in an image of the sensor."""


@dataclass(frozen=True)
class SensorCheck:
    """The result of comparing an image with its sensor.

    Attributes:
        figures: measured SNR and MTF, each with its interval.
        warnings: one sentence for each contradiction of the profile.
    """

    figures: Mapping[str, Figure] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def text(self) -> dict[str, str]:
        """The result of the check as the text of a row of results."""
        is_measured = any(figure.value is not None for figure in self.figures.values())
        words = "; ".join(self.warnings) or ("agrees" if is_measured else "not measurable")
        return {"sensor check": words} if self.figures else {}

    def report(self, name: str, sensor: str, strict: bool) -> None:
        """Log a warning for each contradiction.

        Args:
            name: of the image, for messages.
            sensor: its profile's name.
            strict: if True, a contradiction is an error instead.

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
    """Compare an image with the sensor that a user names, and warn if it contradicts it.

    Args:
        source: the image.
        sensors: by band, or under "" if one is for all; empty or blind if none is known.
        full_scale: the pixel value that is the sensors' largest digital number.
        name: of the image, for messages.
        strict: if True, a contradiction is an error instead of a warning.
    """
    if all(sensor.name == BLIND for sensor in sensors.values()):
        return SensorCheck()
    ordered = in_order(sensors, source.raster)
    check = check_source(source, ordered, full_scale)
    names = " and ".join(dict.fromkeys(sensor.name for sensor in ordered))
    check.report(name, names, strict)
    return check


def check_source(source: Source, sensors: Sequence[Sensor], full_scale: float) -> SensorCheck:
    """Compare an image with its sensor, band by band.

    Args:
        source: the image.
        sensors: one for all bands, or one for each.
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
    """Compare windows of one band with a sensor.

    Args:
        windows: (h, w) each, raw values; 0 where pixels are missing.
        sensor: the profile. If it states ranges, every value within them agrees with it.
        full_scale: the value that is the sensor's largest digital number.
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
