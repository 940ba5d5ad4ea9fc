"""Tests of inputs in formats that GDAL reads: their metadata, their tiles and their faults."""

from pathlib import Path
from typing import Any

import pytest
import rasterio
from numpy.testing import assert_allclose
from rasterio.control import GroundControlPoint

from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import BeersError, ImageError
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import refused
from tests.deploy.restoration.runs import names
from tests.model.raster import formats as images


@pytest.mark.parametrize("cog", [False, True])
def test_polynomials_bits_and_gains_of_a_dimap_are_kept(
    cog: bool, model: Path, tmp_path: Path
) -> None:
    image = images.write_dimap(tmp_path / "DIM.XML", images.digital_numbers(10), bits=10)
    with open_raster(image) as source:
        assert source.raster.bits == 10
    restore(image, tmp_path / "out.tif", network=model, cog=cog)
    with rasterio.open(image) as before, rasterio.open(tmp_path / "out.tif") as after:
        after_rpcs = after.rpcs.to_dict()
        before_rpcs = before.rpcs.to_dict()
        # The errors of a DIMAP's polynomials are defined otherwise than those of a GeoTIFF.
        for key in before_rpcs.keys() - {"err_bias", "err_rand"}:
            assert_allclose(after_rpcs[key], before_rpcs[key], rtol=0, atol=1e-9)
        assert [after.tags(band)["RADIANCE_GAIN"] for band in (1, 2)] == ["9.0", "9.1"]
        assert [after.tags(band)["RADIANCE_BIAS"] for band in (1, 2)] == ["0.0", "0.1"]


def test_control_points_names_and_gains_are_kept(model: Path, tmp_path: Path) -> None:
    points = [GroundControlPoint(9 * k * k, 17 * k, k / 3, 45 - k / 7, 0) for k in range(5)]
    place: dict[str, Any] = {"transform": None, "gcps": points, "crs": "EPSG:4326"}
    image = images.write_tiff(tmp_path / "in.tif", **place)
    with rasterio.open(image, "r+") as file:
        file.offsets = (-0.5, -0.25)
    restore(image, tmp_path / "out.tif", network=model)
    with rasterio.open(tmp_path / "out.tif") as after:
        assert after.descriptions == ("B0", "B1")
        assert (after.scales, after.offsets) == ((0.1, 0.2), (-0.5, -0.25))
        after_points, crs = after.gcps
    assert crs == rasterio.CRS.from_epsg(4326)
    after_numbers, before_numbers = (
        [(p.col, p.row, p.x, p.y) for p in each] for each in (after_points, points)
    )
    assert_allclose(after_numbers, before_numbers, rtol=0, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_a_truncated_jpeg_2000_is_an_error_of_one_line(
    share: float, model: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    image = images.write_jp2(tmp_path / "a.jp2")
    content = image.read_bytes()
    image.write_bytes(content[: int(share * len(content)) + 50])
    with pytest.raises(ImageError, match=r"^.*a\.jp2.*whole image.*$"):
        restore(image, tmp_path / "out.tif", network=model, tile=64)
    assert names(tmp_path) == ["a.jp2"]
    assert capfd.readouterr().err == ""


def test_a_tile_of_the_input_cannot_be_an_output(model: Path, tmp_path: Path) -> None:
    image = images.write_dimap(tmp_path / "DIM.XML")
    tile = tmp_path / "IMG_R2C1.TIF"
    out = tmp_path / "out.tif"
    before = tile.read_bytes()
    with pytest.raises(BeersError, match="an input of this run"):
        restore(image, tile, network=model, overwrite=True)
    for words in (out, "--dry-run"):
        assert tile.name in refused(f"restore {image} {words} --json {tile}")
        assert tile.read_bytes() == before
