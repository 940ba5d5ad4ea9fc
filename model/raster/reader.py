"""Open images by windows with GDAL: TIFF, PNG, JPEG, JPEG 2000, NITF, HFA, ENVI, and the indexes
VRT and DIMAP that combine many tiles to one image.

GDAL chooses among all of its drivers by content, opens files that a file names, and can use the
network. Here the suffix selects the driver, and an index and its tiles are checked before GDAL
opens them (`model.raster.index`). All files that GDAL reports afterwards must lie in the image's
folder, unless the user trusts the index.
"""

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rasterio
from rasterio.windows import Window

from beers_deploy.model.raster.description import mask_file, raster_of
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.index import MAGIC, first_bytes, index_files, is_index, read_xml
from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.errors import (
    CODE_FAULTS,
    BeersError,
    ImageError,
    MachineError,
    printable,
    sizes,
)
from beers_deploy.profiles.user_files.whole import unreadable

HFA = b"EHFA_HEADER_TAG"
"""The first bytes of a file of ERDAS Imagine (HFA)."""

DRIVERS = {
    **dict.fromkeys((".tif", ".tiff", ".btf", ".tf8"), "GTiff"),
    ".png": "PNG",
    **dict.fromkeys((".jpg", ".jpeg"), "JPEG"),
    **dict.fromkeys((".jp2", ".j2k"), "JP2OpenJPEG"),
    **dict.fromkeys((".ntf", ".nitf"), "NITF"),
    ".img": "HFA",
    **dict.fromkeys((".dat", ".bsq", ".bil", ".bip"), "ENVI"),
    ".vrt": "VRT",
    ".xml": "DIMAP",
}
"""GDAL's drivers by suffix: others of its drivers open further files, or the network."""
FORMATS = {"GTiff": "TIFF", "JP2OpenJPEG": "JPEG 2000"}
"""The names of formats in messages, if they differ from the names of GDAL's drivers."""

LEAST_CACHE_BYTES = 1 << 26
AUX_BYTES = 1 << 20
"""The largest .aux.xml that is read."""
ENVIRONMENT = {
    # GDAL looks for each sidecar by its name, so that a large folder costs nothing.
    "GDAL_DISABLE_READDIR_ON_OPEN": "TRUE",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    # A VRT could show any file of the machine as raw pixels.
    "GDAL_VRT_RAWRASTERBAND_ALLOWED_SOURCE": "NONE",
    # Otherwise the end of a truncated JPEG is grey, without any error.
    "GDAL_ERROR_ON_LIBJPEG_WARNING": "TRUE",
    # GDAL's other way of reading a whole PNG leaves memory uninitialised if the file ends early.
    "GDAL_PNG_WHOLE_IMAGE_OPTIM": "NO",
    # Threads that decode print their errors, which are raised as one exception as well.
    "CPL_LOG": os.devnull,
}
OFFLINE = {"CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}"}

# GDAL's messages are not printed; a program that adds a handler of its own still gets them.
logging.getLogger("rasterio").addHandler(logging.NullHandler())


