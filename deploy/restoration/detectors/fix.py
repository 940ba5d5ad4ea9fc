"""Replace the pixels of faulty detectors while an image's rows are read, before any other step
reads them.

The faults are those of a list, or are detected in a pass over the whole image before the first row
is restored. The same command, resumed or not, therefore replaces the same pixels.
"""

import logging
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation

from beers_deploy.model.metrics.detector_lines import constant_columns
from beers_deploy.model.metrics.detector_pixels import PATCH_PX, wrong_pixels
from beers_deploy.model.metrics.detector_stripes import Stripes
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import Source, strips
from beers_deploy.profiles.errors import ImageError, OptionError, counted
from beers_deploy.restoration.detectors.fault_list import (
    FOUND,
    Fault,
    FaultList,
    read_list,
)
from beers_deploy.restoration.detectors.strips import as_floats, faults_in_strips, value_steps

logger = logging.getLogger(__name__)

REACH_PX = 16
"""The largest distance of a valid neighbour."""
STRIP_PX = 256
"""Rows that are searched at a time."""
WRONG_GAIN = 0.05
"""The gain error from which a single column or row is replaced. Smaller ones are left for an
equalisation to correct.
"""
MANY = 0.01
"""The share of the pixels from which faults no longer count as single ones."""
ONE_SIDED = 1e-3
"""Weight of a direction with a valid neighbour on one side only, relative to one with two."""
ASLANT = 1e-6
"""Weight of the diagonals. They matter only where a faulty column crosses a faulty row."""
WAYS = {(0, 1): 1.0, (1, 0): 1.0, (1, 1): ASLANT, (1, -1): ASLANT}
"""The weight of each direction, by its offset in rows and columns: along a row, along a column,
diagonal. Pixels on both sides count.
"""


def faults_of(source: Source, source_name: str, name: str) -> FaultList:
    """Return the faults of detectors that a run replaces, and log their number.

    Args:
        source: the image.
        source_name: the value of the option `fix_detectors`: 'found' to detect faults in the image,
            the path of a list of faults, or empty to replace none.
        name: the name of the image, for messages.

    Raises:
        OptionError: the list cannot be read, or does not fit the image.
        ImageError: more than 1 % of the pixels look faulty as single pixels.
    """
    if not source_name:
        return FaultList(())
    faults = (
        find_faults(source, name)
        if source_name == FOUND
        else read_list(Path(source_name), source.raster)
    )
    require_neighbours(faults, source.raster)
    origin = "found" if source_name == FOUND else "listed"
    logger.info("faulty detectors: %s %s, to be interpolated", faults.words, origin)
    return faults


def require_neighbours(faults: FaultList, raster: Raster) -> None:
    """Warn of faulty columns and rows that stay as they are, without a valid one in reach.

    Args:
        faults: the faults to replace.
        raster: the description of the image.

    Raises:
        OptionError: all columns or all rows of a band are faulty.
    """
    sizes_px = {"column": raster.width_px, "row": raster.height_px}
    for band, (name, size_px) in product(range(1, raster.bands + 1), sizes_px.items()):
        along = "row" if name == "column" else "column"
        places = [
            getattr(fault, name)
            for fault in faults.faults
            if getattr(fault, along) < 0 and fault.band in (0, band)
        ]
        valid = np.ones(size_px, bool)
        valid[np.array(places, int)] = False
        if not valid.any():
            raise OptionError(
                f"`fix_detectors` lists all of {counted(size_px, name)} as faulty, so no pixel is "
                "left to interpolate from. List only the faulty ones."
            )
        reached = binary_dilation(valid, np.ones(2 * REACH_PX + 1))
        if stay := int(np.count_nonzero(~reached)):
            logger.warning(
                "look at the detectors: %s cannot be replaced, because no valid one is within "
                "%d px. Mark these pixels as nodata",
                counted(stay, f"faulty {name}"),
                REACH_PX,
            )


def find_faults(source: Source, name: str) -> FaultList:
    """Detect the faulty pixels, columns and rows of an image.

    Pixels, and rows that are dead (constant where their neighbours vary), are searched in the whole
    image. Columns, and rows with a wrong gain, are detected in the strips that `faults_in_strips`
    reads.

    Args:
        source: the image.
        name: the name of the image, for messages.

    Returns:
        The faults. A pixel of a faulty column or row is not listed again.

    Raises:
        ImageError: more than 1 % of the pixels look faulty as single pixels.
    """
    raster = source.raster
    lines = set[Fault]()
    for band, band_faults in enumerate(faults_in_strips(source)):
        number = band_number(band, raster)
        lines |= {Fault(column, -1, number) for column in _replaced(band_faults.columns)}
        lines |= {Fault(-1, row, number) for row in _replaced(band_faults.rows)}
    pixels = set[Fault]()
    steps = value_steps(source)
    for top, stop in strips(raster.height_px, STRIP_PX):
        # A pixel is compared with those around it, also beyond the strip.
        start = max(top - PATCH_PX, 0)
        end = min(stop + PATCH_PX, raster.height_px)
        for band, plane in enumerate(as_floats(raster, source.read(start, end))):
            number = band_number(band, raster)
            dead = np.flatnonzero(constant_columns(plane.T)) + start
            places = wrong_pixels(plane, steps[band]) + np.array([start, 0])
            lines |= {Fault(-1, int(row), number) for row in dead if top <= row < stop}
            pixels |= {
                Fault(int(column), int(row), number) for row, column in places if top <= row < stop
            }
            if len(pixels) > MANY * raster.height_px * raster.width_px * raster.bands:
                raise ImageError(
                    f"{name} has too many faulty pixels: more than {MANY:.0%}, apart from those of "
                    "faulty columns and rows. List the faulty pixels in a file."
                )
    alone = {
        pixel
        for pixel in pixels
        if lines.isdisjoint((replace(pixel, row=-1), replace(pixel, column=-1)))
    }
    return FaultList(tuple(sorted(lines | alone)))


