"""Sensors and scenes for the simulator's tests, and the signal before digitization."""

import math
from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np

from beers_deploy.model.simulator.acquire import without
from beers_deploy.model.simulator.detector import Draw, add_noise
from beers_deploy.model.simulator.mtf import Blur, mtf, sensor_transfer, transfer_function
from beers_deploy.model.simulator.sampling import crop_divisible, sample, scene_spectrum
from beers_deploy.profiles.effects import Effect, PixelEffect, pixel_effects, settled
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import MtfTable, PointSpread, Response, packed
from beers_deploy.profiles.scene_call import typical_effects
from beers_deploy.profiles.sensor import Sensor

NOMINAL = Sensor.load("pleiades-degraded").nominal()
REFERENCE = Sensor.load("pleiades-reference").nominal()
TYPICAL = settled(typical_effects(), lambda constant: constant.middle)


def plain_sensor(**effects: Effect) -> Instrument:
    """Return the nominal degraded sensor with these effects."""
    return replace(NOMINAL, effects=effects)


def before_digitising(
    radiance: np.ndarray, sensor: Instrument, ratio: int, draw: Draw, skip: Collection[str] = ()
) -> np.ndarray:
    """Compute the signal of `simulate_planned` before the converter, so that no rounding hides a
    difference.
    """
    if "mtf" in skip:
        signal = pixel_means(radiance, ratio)
    else:
        height, width = radiance.shape
        transfer = sensor_transfer(height, width, ratio, without(sensor, skip))
        signal = sample(scene_spectrum(radiance), transfer, width, ratio)
    signal = _apply(signal, "radiance", sensor, draw, skip)
    if "noise" not in skip:
        signal = add_noise(signal, sensor, draw.generator("noise-degraded"))
    return _apply(signal * sensor.gain_dn_per_radiance, "DN", sensor, draw, skip)


def blurred(
    radiance: np.ndarray, ratio: int, blur: Blur, antialias_px: float = 0.0, smear_px: float = 0.0
) -> np.ndarray:
    """Blur a scene (H, W) and sample it at every target pixel, in W/m2/sr/um."""
    height, width = radiance.shape
    transfer = transfer_function(height, width, ratio, blur, antialias_px, smear_px)
    return sample(scene_spectrum(radiance), transfer, width, ratio)


def pixel_means(radiance: np.ndarray, ratio: int) -> np.ndarray:
    """Return the mean radiance of each whole target pixel."""
    height, width = (size // ratio for size in radiance.shape)
    return np.asarray(
        crop_divisible(radiance, ratio).reshape(height, ratio, width, ratio).mean((1, 3))
    )


def _apply(
    image: np.ndarray, acts_on: str, sensor: Instrument, draw: Draw, skip: Collection[str]
) -> np.ndarray:
    for name, effect in pixel_effects(sensor.effects, acts_on).items():
        if name not in skip:
            image = effect.apply(image, sensor, partial(draw.generator, f"{name}-degraded"))
    return image


def alone(effect: PixelEffect, image: np.ndarray, seed: int = 0) -> np.ndarray:
    """Apply one effect of the target grid to an image (..., H, W)."""
    return effect.apply(image, plain_sensor(), partial(Draw(seed).generator, "alone"))


def with_response(sensor: Instrument, response: Response) -> Instrument:
    """Return the sensor with another blur."""
    across, along = response.at_nyquist
    return replace(sensor, mtf_nyquist=across, mtf_nyquist_along=along, response=response)


def with_contrast(mtf_nyquist: float) -> Instrument:
    """Return the nominal degraded sensor with another contrast at Nyquist."""
    return replace(NOMINAL, mtf_nyquist=mtf_nyquist)


def point_spread(samples: np.ndarray, per_px: float) -> PointSpread:
    """Return samples (H, W) in the form that a profile stores."""
    return PointSpread(len(samples), samples.shape[1], per_px, packed(samples))


def formula_table(across: float, along: float, steps: int = 5) -> MtfTable:
    """Return a table of the paper's formula at `steps` frequencies above 0, up to Nyquist."""
    f = np.linspace(0, 0.5, steps + 1)
    columns = (mtf(f, 0.0, contrast).tolist() for contrast in (across, along))
    return MtfTable(tuple(f.tolist()), *map(tuple, columns))


def formula_point(blur: Blur, per_px: int, side_px: int, odd: bool) -> PointSpread:
    """Return the formula's point-spread function; with an even side no sample is in its middle."""
    side = per_px * side_px + odd
    f = np.fft.fftfreq(side, 1 / per_px)
    samples = np.fft.fftshift(np.fft.ifft2(mtf(f[None], f[:, None], blur)).real)
    return point_spread(samples, per_px)


def gaussian_pixel(sigma_x: float, sigma_y: float, per_px: int, side: int) -> PointSpread:
    """Return a Gaussian of two widths integrated over square pixels: side x (side + 4) samples."""

    def line(size: int, sigma: float) -> np.ndarray:
        x = (np.arange(size) - (size - 1) / 2) / per_px
        return np.array(
            [math.erf((v + 0.5) / 2**0.5 / sigma) - math.erf((v - 0.5) / 2**0.5 / sigma) for v in x]
        )

    return point_spread(line(side, sigma_y)[:, None] * line(side + 4, sigma_x), per_px)


def lopsided_point(per_px: int = 4, rows: int = 37, columns: int = 48) -> PointSpread:
    """Return a sheared point with a tail on one side and a dark ring: its response is complex."""
    y, x = (np.arange(size) - (size - 1) / 2 for size in (rows, columns))
    y = y[:, None] / per_px
    x = x / per_px
    core = np.exp(-2 * y**2 - 1.5 * (x + 0.3 * y) ** 2)
    tail = np.exp(-(y**2) - (x - 1) ** 2)
    return point_spread(core + 0.2 * tail - 0.02 * np.exp(-((np.hypot(x, y) - 2.5) ** 2)), per_px)


def blob(side: int, sigma: float) -> np.ndarray:
    """Return a Gaussian centred in an even-sided square, between its four middle pixels."""
    x = np.arange(side) - (side - 1) / 2
    line = np.exp(-0.5 * (x / sigma) ** 2)
    return np.asarray(line[:, None] * line, np.float32)
