"""What GDAL reads, by windows: JPEG 2000, NITF, HFA, and the indexes VRT and DIMAP that make one
image of many tiles.

GDAL comes with rasterio, an optional package. It is given one driver for one file, sees no file
beside it and no network unless the user trusts the index, and keeps a cache of blocks that counts
as memory of the run.
"""

import io
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from beers_deploy.model.io.tiff import require_small_offset
from beers_deploy.profiles.errors import CODE_FAULTS, BeersError, ImageError, optional
from beers_deploy.restoration.index_files import dimap_bits, index_files, is_index
from beers_deploy.restoration.source import (
    GDAL_DRIVERS,
    RGB_BANDS,
    Plane,
    Raster,
    Source,
    Tag,
    VeiledSource,
    carried_tags,
    is_restored,
    require_numbers,
    require_size,
    usable_nodata,
)

LEAST_CACHE_BYTES = 1 << 26
ENVIRONMENT = {
    # GDAL must open no file beside the image, because such a file was not checked.
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    # Threads that decode print their errors, which are raised as one exception as well.
    "CPL_LOG": os.devnull,
}
OFFLINE = {"CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}"}

# Its messages are not printed; a program that adds a handler of its own still gets them.
logging.getLogger("rasterio").addHandler(logging.NullHandler())


@contextmanager
def open_gdal(path: Path, trusted: bool = False) -> Iterator[Source]:
    """Open an image of a suffix in `GDAL_DRIVERS` for reading by rows.

    Args:
        path: of the file or the index.
        trusted: as in `index_files`.
    """
    rasterio = optional("rasterio", str(path))
    files = path, *index_files(path, trusted)
    tiles = [file for file in files[1:] if not is_index(file)]
    environment = ENVIRONMENT if trusted else ENVIRONMENT | OFFLINE
    with _damage_in_a_sentence(path), rasterio.Env(**environment):
        dataset = rasterio.open(path.resolve(), driver=GDAL_DRIVERS[path.suffix.lower()])
        block_px = _block_px(dataset)
        # A mosaic states blocks of its own, but decodes those of its tiles, which are mostly alike.
        if tiles:
            with rasterio.open(tiles[0]) as tile:
                block_px = max(block_px, _block_px(tile))
    with dataset:
        source = GdalSource(files, dataset, block_px, environment)
        flags = {flag.name for flag in dataset.mask_flag_enums[0]}
        if "alpha" in flags:
            yield VeiledSource(source, "unassalpha")
        elif "per_dataset" in flags:
            yield VeiledSource(source, "mask", source.read_mask)
        else:
            yield source


def _block_px(dataset: Any) -> int:
    """Rows of the blocks in which an image is decoded."""
    return max((int(rows) for rows, _ in dataset.block_shapes), default=1)


@contextmanager
def _damage_in_a_sentence(path: Path, where: str = "") -> Iterator[None]:
    try:
        # An image need not lie anywhere on Earth.
        with warnings.catch_warnings(action="ignore"):
            yield
    except (BeersError, MemoryError, *CODE_FAULTS):
        raise
    except Exception as error:
        cause: BaseException = error
        # rasterio's own message is "see previous exception", so the first cause is reported.
        while cause.__cause__ is not None:
            cause = cause.__cause__
        name = f"{path}, {where}" if where else str(path)
        got = " ".join(str(cause).split())[:160] or type(cause).__name__
        remedy = "check that it is a whole image"
        expected = f"an image that GDAL reads as {GDAL_DRIVERS[path.suffix.lower()]}"
        raise ImageError(name, expected=expected, got=got, remedy=remedy) from error


class GdalSource:
    """An image that GDAL has opened; one thread reads at a time."""

    veil: Plane | None = None

    def __init__(
        self, files: tuple[Path, ...], dataset: Any, block_px: int, environment: dict[str, Any]
    ) -> None:
        self.files = files
        self._path = files[0]
        self._dataset = dataset
        self._environment = environment
        with _damage_in_a_sentence(self._path):
            self.raster = _raster(self._path, dataset)
        self._block_px = block_px

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows `start` to `stop` (excluded) of every band, (bands, rows, width), as stored."""
        return self._read(self._dataset.read, start, stop)

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """The same rows of the image's mask, (1, rows, width) uint8."""
        return self._read(self._dataset.dataset_mask, start, stop)[None]

    def _read(self, read_window: Callable[..., Any], start: int, stop: int) -> np.ndarray:
        rasterio: Any = import_module("rasterio")
        environment = self._environment | {"GDAL_CACHEMAX": self.held_bytes(stop - start)}
        with (
            _damage_in_a_sentence(self._path, f"rows {start} to {stop - 1}"),
            rasterio.Env(**environment),
        ):
            return np.asarray(
                read_window(
                    window=rasterio.windows.Window(0, start, self.raster.width_px, stop - start)
                )
            )

    def held_bytes(self, rows_px: int) -> int:
        """GDAL's cache: the blocks around the rows, so that none is decoded for two strips."""
        row_bytes = self.raster.bands * self.raster.width_px * self.raster.dtype.itemsize
        return int(max(LEAST_CACHE_BYTES, (rows_px + 2 * self._block_px) * row_bytes))


