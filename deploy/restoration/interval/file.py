"""The file of half-widths next to a restored image."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from beers_deploy.model.io.files import whole_file
from beers_deploy.model.levels import Level
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.facts import BandInfo, Raster
from beers_deploy.model.raster.writer import write_raster
from beers_deploy.restoration.interval.half_widths import HalfWidths

ENDING = "-interval.tif"


def interval_beside(out: Path) -> Path:
    """Return the path of the file of half-widths of a restored image."""
    return out.with_name(f"{out.stem}{ENDING}")


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
