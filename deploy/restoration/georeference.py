"""Where an image lies on Earth, carried to one of more pixels: TIFF's tags of geography, scaled;
and files beside it.

A pixel's corner at (column, row) comes to `scale` times both. Tags that say what a pixel's middle
is (rational polynomials, and GeoTIFF's where the raster is of points) move by the half pixel
between the two.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from beers_deploy.model.io.tiff import number_of, require_small_offset
from beers_deploy.profiles.errors import ImageError
from beers_deploy.restoration.index_files import read_xml
from beers_deploy.restoration.source import NODATA_TAG, Raster, Tag, usable_nodata

PIXEL_SCALE = 33550
TIE_POINTS = 33922
TRANSFORMATION = 34264
KEYS = 34735
POLYNOMIALS = 50844
RASTER_TYPE = 1025
POINTS = 2
"""The key that says whether a raster is of areas or of points, and what it says of points."""
OFFSETS = (2, 3)
SCALES = (7, 8)
"""Of lines and samples, among the numbers of rational polynomials."""


def enlarged_tags(tags: tuple[Tag, ...], scale: int) -> tuple[Tag, ...]:
    """An image's tags for one of `scale` times the pixels along either side; the same where that is
    1.
    """
    if scale == 1:
        return tags
    values = {tag[0]: tag[3] for tag in tags}
    points = geo_keys(values.get(KEYS, ())).get(RASTER_TYPE) == POINTS
    return tuple(
        (tag[0], tag[1], tag[2], _enlarged(tag[0], tag[3], scale, points), tag[4]) for tag in tags
    )


def geo_keys(keys: Sequence[int]) -> dict[int, int]:
    """GeoTIFF's keys: a head of four numbers, and four for each: code, place of the value, count,
    value.
    """
    return {keys[k]: keys[k + 3] for k in range(4, len(keys) - 3, 4)}


def _enlarged(code: int, value: Any, scale: int, points: bool) -> Any:
    if code == PIXEL_SCALE:
        # The third number is the scale of heights, which do not change.
        return (value[0] / scale, value[1] / scale, *value[2:])
    if code == TIE_POINTS:
        return _tie_points(value, scale, points)
    if code == TRANSFORMATION and len(value) == 16:
        return _transformation(value, scale, points)
    if code == POLYNOMIALS:
        places = dict.fromkeys(OFFSETS, _middle) | dict.fromkeys(
            SCALES, lambda number, by: number * by
        )
        return tuple(
            places[k](number, scale) if k in places else number for k, number in enumerate(value)
        )
    return value


def _middle(place: float, scale: int) -> float:
    """Where the middle of a pixel at this place comes to, counted from the
    middle of the first one.
    """
    return (place + 0.5) * scale - 0.5


def _tie_points(value: Sequence[float], scale: int, points: bool) -> tuple[float, ...]:
    """Six numbers each: column, row, level, and three on Earth."""
    moved = [_middle(number, scale) if points else number * scale for number in value]
    return tuple(moved[k] if k % 6 < 2 else number for k, number in enumerate(value))


def _transformation(value: Sequence[float], scale: int, points: bool) -> tuple[float, ...]:
    """A matrix (4, 4) row by row, from column, row and level to three on Earth."""
    rows = [list(value[k : k + 4]) for k in range(0, 16, 4)]
    # Of points, (0, 0) is the middle of the first pixel, which moves with the pixel's size.
    shift = (0.5 / scale - 0.5) if points else 0.0
    for row in rows[:3]:
        row[3] += shift * (row[0] + row[1])
        row[0] = row[0] / scale
        row[1] = row[1] / scale
    return tuple(chain.from_iterable(rows))


AUX_BYTES = 1 << 20
UNREAD = (".tfw", ".tifw", ".wld", ".jgw", ".pgw", ".j2w", ".RPB", ".rpb", "_RPC.TXT", "_rpc.txt")
"""Ends of files beside an image that say where it lies, as GDAL finds them."""


def sidecar_of(path: Path) -> Path:
    """Return where GDAL keeps metadata that IMAGE itself cannot hold: IMAGE.aux.xml."""
    return path.with_name(f"{path.name}.aux.xml")


def of_sidecar(path: Path, raster: Raster) -> Raster:
    """The raster with the nodata value that GDAL keeps in IMAGE.aux.xml, where the image has none
    of its own.
    """
    beside = sidecar_of(path)
    if not beside.is_file():
        return raster
    root = read_xml(beside, AUX_BYTES, "metadata as GDAL writes it", "write it again, or remove it")
    name = str(beside)
    bands = list(root.iter("PAMRasterBand"))
    for band in bands:
        offset, scale = (
            number_of(band.findtext(key, ""), usual) for key, usual in (("Offset", 0), ("Scale", 1))
        )
        require_small_offset(name, offset, scale)
    nodata_texts = {band.findtext("NoDataValue", "").strip() for band in bands} - {""}
    if len(nodata_texts) > 1:
        raise ImageError(
            name,
            expected="one nodata value",
            got=", ".join(sorted(nodata_texts)),
            remedy="split the bands",
        )
    values = [number_of(text, math.nan) for text in nodata_texts] if raster.nodata is None else []
    nodata = usable_nodata(name, values[0], raster.dtype) if values else None
    if nodata is None:
        return raster
    return replace(
        raster, nodata=nodata, tags=(*raster.tags, (NODATA_TAG, 2, 0, f"{nodata:.17g}", True))
    )


def unread_places(path: Path, raster: Raster) -> list[str]:
    """A sentence for each file beside an image that says where it lies, which itself does not; they
    are not read.
    """
    if {tag[0] for tag in raster.tags} & {PIXEL_SCALE, TRANSFORMATION, KEYS, POLYNOMIALS}:
        return []
    sidecars = [path.with_name(f"{path.stem}{end}") for end in UNREAD]
    return [
        f"{sidecar.name} is not read: keep it beside the result, or write its place into the image"
        for sidecar in sidecars
        if sidecar.is_file()
    ]