def require_utf8(path: Path) -> None:
    """Raise ImageError if rasterio cannot open a path, because the name is not UTF-8."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise ImageError(
            f"{printable(str(path.absolute()))} is not UTF-8, as names of images and of their "
            "folders must be. Rename the part that is not."
        ) from None


def require_image_file(path: Path) -> None:
    """Raise ImageError if a path is no file, is not UTF-8, or is an empty file."""
    require_utf8(path)
    reason = unreadable(path)
    if reason is not None:
        raise ImageError(f"{printable(str(path))} cannot be read: {reason}. Check the path.")
    if path.stat().st_size == 0:
        raise ImageError(f"{path} is an empty file. Write or copy it again.")


@contextmanager
def gdal(**options: Any) -> Iterator[None]:
    """Configure GDAL for untrusted files within the block, and silence its warnings.

    Args:
        options: further configuration options of GDAL, by their names.
    """
    # An image need not lie anywhere on Earth, which rasterio warns about.
    with warnings.catch_warnings(action="ignore"), rasterio.Env(**ENVIRONMENT, **options):
        yield


@contextmanager
def open_raster(path: Path, trusted: bool = False) -> Iterator[Source]:
    """Open an image of any size for reading by rows, within the block.

    Args:
        path: an image file, or the index of its tiles (VRT, DIMAP).
        trusted: whether an index may name files outside its folder, and URLs.

    Yields:
        The image, whose `files` include the sidecars and tiles that GDAL reads.

    Raises:
        ImageError: no image, a damaged one, or one whose pixels cannot be restored.
        MachineError: two rows of the image's strips or tiles do not fit in memory.
    """
    require_image_file(path)
    driver = _driver(path)
    tiles = index_files(path, trusted)
    for file in (path, *tiles):
        _require_sidecars(file)
    options = {} if trusted else OFFLINE
    with damage_in_a_sentence(path), gdal(**options):
        dataset = rasterio.open(path.absolute(), driver=driver)
    with dataset:
        with damage_in_a_sentence(path), gdal(**options):
            files = _files(path, tiles, dataset, trusted)
            rows = [int(rows) for rows, _ in dataset.block_shapes]
            # A mosaic states blocks of its own, but decodes those of its tiles, which are mostly
            # alike.
            for file in [tile for tile in tiles if not is_index(tile)][:1]:
                with rasterio.open(file) as tile:
                    rows += [int(tile_rows) for tile_rows, _ in tile.block_shapes]
            raster = raster_of(path, dataset)
            _require_whole(path, dataset)
        source = GdalSource(files, dataset, raster, max(rows, default=1), options)
        needed = source.held_bytes(1)
        free = psutil.virtual_memory().available
        # Checked before a strip or tile is decoded.
        if needed > max(free, 2 * LEAST_CACHE_BYTES):
            room, size = sizes(free, needed)
            raise MachineError(
                f"{path} needs {size} for two of its strips or tiles, but there is only {room} of "
                "free memory. Rewrite it in smaller tiles (gdal_translate -co TILED=YES)."
            )
        yield source


def _driver(path: Path) -> str:
    """Return the GDAL driver that opens a file; ENVI's own files may end in .img as well."""
    suffix = path.suffix.lower()
    if suffix not in DRIVERS:
        raise ImageError(
            f"{path} must be an image with a suffix of {', '.join(DRIVERS)}, got "
            f"{suffix or 'none'}. Rename it, or convert it with 'gdal_translate'."
        )
    if suffix == ".img" and path.with_suffix(".hdr").is_file():
        # The header may belong to another file of that stem.
        return DRIVERS[suffix] if first_bytes(path, len(HFA)) == HFA else "ENVI"
    return DRIVERS[suffix]


def _require_sidecars(path: Path) -> None:
    """Raise ImageError if GDAL would misread or ignore a mask or metadata file next to an image."""
    advice = "Write it again, or remove it."
    mask = mask_file(path)
    if mask.is_file():
        # GDAL opens a mask with any of its drivers, also with those that follow names.
        is_tiff = first_bytes(mask, 4) in MAGIC[:4]
        if not is_tiff:
            raise ImageError(f"{mask} is not a mask stored as TIFF. {advice}")
    metadata = path.with_name(f"{path.name}.aux.xml")
    if metadata.is_file():
        read_xml(metadata, AUX_BYTES, "metadata as GDAL writes it", advice)


def _files(path: Path, tiles: tuple[Path, ...], dataset: Any, trusted: bool) -> tuple[Path, ...]:
    """Return all files that an image is read from; raise ImageError if one is outside
    its folder.
    """
    homes = {path.absolute().parent, path.resolve().parent}
    files = {path: None} | dict.fromkeys(tiles)
    resolved = {file.resolve() for file in files}
    for name in dataset.files:
        file = Path(name)
        real = file.resolve()
        if real in resolved:
            continue
        inside = any(real.is_relative_to(home) for home in homes)
        if not inside and not trusted:
            raise ImageError(
                f"{path} needs a file outside its own folder: {printable(name)}. Put it into the "
                "folder of the image, or read it anyway with `force`."
            )
        if real.is_file():
            files[file] = None
            resolved.add(real)
    # GDAL lists a mask next to the image among its files only after the mask has been read.
    mask = mask_file(path)
    return tuple(files | ({mask: None} if mask.is_file() else {}))


