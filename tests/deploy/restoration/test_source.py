"""Bands of rows are the rows of the whole image, whatever the file, each segment decoded once."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from beers_deploy.profiles.errors import BeersError, ImageError, MachineError
from beers_deploy.restoration.source import PageRows, open_source

STORAGES: dict[str, dict[str, Any]] = {
    "one strip": {},
    "one packed strip": {"compression": "zlib", "rowsperstrip": 1000},
    "strips": {"rowsperstrip": 7},
    "packed strips": {"rowsperstrip": 7, "compression": "zlib", "predictor": False},
    "tiles": {"tile": (16, 32)},
    "packed tiles": {"tile": (16, 32), "compression": "zlib"},
    "big tiff": {"tile": (32, 16), "compression": "zlib", "bigtiff": True},
    "big endian": {"byteorder": ">"},
    "big endian tiles": {"tile": (16, 16), "byteorder": ">", "compression": "zlib"},
}
CODECS: dict[str, dict[str, Any]] = {
    "lzw": {"tile": (16, 16), "compression": "lzw", "predictor": True},
    "zstd": {"rowsperstrip": 9, "compression": "zstd"},
}
HEIGHT = 61
WIDTH = 83


def pixels_of(dtype: str, *bands: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 250, (*bands, HEIGHT, WIDTH)).astype(dtype)


def assert_rows_equal(path: Path, expected: np.ndarray) -> None:
    bands = expected.reshape(-1, HEIGHT, WIDTH)
    with open_source(path) as source:
        assert source.raster.shape == bands.shape
        for start, stop in ((0, 5), (3, 20), (12, 20), (19, 61), (60, 61), (0, 61), (30, 44)):
            rows = source.read(start, stop)
            assert rows.dtype == expected.dtype
            np.testing.assert_array_equal(rows, bands[:, start:stop])


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("storage", STORAGES)
def test_every_storage_gives_its_rows(storage: str, dtype: str, tmp_path: Path) -> None:
    pixels = pixels_of(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, **STORAGES[storage])
    assert_rows_equal(tmp_path / "a.tif", pixels)


@pytest.mark.parametrize("codec", CODECS)
def test_compressions_of_imagecodecs_are_read(codec: str, tmp_path: Path) -> None:
    pytest.importorskip("imagecodecs")
    tifffile.imwrite(tmp_path / "a.tif", pixels_of("uint16"), **CODECS[codec])
    assert_rows_equal(tmp_path / "a.tif", pixels_of("uint16"))


@pytest.mark.parametrize("storage", STORAGES)
def test_bands_in_planes_or_interleaved(storage: str, tmp_path: Path) -> None:
    pixels = pixels_of("uint16", 3)
    options = {"photometric": "rgb", **STORAGES[storage]}
    tifffile.imwrite(tmp_path / "planes.tif", pixels, planarconfig="separate", **options)
    tifffile.imwrite(
        tmp_path / "mixed.tif", np.moveaxis(pixels, 0, 2), planarconfig="contig", **options
    )
    for name in ("planes", "mixed"):
        assert_rows_equal(tmp_path / f"{name}.tif", pixels)


def test_pages_and_other_formats_are_read_whole(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "pages.tif", pixels_of("uint16", 3), photometric="minisblack")
    assert_rows_equal(tmp_path / "pages.tif", pixels_of("uint16", 3))
    Image.fromarray(pixels_of("uint16")).save(tmp_path / "a.png")
    assert_rows_equal(tmp_path / "a.png", pixels_of("uint16"))


@settings(max_examples=30)
@given(st.lists(st.integers(1, 25), min_size=1, max_size=12), st.integers(0, 12))
def test_reading_downwards_decodes_each_segment_once(
    tmp_path_factory: pytest.TempPathFactory, heights: list[int], overlap: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "once.tif"
    tifffile.imwrite(path, pixels_of("uint16"), tile=(16, 16), compression="zlib")
    decoded: list[int] = []

    class Counting(PageRows):
        def _decode(self, row: int) -> np.ndarray:
            decoded.append(row)
            return super()._decode(row)

    with tifffile.TiffFile(path) as file:
        source = Counting(path, file.pages.first)
        top = 0
        for height in heights:
            bottom = min(top + height, HEIGHT)
            rows = source.read(max(top - overlap, 0), bottom)
            np.testing.assert_array_equal(
                rows[0], pixels_of("uint16")[max(top - overlap, 0) : bottom]
            )
            top = bottom
            if top == HEIGHT:
                break
    assert len(decoded) == len(set(decoded)) == -(-top // 16)


def test_tiles_never_written_hold_the_nodata_value(tmp_path: Path) -> None:
    tile = np.full((16, 16), 9, np.uint16)
    nodata = [(42113, "s", 0, "7", True)]
    shape: dict[str, Any] = {"shape": (16, 48), "dtype": "uint16", "tile": (16, 16)}
    tifffile.imwrite(
        tmp_path / "a.tif", iter([tile, None, tile]), extratags=nodata, compression="zlib", **shape
    )
    with open_source(tmp_path / "a.tif") as source:
        rows = source.read(0, 16)
        assert source.raster.missing(rows).sum() == 256
    assert set(np.unique(rows)) == {7, 9}


def refused(path: Path, error: type[BeersError], word: str) -> None:
    with pytest.raises(error, match=word), open_source(path) as source:
        source.read(0, source.raster.height_px)


def test_damage_is_one_sentence(tmp_path: Path) -> None:
    intact = tmp_path / "whole.tif"
    tifffile.imwrite(intact, pixels_of("uint16"), tile=(16, 16), compression="zlib")
    content = intact.read_bytes()
    (tmp_path / "short.tif").write_bytes(content[: len(content) * 2 // 3])
    refused(tmp_path / "short.tif", ImageError, "cut short|readable")
    with tifffile.TiffFile(intact) as file:
        offset = file.pages.first.dataoffsets[9]
    (tmp_path / "tile.tif").write_bytes(content[:offset] + b"\xff" * 40 + content[offset + 40 :])
    refused(tmp_path / "tile.tif", ImageError, "rows 0 to 60")
    tifffile.imwrite(tmp_path / "complex.tif", np.ones((9, 9), np.complex64))
    refused(tmp_path / "complex.tif", ImageError, "complex64")


def test_a_nodata_value_that_the_output_cannot_hold_is_refused(tmp_path: Path) -> None:
    nodata = [(42113, "s", 0, "-9999", True)]
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((9, 9), np.int16), extratags=nodata)
    refused(tmp_path / "a.tif", ImageError, "-9999")


def test_a_missing_codec_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tifffile.imwrite(tmp_path / "a.tif", pixels_of("uint16"), tile=(16, 16), compression="zlib")

    def without(*_: object) -> None:
        raise ValueError("<COMPRESSION.LZW: 5> requires the 'imagecodecs' package")

    monkeypatch.setattr(PageRows, "_decode", without)
    refused(tmp_path / "a.tif", MachineError, "codecs")
