"""Tests of reading rows in each format, of sidecars, and of damaged files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from numpy.testing import assert_array_equal
from PIL import Image

from beers_deploy.model.raster.reader import LEAST_CACHE_BYTES, open_raster
from beers_deploy.model.raster.writer import write_array
from beers_deploy.profiles.errors import BeersError, ImageError
from tests.model.raster import formats

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
CODECS = ("lzw", "zstd", "deflate", "packbits", "lerc", "lerc_zstd", "lzma")
HEIGHT = 61
WIDTH = 83


def pixels_of(dtype: str, *bands: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 250, (*bands, HEIGHT, WIDTH)).astype(dtype)


def assert_rows_equal(path: Path, expected: np.ndarray) -> None:
    bands = expected.reshape(-1, HEIGHT, WIDTH)
    with open_raster(path) as source:
        assert source.raster.shape == bands.shape
        for start, stop in ((0, 5), (3, 20), (12, 20), (19, 61), (60, 61), (0, 61), (30, 44)):
            rows = source.read(start, stop)
            assert rows.dtype == expected.dtype
            assert_array_equal(rows, bands[:, start:stop])


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("storage", STORAGES)
def test_every_storage_gives_its_rows(storage: str, dtype: str, tmp_path: Path) -> None:
    pixels = pixels_of(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, **STORAGES[storage])
    assert_rows_equal(tmp_path / "a.tif", pixels)


@pytest.mark.parametrize("codec", CODECS)
def test_every_lossless_compression_is_read(codec: str, tmp_path: Path) -> None:
    pixels = pixels_of("uint16", 2)
    formats.write_tiff(tmp_path / "a.tif", pixels, compress=codec)
    assert_rows_equal(tmp_path / "a.tif", pixels)


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


def test_pictures_are_read_by_rows(tmp_path: Path) -> None:
    Image.fromarray(pixels_of("uint16")).save(tmp_path / "a.png")
    assert_rows_equal(tmp_path / "a.png", pixels_of("uint16"))
    deep = pixels_of("uint16", 3) * 250
    formats.write(tmp_path / "deep.png", deep, "PNG", crs=None, transform=None)
    assert_rows_equal(tmp_path / "deep.png", deep)


def test_one_page_of_several_has_to_be_named(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "pages.tif", pixels_of("uint16", 3), photometric="minisblack")
    refused(tmp_path / "pages.tif", ImageError, "one image, got 3.*GTIFF_DIR:1:")


def test_tiles_never_written_have_the_nodata_value(tmp_path: Path) -> None:
    tile = np.full((16, 16), 9, np.uint16)
    nodata = [(42113, "s", 0, "7", True)]
    shape: dict[str, Any] = {"shape": (16, 48), "dtype": "uint16", "tile": (16, 16)}
    tifffile.imwrite(
        tmp_path / "a.tif", iter([tile, None, tile]), extratags=nodata, compression="zlib", **shape
    )
    with open_raster(tmp_path / "a.tif") as source:
        rows = source.read(0, 16)
        assert source.raster.missing(rows).sum() == 256
    assert set(np.unique(rows)) == {7, 9}


def refused(path: Path, error: type[BeersError], word: str) -> None:
    with pytest.raises(error, match=word), open_raster(path) as source:
        source.read(0, source.raster.height_px)


def test_damage_gets_one_sentence(tmp_path: Path) -> None:
    intact = tmp_path / "whole.tif"
    tifffile.imwrite(intact, pixels_of("uint16"), tile=(16, 16), compression="zlib")
    content = intact.read_bytes()
    (tmp_path / "short.tif").write_bytes(content[: len(content) * 2 // 3])
    refused(tmp_path / "short.tif", ImageError, "cut short")
    with tifffile.TiffFile(intact) as file:
        offset = file.pages.first.dataoffsets[9]
    (tmp_path / "tile.tif").write_bytes(content[:offset] + b"\xff" * 40 + content[offset + 40 :])
    refused(tmp_path / "tile.tif", ImageError, "rows 0 to 60")
    tifffile.imwrite(tmp_path / "complex.tif", np.ones((9, 9), np.complex64))
    refused(tmp_path / "complex.tif", ImageError, "complex64")


def test_statistics_of_the_raw_pixels_are_not_kept(tmp_path: Path) -> None:
    with rasterio.open(formats.write_tiff(tmp_path / "a.tif"), "r+") as file:
        file.update_tags(1, STATISTICS_MEAN="7", GAIN="2")
        file.update_tags(MISSION="a")
    with open_raster(tmp_path / "a.tif") as source:
        raster = source.raster
    assert (raster.tags, raster.band_info[0].tags) == ((("MISSION", "a"),), (("GAIN", "2"),))
    assert raster.band_names == ("B0", "B1")


def test_items_that_rasterio_cannot_write_are_not_kept(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", pixels_of("uint16"))
    items = "".join(f'<MDI key="{key}">1</MDI>' for key in ("bidx", "ns", "OWN"))
    domains = "".join(f'<Metadata domain="{domain}">{items}</Metadata>' for domain in ("", "RPC"))
    (tmp_path / "a.tif.aux.xml").write_text(f"<PAMDataset>{domains}</PAMDataset>")
    with open_raster(tmp_path / "a.tif") as source:
        raster = source.raster
    assert raster.tags == raster.georeference.rpcs == (("OWN", "1"),)
    write_array(tmp_path / "b.tif", raster, pixels_of("uint16")[None])
    with open_raster(tmp_path / "b.tif") as source:
        assert source.raster.tags == raster.tags


def test_sidecars_place_an_image(tmp_path: Path) -> None:
    """The sidecars are GDAL's, a world file, and the polynomials next to a satellite tile."""
    pixels = pixels_of("uint16")
    for name in ("world", "gdal"):
        tifffile.imwrite(tmp_path / f"{name}.tif", pixels)
    (tmp_path / "world.tfw").write_text("0.5\n0\n0\n-0.5\n300000.25\n4799999.75\n")
    (tmp_path / "gdal.tif.aux.xml").write_text(
        "<PAMDataset><SRS>EPSG:32631</SRS>"
        "<GeoTransform>300000, 0.5, 0, 4800000, 0, -0.5</GeoTransform></PAMDataset>"
    )
    for name, sidecar in (("world", "world.tfw"), ("gdal", "gdal.tif.aux.xml")):
        with open_raster(tmp_path / f"{name}.tif") as source:
            assert source.raster.georeference.transform[:6] == (0.5, 0, 300000, 0, -0.5, 4800000)
            assert tmp_path / sidecar in source.files
    tifffile.imwrite(tmp_path / "IMG_a_R1C1.TIF", pixels)
    formats.write_dimap(tmp_path / "DIM.XML")
    (tmp_path / "RPC.XML").rename(tmp_path / "RPC_a.XML")
    (tmp_path / "DIM.XML").rename(tmp_path / "DIM_a.XML")
    with open_raster(tmp_path / "IMG_a_R1C1.TIF") as source:
        assert dict(source.raster.georeference.rpcs)["LINE_OFF"].startswith("9.33")