@contextmanager
def damage_in_a_sentence(path: Path, rows: str = "") -> Iterator[None]:
    """Turn any error that GDAL raises within the block into an ImageError with one sentence.

    Args:
        path: the path of the image that GDAL reads.
        rows: the part that is read, such as "rows 0 to 255", for the message; empty for the whole.
    """
    try:
        yield
    except (BeersError, MemoryError, *CODE_FAULTS):
        raise
    except Exception as error:
        cause: BaseException = error
        # rasterio's own message is "see previous exception", so the first cause is reported.
        while cause.__cause__ is not None:
            cause = cause.__cause__
        reason = " ".join(str(cause).split())[:160] or type(cause).__name__
        advice = "Check that it is a whole image"
        if "missing codec" in reason:
            advice = "Write it with deflate, LZW or ZSTD"
        # GDAL's own sentence repeats the path.
        if "not recognized as being in a supported file format" in reason:
            reason = "it has another format"
        part = f" in {rows}" if rows else ""
        driver = DRIVERS.get(path.suffix.lower(), "raster")
        kind = FORMATS.get(driver, driver)
        raise ImageError(
            f"{path} is not a readable {kind}{part}: {reason.rstrip('.')}. {advice}."
        ) from error


@dataclass
class GdalSource:
    """An image that GDAL has opened, as a `Source` of rows; one thread reads at a time.

    Attributes:
        files: the files that the image is read from.
        dataset: the open image of rasterio.
        raster: the facts of the image.
        block_px: the number of rows of the strips or tiles that GDAL decodes as a whole.
        options: GDAL's configuration options while it reads.
    """

    files: tuple[Path, ...]
    dataset: Any
    raster: Raster
    block_px: int
    options: dict[str, str]

    def read(self, start: int, stop: int) -> np.ndarray:
        """Read rows `start` to `stop` (excluded) of every band as stored, (bands, rows, width).

        The result is a masked array if the image has a mask or alpha.
        """
        bands = list(range(1, self.raster.bands + 1))
        pixels = self._read(self.dataset.read, start, stop, indexes=bands)
        if not self.raster.mask_kind:
            return pixels
        hidden = self.read_mask(start, stop) == 0
        return np.ma.MaskedArray(pixels, mask=np.broadcast_to(hidden, pixels.shape))

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Read rows `start` to `stop` (excluded) of the mask or of alpha, (rows, width); 0 marks a
        missing pixel.
        """
        if self.raster.mask_kind == "alpha":
            return self._read(self.dataset.read, start, stop, indexes=self.raster.bands + 1)
        return self._read(self.dataset.dataset_mask, start, stop)

    def _read(
        self, read_window: Callable[..., Any], start: int, stop: int, **options: Any
    ) -> np.ndarray:
        window = Window(0, start, self.raster.width_px, stop - start)
        cache = {"GDAL_CACHEMAX": self.held_bytes(stop - start)}
        rows = f"rows {start} to {stop - 1}"
        with damage_in_a_sentence(self.files[0], rows), gdal(**self.options, **cache):
            return np.asarray(read_window(window=window, **options))

    def held_bytes(self, rows_px: int) -> int:  # noqa: ARG002
        """Return the bytes of GDAL's cache: two rows of the strips or tiles in which the image is
        stored, for any `rows_px`.

        Ranges of rows that are read one after the other overlap by less than that, so that nothing
        is decoded twice.
        """
        raster = self.raster
        planes = raster.bands + (raster.mask_kind == "alpha")
        row_bytes = planes * raster.width_px * raster.dtype.itemsize
        return int(max(LEAST_CACHE_BYTES, 2 * self.block_px * row_bytes))


def _require_whole(path: Path, dataset: Any) -> None:
    """Raise ImageError if a TIFF ends before its last strip or tile, which a long run would detect
    late.
    """
    if dataset.driver != "GTiff":
        return
    size = path.stat().st_size
    for band, (rows_px, columns_px) in enumerate(dataset.block_shapes, 1):
        last = f"{(dataset.width - 1) // columns_px}_{(dataset.height - 1) // rows_px}"
        offset, count = (
            int(dataset.get_tag_item(f"BLOCK_{kind}_{last}", "TIFF", bidx=band) or 0)
            for kind in ("OFFSET", "SIZE")
        )
        if offset + count > size:
            raise ImageError(
                f"{path} is not a readable TIFF, because it is cut short at {size} of "
                f"{offset + count} bytes. Copy it again."
            )
