"""Sensors, scenes and acquisitions shared by the benchmarks that measure on images."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from beers_deploy.model.curves import draw_table
from beers_deploy.model.family import LEAST_ALONG, SensorFamily
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.model.simulator.acquire import acquire_padded, fitting_oversampling
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.sampling import Scene, crop_divisible, read_scene
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor

LIKE = Sensor.load("pleiades-degraded").nominal()
RATIO = 4
"""Scene pixels per sensor pixel along each axis."""
LEAST_SIDE_PX = 140
MTF_RANGE = (0.02, 0.12)


def photographs(folders: Sequence[Path], *ratios: int) -> list[Scene]:
    """Read the photographs that are large enough for at least one of the ratios (default:
    RATIO).
    """
    paths = chain.from_iterable(map(list_images, folders))
    scenes = [read_scene(path, LIKE) for path in paths]
    return [
        scene
        for scene in scenes
        if fitting_oversampling(scene.radiance, ratios or (RATIO,), LEAST_SIDE_PX)
    ]


def draw_sensor(generator: np.random.Generator, other_curve: bool = False) -> Instrument:
    """Draw a sensor with the noise that networks are trained for and an MTF of 2 to 12 %."""
    across = math.exp(generator.uniform(*np.log(MTF_RANGE)))
    along = max(across * LEAST_ALONG ** float(generator.uniform() ** 2), MTF_RANGE[0])
    sensor = SensorFamily(LIKE).draw(generator)
    response = None
    if other_curve:
        response = draw_table(across, along, generator)
        across, along = response.at_nyquist
    return replace(sensor, response=response, mtf_nyquist=across, mtf_nyquist_along=along)


def acquired(
    radiance: np.ndarray, sensor: Instrument, number: int, ratio: int = RATIO
) -> np.ndarray:
    """Return the digital numbers (h, w) of an acquisition of a scene (H, W) by a sensor."""
    scene = np.ascontiguousarray(crop_divisible(radiance, ratio), np.float32)
    return to_uint16(acquire_padded(scene, sensor, ratio, Draw(number), "degraded"))


def as_source(image: np.ndarray) -> ArraySource:
    """Wrap an image (H, W) as the source that the checks read."""
    height_px, width_px = image.shape
    return ArraySource(image[None], Raster(1, height_px, width_px, image.dtype))


def texture(generator: np.random.Generator, side_px: int = 1024) -> np.ndarray:
    """Draw the radiance of a rough surface: Gaussian, with a spectrum that falls as 1 / f^p, p from
    0.8 to 2.
    """
    f = np.hypot(np.fft.fftfreq(side_px)[:, None], np.fft.rfftfreq(side_px)[None])
    f[0, 0] = np.inf
    waves = generator.normal(size=f.shape) * np.exp(2j * math.pi * generator.random(f.shape))
    field = np.fft.irfft2(waves / f ** generator.uniform(0.8, 2.0), (side_px, side_px))
    spread = generator.uniform(0.05, 0.3)
    return np.asarray(np.maximum(100 * (1 + spread * field / field.std()), 5), np.float32)