@pytest.mark.parametrize("name", ["a.img", "b.bsq"])
def test_envi_is_known_by_its_header(name: str, tmp_path: Path) -> None:
    pixels = formats.digital_numbers()
    formats.write(tmp_path / name, pixels, "ENVI")
    with open_raster(tmp_path / name) as source:
        assert_array_equal(source.read(3, 9), pixels[:, 3:9])


def test_the_header_of_another_file_makes_no_envi_of_an_erdas_image(tmp_path: Path) -> None:
    pixels = formats.digital_numbers()
    formats.write(tmp_path / "a.bsq", pixels + 1, "ENVI")
    formats.write(tmp_path / "a.img", pixels, "HFA")
    with open_raster(tmp_path / "a.img") as source:
        assert_array_equal(source.read(3, 9), pixels[:, 3:9])


def test_a_name_without_a_known_suffix_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.dat2", pixels_of("uint16"))
    refused(tmp_path / "a.dat2", ImageError, r"suffix of \.tif.*got \.dat2")


def test_a_sidecar_that_leads_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    tifffile.imwrite(folder / "a.tif", pixels_of("uint16"))
    (tmp_path / "world").write_text("1\n0\n0\n-1\n0\n0\n")
    try:
        (folder / "a.tfw").symlink_to(tmp_path / "world")
    except OSError:
        pytest.skip("this account cannot make links")
    refused(folder / "a.tif", ImageError, r"outside its own folder: .*a\.tfw\.")


@pytest.mark.parametrize("name", formats.FORMATS)
def test_every_format_gives_its_rows(name: str, tmp_path: Path) -> None:
    pixels = formats.digital_numbers()
    with open_raster(formats.FORMATS[name](tmp_path / name, pixels)) as source:
        assert source.raster.shape == pixels.shape
        for start, stop in ((0, 7), (5, 70), (60, formats.HEIGHT), (0, formats.HEIGHT)):
            assert_array_equal(source.read(start, stop), pixels[:, start:stop])


def test_the_cache_is_counted_with_the_blocks_of_a_mosaic_s_tiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels = formats.digital_numbers()
    jp2 = formats.write_jp2(tmp_path / "a.jp2", pixels)
    formats.write(tmp_path / "strip.tif", pixels, "GTiff", blockysize=140)
    size = f'rasterXSize="{formats.WIDTH}" rasterYSize="{formats.HEIGHT}"'
    bands = "".join(
        f'<VRTRasterBand dataType="UInt16" band="{band}">'
        f"{formats.source('strip.tif', band, 0, 0, formats.HEIGHT, formats.WIDTH)}</VRTRasterBand>"
        for band in (1, 2)
    )
    (tmp_path / "a.vrt").write_text(f"<VRTDataset {size}>{bands}</VRTDataset>")
    for image, block_px in ((jp2, formats.TILE_PX), (tmp_path / "a.vrt", 140)):
        with open_raster(image) as source:
            assert source.held_bytes(1) == LEAST_CACHE_BYTES
            with monkeypatch.context() as patch:
                patch.setattr("beers_deploy.model.raster.reader.LEAST_CACHE_BYTES", 1)
                row_bytes = formats.BANDS * formats.WIDTH * 2
                assert source.held_bytes(1) == 2 * block_px * row_bytes
