"""The self-check of a restored image: run over all of its rows, reported, refused and written.

`model.self_check` checks blocks. Here each band is read once more from the image and from the
finished rows, the blocks are counted, and the map of them can be written as a GeoTIFF.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.facts import BandInfo, Raster
from beers_deploy.model.raster.source import Source, strips
from beers_deploy.model.raster.writer import write_array
from beers_deploy.model.self_check import (
    BLOCK_PX,
    LEAST_SHARPENING,
    MOST_CHI2,
    MOST_PER_SHARPENING,
    OUTSIDE,
    REACH_PX,
    SMOOTH,
    WITHIN,
    Judged,
    SelfCheck,
)
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.restoration.bands import by_band

ROWS_PX = 4 * BLOCK_PX
COLUMNS_PX = 32 * BLOCK_PX
"""Rows and columns that are checked at a time, in addition to REACH_PX on every side."""

MANY_OUTSIDE = 0.01
"""If a larger share of decidable blocks is outside the bound, there is a warning, or an error with
`strict`. For correct restorations none was outside (measured on photographs).
"""

ReadRows = Callable[[int, int, int], np.ndarray]
"""Returns restored rows (rows, width) as stored, given the band, the first row and the end."""


@dataclass(frozen=True)
class BlockMap:
    """The result of the self-check for every block of an image.

    The self-check blurs the restored image as the sensor blurs, and compares blocks of `BLOCK_PX` x
    `BLOCK_PX` pixels with the raw image.

    Attributes:
        bands: the measurements of the blocks of each band that has a known sensor, by the number of
            the band from 0.
    """

    bands: Mapping[int, Judged]

    @property
    def known(self) -> int:
        """The number of blocks, over all bands, with enough pixels to be compared."""
        return sum(int(np.isfinite(judged.chi2).sum()) for judged in self.bands.values())

    @property
    def decidable(self) -> int:
        """The number of blocks, over all bands, that would show a wrong restoration: those that the
        restoration sharpened enough, and those outside the bound.
        """
        return sum(int(judged.decidable.sum()) for judged in self.bands.values())

    @property
    def outside(self) -> int:
        """The number of blocks, over all bands, that contradict the raw image: they differ from it
        by more than noise.
        """
        return sum(int(judged.outside.sum()) for judged in self.bands.values())

    @property
    def figures(self) -> dict[str, Figure]:
        """Two figures in %, by name, for the results of a run: the share of decidable blocks that
        contradict the raw image, and the share of blocks too smooth to decide. A share of no block
        is unavailable.
        """
        blocks = f"blocks of {BLOCK_PX} x {BLOCK_PX} pixels"
        outside = f"{blocks} that are decidable: differ from the raw image by more than noise"
        smooth = f"{blocks}: too smooth to show a wrong restoration"
        undecided = self.known - self.decidable
        return {
            "self-check outside": _share(
                self.outside, self.decidable, outside, "no block would show a wrong restoration"
            ),
            "self-check not decidable": _share(
                undecided, self.known, smooth, "no block has enough pixels to be compared"
            ),
        }

    @property
    def doubt(self) -> str:
        """The warning on a result that contradicts its raw image, without the subject of the
        sentence; empty if at most `MANY_OUTSIDE` of the decidable blocks contradict it.
        """
        if self.outside <= MANY_OUTSIDE * self.decidable:
            return ""
        return (
            f"fails the self-check: {self.outside} of {self.decidable} decidable blocks contradict "
            "the raw image, because they differ from it, blurred as the sensor blurs, by more than "
            "noise. Check that `sensor` acquired the image, that it was not restored or resampled "
            "before, that the network was made for this sensor, and that its file is intact."
        )

    def require(self, name: str) -> None:
        """Raise ImageError if more than `MANY_OUTSIDE` of the decidable blocks contradict the raw
        image.

        Args:
            name: the name of the image, for the message.
        """
        if self.doubt:
            raise ImageError(f"{name}: the restoration {self.doubt}")


def _share(part: int, whole: int, source: str, none: str) -> Figure:
    """Return a share of blocks in %; unavailable for the reason `none` if there is no block."""
    if not whole:
        return unavailable("%", none)
    return measured(100 * part / whole, "%", source)


def checks_of(
    sensors: Mapping[str, Sensor], raster: Raster, out_shape: Sequence[int], full_scale: float
) -> dict[int, SelfCheck]:
    """Build the self-check of each band whose sensor is known. It compares the restored image,
    blurred as the sensor blurs, with the raw image.

    Args:
        sensors: the sensor by the name of the band; a sensor for all bands has the key "".
        raster: the description of the raw image.
        out_shape: the shape of the restored image, (bands, H, W). If it is not that of the raw
            image, there is no self-check.
        full_scale: the pixel value that is full scale.

    Returns:
        The self-checks by the number of the band, from 0; empty if there is none.
    """
    if tuple(out_shape) != raster.shape or not sensors:
        return {}

    def check_for(sensor: Sensor) -> SelfCheck | None:
        if sensor.name == BLIND:
            return None
        return SelfCheck.of(sensor.nominal(), sensor.reference.nominal(), full_scale)

    checks = enumerate(by_band(sensors, raster, check_for))
    return {band: check for band, check in checks if check is not None}


def check_result(source: Source, read: ReadRows, checks: Mapping[int, SelfCheck]) -> BlockMap:
    """Compare all blocks of a restored image with the raw image.

    Args:
        source: the raw image.
        read: returns restored rows (rows, width), given the band, the first row and the end.
        checks: the self-check of each band that has one, by the number of the band from 0.
    """
    raster = source.raster
    judged: dict[int, list[Judged]] = {band: [] for band in checks}
    rows = list(strips(raster.height_px, ROWS_PX)) if checks else []
    with steps("self-check", len(rows)) as bar:
        for start, stop in rows:
            top = max(start - REACH_PX, 0)
            bottom = min(stop + REACH_PX, raster.height_px)
            down = Placed(raster.height_px, top, start, stop)
            stored = source.read(top, bottom)
            missing = raster.missing(stored)
            stored = np.ma.getdata(stored)
            for band, check in checks.items():
                raw = np.where(missing[band], np.nan, stored[band]).astype(np.float32)
                restored = read(band, top, bottom).astype(np.float32)
                parts = []
                # Window by window, which bounds the memory.
                for first, end in strips(raster.width_px, COLUMNS_PX):
                    left = max(first - REACH_PX, 0)
                    right = min(end + REACH_PX, raster.width_px)
                    across = Placed(raster.width_px, left, first, end)
                    columns = slice(left, right)
                    parts.append(check.judge(raw[:, columns], restored[:, columns], down, across))
                judged[band].append(_joined(parts, axis=1))
            bar.advance()
    return BlockMap({band: _joined(parts, axis=0) for band, parts in judged.items()})


def _joined(parts: Sequence[Judged], axis: int) -> Judged:
    chi2, sharpening = zip(*((part.chi2, part.sharpening) for part in parts), strict=True)
    return Judged(np.concatenate(chi2, axis), np.concatenate(sharpening, axis))


def write_map(path: Path, blocks: BlockMap, raster: Raster) -> None:
    """Write the result of the self-check as a GeoTIFF of float32 with one pixel for each block.

    The file has two planes for each band that was checked: chi2, the squared difference from the
    raw image over that of noise alone, and the state of the block (0 within the bound, 1 outside, 2
    too smooth to decide). Both are NaN where too few pixels are known.

    Args:
        path: the path of the GeoTIFF.
        blocks: the result for every block.
        raster: the description of the raw image, with its place on Earth and the names of bands.
    """
    planes = []
    infos = []
    for band, judged in blocks.bands.items():
        state = np.where(judged.decidable, np.where(judged.outside, OUTSIDE, WITHIN), SMOOTH)
        planes += [judged.chi2, np.where(np.isnan(judged.chi2), np.nan, state)]
        name = raster.band_names[band] if raster.band_names else f"band {band + 1}"
        infos += [
            BandInfo(
                f"{name}: chi2",
                tags=(
                    ("most", f"{MOST_CHI2:g}"),
                    ("most_per_sharpening", f"{MOST_PER_SHARPENING:g}"),
                ),
            ),
            BandInfo(
                f"{name}: state",
                tags=(
                    ("meaning", "0 within the bound, 1 outside, 2 too smooth to decide"),
                    ("least_sharpening", f"{LEAST_SHARPENING:g}"),
                ),
            ),
        ]
    pixels = np.stack(planes).astype(np.float32)
    count, height, width = pixels.shape
    facts = replace(
        raster,
        bands=count,
        height_px=height,
        width_px=width,
        dtype=pixels.dtype,
        nodata=float("nan"),
        mask_kind="",
        colour=False,
        georeference=raster.georeference.enlarged(1 / BLOCK_PX),
        band_info=tuple(infos),
        tags=(),
    )
    write_array(path, facts, pixels)
