"""Tests of headers that would make a decoder fill memory, open other files or run programs."""

import struct
import subprocess
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_array_equal
from PIL import Image

from beers_deploy.model.raster.images import read_pixels
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import BeersError, ImageError, MachineError

GREY = np.random.default_rng(0).integers(0, 250, (16, 16)).astype(np.uint8)


def tiff(path: Path, data: bytes, **changed: int) -> Path:
    """Write a TIFF of one strip of 16 x 16 bytes, with the named entries changed or added."""
    names = {"width": 256, "height": 257, "bits": 258, "compression": 259, "samples": 277}
    names |= {"rows": 278, "size": 279, "tile_width": 322, "tile_height": 323}
    entries = {256: 16, 257: 16, 258: 8, 259: 1, 262: 1, 273: 0, 277: 1, 278: 16, 279: len(data)}
    entries |= {names[name]: value for name, value in changed.items()}
    place = 273
    if 322 in entries:  # Tiles have other tags for offsets and lengths, 324 and 325.
        place = 324
        entries[325] = entries.pop(279)
        del entries[273], entries[278]
        entries[place] = 0
    # The pixels follow the header of 8 bytes, the count of 2, and the directory of 12 bytes an
    # entry, which ends with 4 bytes.
    entries[place] = 8 + 2 + 12 * len(entries) + 4
    listed = b"".join(
        struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(entries.items())
    )
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + listed + bytes(4) + data)
    return path


@contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def refused(path: Path, error: type[BeersError], word: str) -> None:
    """Check that both readers refuse the file without filling memory."""
    with little_memory():
        for reader in (read_pixels, rows):
            with pytest.raises(error, match=word):
                reader(path)


def rows(path: Path) -> np.ndarray:
    with open_raster(path) as source:
        return source.read(0, source.raster.height_px)


@pytest.mark.parametrize("compression", [50002, 34925, 34887, 50001])
def test_pixels_that_no_codec_unpacks_are_refused(compression: int, tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.tif", GREY.tobytes(), compression=compression)
    refused(path, ImageError, "a readable TIFF")


def test_a_codec_that_gdal_lacks_is_named(tmp_path: Path) -> None:
    """34712 is JPEG 2000 inside a TIFF, which libtiff does not have."""
    path = tiff(tmp_path / "a.tif", GREY.tobytes(), compression=34712)
    refused(path, ImageError, "missing codec JP2000.*deflate, LZW or ZSTD")


def test_a_tile_that_no_memory_holds_is_refused(tmp_path: Path) -> None:
    data = zlib.compress(GREY.tobytes())
    honest = tiff(tmp_path / "a.tif", data, compression=8, tile_width=16, tile_height=16)
    assert_array_equal(read_pixels(honest), GREY)
    absurd = tiff(tmp_path / "b.tif", data, compression=8, tile_width=1 << 30, tile_height=1 << 30)
    refused(absurd, MachineError, "strips or tiles")


def test_an_image_too_long_to_be_planned_is_refused(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.tif", GREY.tobytes(), height=2**32 - 1, rows=16)
    with pytest.raises(BeersError):
        rows(path)
    path = tiff(tmp_path / "b.tif", GREY.tobytes(), height=2**23, width=1, rows=2**23, size=256)
    with pytest.raises(ImageError, match="pixels a side"):
        rows(path)


@pytest.mark.parametrize("side", [2_000_000, 2**31 - 1])
def test_a_gigantic_png_header_allocates_nothing(side: int, tmp_path: Path) -> None:
    """The header of the small file states another size."""
    path = tmp_path / "huge.png"
    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    Image.fromarray(GREY).save(path)
    content = bytearray(path.read_bytes())
    # The IHDR chunk has its own checksum, so that only the size is absurd.
    content[16:33] = header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    path.write_bytes(content)
    with little_memory(), pytest.raises(BeersError, match=r"readable|free memory"):
        read_pixels(path)


@pytest.mark.parametrize("side", [2_000_000, 2**31, 2**32 - 1])
def test_a_gigantic_tiff_header_allocates_nothing(side: int, tmp_path: Path) -> None:
    """For the last two sides the number of pixels only just fits 63 bits, or does not."""
    path = tiff(tmp_path / "huge.tif", bytes(4), width=side, height=side, rows=side, bits=16)
    with little_memory(), pytest.raises(BeersError, match=r"readable|free memory"):
        read_pixels(path)


def test_other_files_that_a_microscopes_tiff_names_are_not_opened(tmp_path: Path) -> None:
    """OME-XML states the file of each plane, which can be any path such as `../secret.tif`."""
    tifffile.imwrite(tmp_path / "secret.tif", np.full((16, 16), 77, np.uint8), ome=True)
    folder = tmp_path / "in"
    folder.mkdir()
    with tifffile.TiffFile(tmp_path / "secret.tif") as file:
        identity = file.ome_metadata.split('UUID="')[1].split('"')[0]  # type: ignore[union-attr]
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
        'UUID="urn:uuid:1">'
        '<Image><Pixels DimensionOrder="XYZCT" Type="uint8" SizeX="16" SizeY="16" SizeZ="1" '
        'SizeC="1" SizeT="1">'
        '<TiffData IFD="0" PlaneCount="1"><UUID '
        f'FileName="../secret.tif">{identity}</UUID></TiffData>'
        "</Pixels></Image></OME>"
    )
    tifffile.imwrite(folder / "a.tif", GREY, description=xml, metadata=None)
    assert_array_equal(read_pixels(folder / "a.tif"), GREY)
    assert_array_equal(rows(folder / "a.tif")[0], GREY)


def test_a_file_that_is_no_png_or_jpeg_starts_no_other_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow passes EPS to Ghostscript, whatever the suffix of the file."""

    def started(*_: object, **__: object) -> None:
        raise AssertionError("a program was started")

    for name in ("Popen", "check_call", "run"):
        monkeypatch.setattr(subprocess, name, started)
    path = tmp_path / "a.png"
    path.write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n%%EOF\n"
    )
    with pytest.raises(ImageError, match=r"a\.png"):
        read_pixels(path)
