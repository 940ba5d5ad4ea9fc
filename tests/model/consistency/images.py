"""Sensors, a scene and its images, for the tests of the consistency step.

`blurred` computes H x independently of the code under test: by a Fourier transform of the mirrored
image in float64.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.consistency.step import Consistency
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.profiles.effects import AntiAlias, Offset, Smear
from beers_deploy.profiles.instrument import Instrument
from tests.model.simulator.stages import (
    REFERENCE,
    formula_table,
    gaussian_pixel,
    lopsided_point,
    plain_sensor,
    with_response,
)

Pixels = NDArray[np.float64] | NDArray[np.float32]


FULL_SCALE = 4095


SENSORS: dict[str, Instrument] = {
    "formula": plain_sensor(),
    "two axes": replace(plain_sensor(), mtf_nyquist=0.12, mtf_nyquist_along=0.04),
    "smear": plain_sensor(smear=Smear(1.5)),
    "antialias": plain_sensor(antialias=AntiAlias(0.4)),
    "offset": plain_sensor(offset=Offset(120.0)),
    "table": with_response(plain_sensor(), formula_table(0.1, 0.05)),
    "lopsided point": with_response(plain_sensor(), lopsided_point()),
    "narrow point": with_response(plain_sensor(), gaussian_pixel(0.7, 0.5, 8, 65)),
}
"""One sensor for each way in which a profile states its blur."""


INSIDE = np.s_[40:-40, 40:-40]
ROWS = 333
COLUMNS = 301


GAUSSIAN = with_response(plain_sensor(), gaussian_pixel(1.1, 1.1, 8, 129))
"""A sensor whose blur is a Gaussian of 1.1 pixels."""


@cache
def whole_step_for(name: str) -> Consistency:
    """Return the consistency step of a sensor, or of GAUSSIAN."""
    return Consistency.of(SENSORS.get(name, GAUSSIAN), REFERENCE)


@cache
def step_for(name: str) -> Consistency:
    """Return the consistency step without the step for finer detail."""
    return replace(whole_step_for(name), detail=None)


@cache
def scene() -> NDArray[np.float32]:
    """Return texture with a spectrum as of photographs, with stripes: 50 to 4000 DN, 480 DN rms."""
    generator = np.random.default_rng(0)
    frequency = np.hypot(np.fft.fftfreq(ROWS)[:, None], np.fft.rfftfreq(COLUMNS)[None])
    spectrum = (
        np.fft.rfft2(generator.normal(size=(ROWS, COLUMNS)))
        / np.maximum(frequency, 1 / ROWS) ** 1.2
    )
    texture = np.fft.irfft2(spectrum, (ROWS, COLUMNS))
    row, column = np.mgrid[:ROWS, :COLUMNS]
    stripes = (column * 0.8 + row * 0.6) % 90 < 30
    return np.asarray(
        np.clip(texture / texture.std() * 400 + 1500 + 600 * stripes, 50, 4000), np.float32
    )


def blurred(restored: Pixels, sensor: Instrument) -> NDArray[np.float64]:
    """Compute H x with the image mirrored at its borders."""
    height, width = restored.shape
    # A mirrored image of twice the size repeats without a seam, as the transform assumes.
    mirrored = np.pad(restored.astype(np.float64), ((0, height), (0, width)), mode="symmetric")
    fy = np.fft.fftfreq(2 * height)[:, None]
    fx = np.fft.fftfreq(2 * width)[None]
    ratio = sensor_mtf(fx, fy, sensor) / sensor_mtf(fx, fy, REFERENCE)
    blurred_image = np.fft.ifft2(np.fft.fft2(mirrored) * ratio / ratio[0, 0]).real
    return np.asarray(blurred_image[:height, :width])


def sigma_dn(sensor: Instrument, signal_dn: float) -> float:
    """Return the standard deviation of the noise at a signal."""
    light = max(signal_dn - sensor.offset_dn, 0) / sensor.gain_dn_per_radiance
    return sensor.noise_sigma(light) * sensor.gain_dn_per_radiance


def noisy(image: Pixels, sensor: Instrument, seed: int = 1) -> NDArray[np.float32]:
    """Add noise of the sensor at 1500 DN, which stays below full scale."""
    noise = np.random.default_rng(seed).normal(0, sigma_dn(sensor, 1500), image.shape)
    return np.clip(image + noise, 0, FULL_SCALE - 1).astype(np.float32)


def acquired(sensor: Instrument) -> NDArray[np.float32]:
    """Return the scene as the sensor acquires it."""
    return noisy(blurred(scene(), sensor), sensor)


def corrected(step: Consistency, raw: Pixels, restored: Pixels) -> NDArray[np.float32]:
    """Compute the correction of a whole image."""
    height, width = restored.shape
    down = Placed(height, 0, 0, height)
    across = Placed(width, 0, 0, width)
    return step.correction(
        raw.astype(np.float32), restored.astype(np.float32), down, across, (0, 0)
    )


def rms(pixels: Pixels) -> float:
    return float(np.sqrt(np.mean(np.square(pixels.astype(np.float64)))))
