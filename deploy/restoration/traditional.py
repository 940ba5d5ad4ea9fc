"""The traditional pipeline on an image of any size, as used by `restore --method traditional`.

Rows are read and written in strips, so that memory grows only with the width. The pipeline depends
on the sensor alone: its MTF, noise and gain. The reference that it imitates is seen with the
sensor's own gain and bits, so that the output has the scale of the input. Bands are restored
separately, each for its own sensor.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beers_deploy.model.progress import steps
from beers_deploy.model.raster.source import Source, strips
from beers_deploy.model.traditional.pipeline import TraditionalPipeline, restore_strips
from beers_deploy.restoration.bands import by_band
from beers_deploy.restoration.cluster import Cluster
from beers_deploy.restoration.memory import check_memory
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.prepare import Restoration, check_sensor
from beers_deploy.restoration.radiometry import Reading, full_scale_of
from beers_deploy.restoration.runtime import Engine
from beers_deploy.restoration.tiles.engine import as_stored, checked_strip, rounded
from beers_deploy.restoration.tiles.rows import RestoredRow

STRIP_PX = 128
"""The number of rows read at a time."""

FIXED_BYTES = 100_000_000
BYTES_PER_COLUMN = 40_000
"""Memory of the pipeline for a band: a constant part (bytes), and BYTES_PER_COLUMN for each pixel
of a row, which is about 700 rows in several float32 copies. Measured at 400 and 1200 columns: 75 MB
and 30 kB.
"""


@dataclass(frozen=True, kw_only=True)
class TraditionalRestoration(Restoration):
    """The restoration of one image by the traditional pipeline.

    No run can continue from a strip, because the pipeline looks hundreds of rows back.

    Attributes:
        pipelines: the pipeline of each band.
    """

    pipelines: tuple[TraditionalPipeline, ...]

    def ticks(self, done_px: int) -> int:
        """Return the number of rows of pixels from row `done_px` on, one progress tick each."""
        return self.source.raster.height_px - done_px

    def rows(
        self,
        done_px: int,  # noqa: ARG002
        tick: Callable[[int], None],
    ) -> Generator[RestoredRow, None, None]:
        """Restore the image strip by strip, all bands of one strip at a time.

        Args:
            done_px: always 0, because a traditional restoration cannot be resumed.
            tick: called with the number of rows of each finished strip.

        Yields:
            The next restored strip of all bands, as it is stored.
        """
        height_px = self.source.raster.height_px
        by_band = [
            restore_strips(self.read(band), height_px, pipeline)
            for band, pipeline in enumerate(self.pipelines)
        ]
        top = 0
        for bands in zip(*by_band, strict=True):
            rows_px = bands[0].shape[0]
            tick(rows_px)
            yield self._stored(torch.stack(bands).numpy(), top)
            top += rows_px

    def _to_dn(self, band: int) -> np.float32:
        """Return the digital number of the sensor for a pixel value of 1."""
        return np.float32(self.pipelines[band].degraded.max_dn / self.scale.value)

    def read(self, band: int, tick: Callable[[int], object] = lambda _: None) -> Iterator[Tensor]:
        """Read one band of the raw image from the top, `STRIP_PX` rows at a time.

        Args:
            band: the number of the band, from 0.
            tick: called with the number of rows of each strip when the next one is requested.

        Yields:
            Strips (rows, width) float32 in digital numbers of the sensor, NaN where missing.

        Raises:
            ImageError: a pixel is negative, infinite, or above an assumed full scale.
        """
        source = self.source
        for start, stop in strips(source.raster.height_px, STRIP_PX):
            stored = source.read(start, stop)
            # Values above an assumed full scale show that the assumption is wrong.
            clips = not self.scale.assumed
            strip = checked_strip(source.raster, start, stored, self.scale.value, self.name, clips)
            # Missing pixels may be beyond float32; no others are below 0.
            pixels = np.clip(strip.pixels[band], 0, self.scale.value).astype(np.float32)
            dn = pixels * self._to_dn(band)
            if strip.missing is not None:
                dn[strip.missing[band]] = np.nan
            yield torch.from_numpy(dn)
            tick(stop - start)

    def fitted(self) -> "TraditionalRestoration":
        """Return this restoration with the strength of the deconvolution fitted to the image.

        The regularisation is the Wiener optimum of each band of the whole image, so this reads all
        strips once. It is much quicker than the restoration.
        """
        with steps("measuring noise and contrast", len(self.pipelines) * self.ticks(0)) as bar:
            pipelines = [
                pipeline.fitted_to(self.read(band, bar.advance))
                for band, pipeline in enumerate(self.pipelines)
            ]
        return replace(self, pipelines=tuple(pipelines))

    def _stored(self, dn: np.ndarray, top: int) -> RestoredRow:
        """Return restored rows (bands, rows, width) of digital numbers as they are stored."""
        raster = self.source.raster
        full_scale = self.scale.value
        stop = top + dn.shape[1]
        missing = np.isnan(dn)
        factors = np.array([self._to_dn(band) for band in range(raster.bands)], np.float32)
        values = rounded(raster, dn / factors[:, None, None])
        pixels = as_stored(raster, values, full_scale)
        raw = np.ma.getdata(self.source.read(top, stop))
        valid = ~missing if missing.any() else None
        if valid is not None:
            pixels = np.where(missing, raster.unrestored(raw), pixels)
        tally = Tally.of(
            np.nan_to_num(raw.astype(np.float64)) / full_scale,
            values.astype(np.float64) / full_scale,
            valid,
            valid,
        )
        return RestoredRow(pixels, tally)


@dataclass(frozen=True)
class TraditionalMethod:
    """The traditional pipeline (denoising by NL-Bayes, then deconvolution) as a method that can
    restore images.

    Attributes:
        quality: 'fast', 'standard' or 'best', from quick to thorough.
    """

    quality: str

    @property
    def engine(self) -> Engine:
        """The default engine, because the pipeline runs no network and uses this process alone."""
        return Engine()

    def prepare(
        self,
        source: Source,
        reading: Reading,
        name: str,
        cluster: Cluster | None = None,  # noqa: ARG002
    ) -> TraditionalRestoration:
        """Prepare the restoration of an image by the pipeline, as `prepare.Pipeline.prepare`
        describes. The regularisation is fitted here, which reads the whole image.
        """
        raster = source.raster
        sensors = by_band(reading.sensors, raster, lambda sensor: sensor)
        needed = (
            FIXED_BYTES
            + BYTES_PER_COLUMN * raster.width_px * raster.bands
            + source.held_bytes(STRIP_PX)
        )
        check_memory(needed, reading.memory_bytes)
        rows = strips(raster.height_px, STRIP_PX)
        extents = (raster.extent(source.read(*strip)) for strip in rows)
        scale = full_scale_of(name, raster, extents, reading)
        check, check_s = check_sensor(source, (), reading, scale.value, name)
        pipelines = tuple(
            TraditionalPipeline(sensor.nominal(), sensor.reference.nominal(), self.quality)
            for sensor in sensors
        )
        restoration = TraditionalRestoration(
            source=source,
            name=name,
            reading=reading,
            scale=scale,
            check=check,
            check_s=check_s,
            out_shape=raster.shape,
            identity={"method": "traditional", "quality": self.quality},
            how=f"threads: {torch.get_num_threads()}",
            text={
                "method": "traditional",
                "sensor": ", ".join(sensor.name for sensor in sensors),
            },
            pipelines=pipelines,
        )
        return restoration.fitted()
