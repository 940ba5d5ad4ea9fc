"""Images and mosaics for the fuzzer to damage, and the functions that read them."""

import io
import shutil
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from PIL import Image

from beers_deploy.model.raster.reader import open_raster
from tests.model.raster import formats as images


def written(make: Callable[[Path], object], path: Path) -> bytes:
    """Return the bytes of a file that `make` writes."""
    make(path)
    return path.read_bytes()


def tiff_seeds(folder: Path) -> list[bytes]:
    """Return TIFFs with strips and tiles, compressed or not, with bands in planes or interleaved,
    with pages, geographic tags and both byte orders.
    """
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 4096, (17, 19)).astype(np.uint16)
    colour = rng.integers(0, 256, (17, 19, 3)).astype(np.uint8)
    nodata = [(42113, "s", 0, "7", True), (33550, "d", 3, (1.0, 1.0, 0.0), True)]
    path = folder / "a.tif"
    kinds: list[tuple[np.ndarray, dict[str, object]]] = [
        (grey, {"rowsperstrip": 5}),
        (grey, {"tile": (16, 16), "compression": "zlib", "predictor": True}),
        (grey.astype(np.float32), {"extratags": nodata, "metadata": None}),
        (colour, {"photometric": "rgb", "compression": "zlib"}),
        (np.moveaxis(colour, 2, 0), {"photometric": "rgb", "planarconfig": "separate"}),
        (np.stack([grey, grey]), {"photometric": "minisblack"}),
        (grey, {"bigtiff": True}),
        (grey, {"byteorder": ">"}),
        (grey, {"imagej": True}),
        (grey, {"ome": True}),
    ]
    paths = [
        written(partial(tifffile.imwrite, data=pixels, **options), path)  # type: ignore[arg-type]
        for pixels, options in kinds
    ]
    return [
        *paths,
        *(
            image_of(kind)
            for kind in ({"format": "TIFF", "compression": c} for c in ("jpeg", "tiff_lzw"))
        ),
    ]


def image_of(options: dict[str, str]) -> bytes:
    stream = io.BytesIO()
    pixels = np.random.default_rng(1).integers(0, 256, (17, 19)).astype(np.uint8)
    Image.fromarray(pixels).save(stream, **options)
    return stream.getvalue()


def read_rows(path: Path) -> None:
    """Read rows as `restore` does, but only the first ones and none of a very wide image."""
    with open_raster(path) as source:
        raster = source.raster
        if raster.bands * raster.width_px * min(raster.height_px, 64) < 1 << 24:
            source.held_bytes(64)
            for top in range(0, min(raster.height_px, 64), 7):
                raster.missing(source.read(top, min(top + 9, raster.height_px)))


def gdal_seeds(_: Path, name: str) -> list[bytes]:
    return [_with_tiles(name)[name]]


@cache
def _with_tiles(name: str) -> dict[str, bytes]:
    """Return the bytes of an image, or of an index and its tiles, by file name."""
    with TemporaryDirectory() as folder:
        images.FORMATS[name](Path(folder) / name, images.digital_numbers())
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def read_with_tiles(path: Path, name: str) -> None:
    """Read the rows of an image, or of an index next to undamaged tiles."""
    with TemporaryDirectory() as folder:
        for tile, content in _with_tiles(name).items():
            (Path(folder) / tile).write_bytes(content)
        read_rows(Path(shutil.copy(path, Path(folder) / name)))
