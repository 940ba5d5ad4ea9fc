"""The half-widths of a restored image, computed from its finished rows, and their file.

`model.interval` has the formula. A half-width depends on restored pixels within CONTEXT_PX and on
nothing else, so the rows that are asked for, tiles and a resumed run change no byte.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beers_deploy.model.interval import CONTEXT_PX, HalfWidth, PixelInterval
from beers_deploy.model.io.files import whole_file
from beers_deploy.model.levels import INTERVAL, Level
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.facts import BandInfo, Raster
from beers_deploy.model.raster.source import Source, strips
from beers_deploy.model.raster.writer import write_raster
from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.bands import by_band
from beers_deploy.restoration.prepare import Restoration
from beers_deploy.restoration.self_check import ReadRows

ROWS_PX = 32
"""Rows that are computed at a time, so that all intermediate arrays stay small."""


def interval_of(network: Network) -> PixelInterval:
    """Read from a network's file how far its restored pixels may be from the truth.

    Returns:
        The calibrated interval, which states a half-width for each sensor and level.

    Raises:
        ModelError: the network has no calibrated interval, or a damaged one.
    """
    text = metadata(network.model).get(INTERVAL)
    if text is None:
        raise ModelError(
            f"{network.label} has no calibrated interval. Leave `interval` out, use a shipped "
            "network, or fit one on pairs of your sensor with 'beers-deploy evaluate --pairs PAIRS "
            "--methods NETWORK --calibrate OUT'."
        )
    return PixelInterval.from_json(text, network.label)


@dataclass(frozen=True)
class HalfWidths:
    """The half-widths of the intervals of all restored pixels, computed row by row on request, in
    the form that `write_raster` reads. The error of a pixel stays within its half-width with a
    stated probability.

    Attributes:
        source: the raw image, which states the missing pixels.
        restored: returns restored rows (rows, width), given the band, the first row and the end.
        bands: for each band, the formula that computes half-widths from restored pixels.
    """

    source: Source
    restored: ReadRows
    bands: tuple[HalfWidth, ...]

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Return the half-widths of rows `start` to `stop` (excluded) of one band.

        Returns:
            Half-widths in pixel values, (rows, width) float32, NaN where a pixel is missing.
        """
        raster = self.source.raster
        parts = []
        for first, end in strips(stop - start, ROWS_PX):
            top = max(start + first - CONTEXT_PX, 0)
            bottom = min(start + end + CONTEXT_PX, raster.height_px)
            pixels = self.restored(band, top, bottom)
            valid = ~raster.missing(self.source.read(top, bottom))[band]
            widths = self.bands[band].of(pixels, valid)
            parts.append(widths[start + first - top : start + end - top])
        return np.concatenate(parts)

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Return rows `start` to `stop` (excluded) of the mask of the raw image, (rows, width)."""
        return self.source.read_mask(start, stop)


def require_sensors(sensors: Mapping[str, Sensor]) -> None:
    """Raise OptionError if the sensor of a band is unknown, because the interval is then too.

    Args:
        sensors: the sensor by the name of the band; a sensor for all bands has the key "".
    """
    if any(sensor.name == BLIND for sensor in sensors.values()):
        raise OptionError(
            "`interval` needs the sensor of every band, whose noise is its unit. Name it with "
            "`sensor`, or omit `interval`."
        )


def half_widths_of(work: Restoration, level: Level) -> tuple[HalfWidth, ...]:
    """Build, for each band of an image, the formula that computes the half-widths of its pixels.

    Args:
        work: the restoration of the image, before its first row.
        level: the share of pixels whose error lies within the interval, in percent.

    Raises:
        OptionError: the network does not return one pixel of the same band for each pixel, or it
            has no interval of this level.
        ModelError: the network has no calibrated interval.
    """
    raster = work.source.raster
    if tuple(work.out_shape) != raster.shape:
        raise OptionError(
            "`interval` needs a network that gives one pixel of the same band for each pixel. "
            "Leave `interval` out."
        )
    # The networks of several bands are one file, conditioned on their sensors.
    interval = interval_of(work.networks[0])
    full_scale = work.scale.value
    sensors = work.reading.sensors
    return by_band(sensors, raster, lambda s: interval.for_sensor(s.nominal(), full_scale, level))


def write_half_widths(
    path: Path, widths: HalfWidths, level: Level, compression: Compression
) -> None:
    """Write the half-widths of an image as a GeoTIFF of float32 with one plane for each band.

    They have the units and the place on Earth of the restored image, and are NaN where a pixel is
    missing.

    Args:
        path: the path of the GeoTIFF.
        widths: the half-widths of all pixels.
        level: the share of pixels whose error lies within the interval, in percent; it is recorded
            with each band.
        compression: the compression of the GeoTIFF.
    """
    raster = widths.source.raster
    infos = raster.band_info or (BandInfo(),) * raster.bands
    named = tuple(
        replace(
            info,
            name=f"{info.name or f'band {band}'}: half-width",
            # An offset shifts values, and a half-width is a difference of two.
            offset=0.0,
            tags=(("level_percent", str(level)),),
        )
        for band, info in enumerate(infos, 1)
    )
    facts = Raster(
        *raster.shape,
        np.dtype(np.float32),
        nodata=float("nan"),
        georeference=raster.georeference,
        band_info=named,
    )
    with whole_file(path) as temporary:
        write_raster(temporary, facts, widths, compression, "beers-deploy")