def _raster(path: Path, dataset: Any) -> Raster:
    """What GDAL says of an image, before any pixel is read."""
    if dataset.count == 0:
        remedy = "give the file of one of them" + (
            f", as {dataset.subdatasets[0]}" if dataset.subdatasets else ""
        )
        raise ImageError(str(path), expected="one image", got="several, or none", remedy=remedy)
    for kind, values in (("types", dataset.dtypes), ("nodata values", dataset.nodatavals)):
        if len({str(value) for value in values}) > 1:
            got = ", ".join(str(value) for value in values)
            raise ImageError(
                str(path), expected=f"bands of equal {kind}", got=got, remedy="split the bands"
            )
    name = str(path)
    dtype = require_numbers(str(path), np.dtype(dataset.dtypes[0]))
    require_size(name, dataset.count, dataset.height, dataset.width)
    colours = [values.name for values in dataset.colorinterp]
    if "palette" in colours:
        remedy = "convert it with 'gdal_translate -expand'"
        raise ImageError(
            name, expected="pixels where more is brighter", got="a palette", remedy=remedy
        )
    for offset, scale in zip(dataset.offsets, dataset.scales, strict=True):
        require_small_offset(name, offset, scale)
    nodata = usable_nodata(name, dataset.nodatavals[0], dtype)
    about = nodata, _tags(dataset, nodata), _bits(path, dataset)
    colour = colours[: len(RGB_BANDS)] == list(RGB_BANDS)
    restored = is_restored(dataset.tags().get("TIFFTAG_SOFTWARE", ""), dataset.tags())
    size = dataset.count, dataset.height, dataset.width
    return Raster(*size, dtype, *about, colour=colour, restored=restored)


def _bits(path: Path, dataset: Any) -> int | None:
    """The bits per pixel that the file states, the largest of its bands'; None where any band
    states none.

    A DIMAP says it of the product; of other files what fills the type is a container, as in a plain
    TIFF.
    """
    if (product_bits := dimap_bits(path)) is not None:
        return product_bits
    bands = range(1, dataset.count + 1)
    band_bits = [str(dataset.tags(band, ns="IMAGE_STRUCTURE").get("NBITS", "")) for band in bands]
    texts = band_bits if all(band_bits) else [str(dataset.tags().get("NITF_ABPP", "")).strip()]
    most = max((int(text) for text in texts if text.isdecimal()), default=0)
    # Bits that fill the type describe the container, not the sensor.
    return most if 0 < most < 8 * np.dtype(dataset.dtypes[0]).itemsize else None


def _tags(dataset: Any, nodata: float | None) -> tuple[Tag, ...]:
    """Georeference, RPCs, names and gains of bands as TIFF tags: those of a file of one pixel that
    GDAL writes.
    """
    profile = {
        "driver": "GTiff",
        "width": 1,
        "height": 1,
        "count": dataset.count,
        "dtype": dataset.dtypes[0],
    }
    profile |= {} if nodata is None else {"nodata": nodata}
    with import_module("rasterio.io").MemoryFile() as memory:
        with memory.open(**profile, **_place(dataset)) as small:
            small.update_tags(
                **{key: value for key, value in dataset.tags().items() if key == "AREA_OR_POINT"}
            )
            if dataset.rpcs is not None:
                small.rpcs = dataset.rpcs
            small.descriptions = dataset.descriptions
            small.units = [unit or "" for unit in dataset.units]
            small.scales = dataset.scales
            small.offsets = dataset.offsets
            for band in range(1, dataset.count + 1):
                small.update_tags(band, **dataset.tags(band))
        content = memory.read()
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        return carried_tags(file.pages.first)


def _place(dataset: Any) -> dict[str, Any]:
    """Where an image lies, as rasterio takes it: by a transform or by ground control points; empty
    for none.
    """
    points, points_crs = dataset.gcps
    if points:
        return {"gcps": points, "crs": points_crs}
    placed = {} if dataset.transform.is_identity else {"transform": dataset.transform}
    return placed | ({"crs": dataset.crs} if dataset.crs else {})
