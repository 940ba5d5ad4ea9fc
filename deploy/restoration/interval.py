"""The half-widths of a restored image, computed from its finished rows, and their file.

`model.interval` has the formula. A half-width depends on restored pixels within CONTEXT_PX and on
nothing else, so the rows that are asked for, tiles and a resumed run change no byte.
"""

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
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.prepare import Restoration
from beers_deploy.restoration.self_check import ReadRows

ROWS_PX = 32
"""Rows that are computed at a time, so that all intermediate arrays stay small."""


def interval_of(network: Network) -> PixelInterval:
    """Read the calibrated interval of a network.

    Raises:
        ModelError: a network without one, or a damaged one.
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
    """The half-widths of a restored image, as `write_raster` reads them.

    Attributes:
        source: the raw image, which tells the missing pixels.
        restored: returns restored rows.
        bands: the half-width of each band.
    """

    source: Source
    restored: ReadRows
    bands: tuple[HalfWidth, ...]

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Return half-widths of rows `start` to `stop` (excluded), (rows, width) float32, NaN
        where a pixel is missing.
        """
        parts = [
            self._strip(band, start + top, start + bottom)
            for top, bottom in strips(stop - start, ROWS_PX)
        ]
        return np.concatenate(parts)

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Return the rows of the mask of the image; missing half-widths are NaN in addition."""
        return self.source.read_mask(start, stop)

    def _strip(self, band: int, start: int, stop: int) -> np.ndarray:
        raster = self.source.raster
        top = max(start - CONTEXT_PX, 0)
        bottom = min(stop + CONTEXT_PX, raster.height_px)
        pixels = self.restored(band, top, bottom)
        valid = np.ones(pixels.shape, bool)
        if raster.may_miss:
            valid = ~raster.missing(self.source.read(top, bottom))[band]
        return self.bands[band].of(pixels, valid)[start - top : stop - top]


def half_widths_of(work: Restoration, level: Level) -> tuple[HalfWidth, ...]:
    """Build the half-width of each band of a restoration.

    Args:
        work: the restoration, ready.
        level: the share of pixels within the interval, in percent.

    Raises:
        OptionError: a band of an unknown sensor, a network that gives other pixels, or a level
            that was not calibrated.
        ModelError: a network without a calibrated interval.
    """
    raster = work.source.raster
    if tuple(work.out_shape) != raster.shape:
        raise OptionError(
            "`interval` needs a network that gives one pixel of the same band for each pixel. "
            "Leave `interval` out."
        )
    sensors = work.reading.sensors
    if not sensors or any(sensor.name == BLIND for sensor in sensors.values()):
        raise OptionError(
            "`interval` needs the sensor of every band, whose noise is its unit. Name it with "
            "`sensor`, or omit `interval`."
        )
    # The networks of several bands are one file, conditioned on their sensors.
    interval = interval_of(work.networks[0])
    built = [
        interval.for_sensor(sensor.nominal(), work.scale.value, level)
        for sensor in in_order(sensors, raster)
    ]
    return tuple(built[band % len(built)] for band in range(raster.bands))


def interval_beside(out: Path) -> Path:
    """Return the path of the file of half-widths of a restored image."""
    return out.with_name(f"{out.stem}-interval.tif")


def write_half_widths(
    path: Path, widths: HalfWidths, level: Level, compression: Compression
) -> None:
    """Write half-widths as a GeoTIFF of float32 with one plane for each band, NaN where a pixel is
    missing, in the units and at the place of the restored image.
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
        place=raster.place,
        band_info=named,
    )
    with whole_file(path) as temporary:
        write_raster(temporary, facts, widths, compression, "beers-deploy")