def band_number(band: int, raster: Raster) -> int:
    """Return the number by which a list of faults names a band: from 1, or 0 for the only band.

    Args:
        band: the index of the band, from 0.
        raster: the description of the image.
    """
    return band + 1 if raster.bands > 1 else 0


def _replaced(stripes: Stripes) -> list[int]:
    """Return the numbers of the dead columns or rows, and of those with a gain error above
    WRONG_GAIN.
    """
    return [*stripes.dead, *(line.index for line in stripes.off if abs(line.gain) > WRONG_GAIN)]


class FixedSource:
    """An image whose faulty pixels are replaced by interpolation between valid neighbours.

    A pixel is interpolated along its row and along its column, between the nearest valid pixels
    within `REACH_PX`. The shorter distance has the larger weight, and a direction with a valid
    pixel on one side only has hardly any. If neither direction has a valid
    pixel, the diagonals are used. Without a valid pixel in reach the pixel stays, and so does a
    missing one.

    Attributes:
        faults: the faults whose pixels are replaced.
        raster: the description of the image.
        files: the files that the image is read from; empty for an array.
    """

    def __init__(self, source: Source, faults: FaultList) -> None:
        self._source = source
        self.faults = faults
        self.raster = source.raster
        self.files = source.files

    def read(self, start: int, stop: int) -> np.ndarray:
        """Read rows `start` to `stop` (excluded) of every band, with faulty pixels replaced.

        Returns:
            The pixels (bands, rows, width) as stored, in a masked array if the image has a mask.
        """
        raster = self.raster
        if not self.faults.mask(raster, start, stop).any():
            return self._source.read(start, stop)
        top = max(start - REACH_PX, 0)
        end = min(stop + REACH_PX, raster.height_px)
        stored = self._source.read(top, end).copy()
        known = ~raster.missing(stored)
        faulty = self.faults.mask(raster, top, end)
        targets = faulty & known
        # The rows around are read as neighbours only.
        targets[:, : start - top] = targets[:, stop - top :] = False
        pixels = np.ma.getdata(stored)
        for plane, bad, valid in zip(pixels, targets, ~faulty & known, strict=True):
            replace_pixels(plane, bad, valid, raster.nodata)
        return stored[:, start - top : stop - top]

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Read rows `start` to `stop` (excluded) of the image's mask or alpha, (rows, width)."""
        return self._source.read_mask(start, stop)

    def held_bytes(self, rows_px: int) -> int:
        """Return the bytes of memory that reading `rows_px` rows at a time needs in addition to
        these rows: for decoding the image, and for the rows around them with their flags.
        """
        raster = self.raster
        row_bytes = raster.bands * raster.width_px * (raster.dtype.itemsize + 4)
        around_px = rows_px + 2 * REACH_PX
        return self._source.held_bytes(around_px) + around_px * row_bytes


def replace_pixels(
    plane: np.ndarray, bad: np.ndarray, valid: np.ndarray, nodata: float | None
) -> None:
    """Replace faulty pixels of one band in place, by interpolation between valid neighbours.

    A faulty pixel without a valid neighbour within `REACH_PX` stays unchanged.

    Args:
        plane: the pixels (h, w), which this function changes.
        bad: mask (h, w) of the pixels to replace, bool.
        valid: mask (h, w) of the valid pixels to interpolate from, bool.
        nodata: the value that marks missing pixels, which no replaced pixel may take; None if there
            is no such value.
    """
    places = np.argwhere(bad)
    total = np.zeros(len(places))
    weights = np.zeros(len(places))
    closest = np.zeros(len(places))
    distance = np.full(len(places), np.inf)
    for way, weight in WAYS.items():
        side = np.array(way)
        left, near = _nearest(plane, valid, places, -side)
        right, far = _nearest(plane, valid, places, side)
        both = np.isfinite(near) & np.isfinite(far)
        either = np.isfinite(near) | np.isfinite(far)
        single = np.where(near <= far, left, right)
        # Without a neighbour on one side this is infinity over infinity, and is not used.
        with np.errstate(invalid="ignore"):
            between = (left * far + right * near) / (near + far)
        nearer = np.minimum(near, far)
        one_sided = np.where(either, ONE_SIDED / nearer, 0)
        share = np.where(both, 1 / (near + far), one_sided) * weight
        total += share * np.where(both, between, single)
        weights += share
        closest = np.where(nearer < distance, single, closest)
        distance = np.minimum(distance, nearer)
    reached = weights > 0
    result = total[reached] / weights[reached]
    result = (np.rint(result) if plane.dtype.kind in "ui" else result).astype(plane.dtype)
    # A pixel that is interpolated to the nodata value would be missing: it copies its neighbour.
    if nodata is not None:
        result = np.where(
            result == plane.dtype.type(nodata), closest[reached].astype(plane.dtype), result
        )
    rows, columns = places[reached].T
    plane[rows, columns] = result


def _nearest(
    plane: np.ndarray, valid: np.ndarray, places: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the value of the nearest valid pixel to one side of each of n places, (n,), and its
    distance in steps, (n,), which is inf if there is none.
    """
    values = np.zeros(len(places))
    distances = np.full(len(places), np.inf)
    for steps in range(1, REACH_PX + 1):
        rows, columns = (places + steps * side).T
        inside = (rows >= 0) & (rows < plane.shape[0]) & (columns >= 0) & (columns < plane.shape[1])
        inside[inside] = valid[rows[inside], columns[inside]]
        here = inside & np.isinf(distances)
        values[here] = plane[rows[here], columns[here]]
        distances[here] = steps
    return values, distances
