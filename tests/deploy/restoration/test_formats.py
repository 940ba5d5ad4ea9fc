"""Formats that GDAL reads give the same pixels and the same place on Earth as a TIFF."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose

from beers_deploy.model.raster.reader import open_raster
from beers_deploy.model.raster.source import fingerprint
from beers_deploy.profiles.errors import BeersError, ImageError
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import refused
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
        # A DIMAP's model states its errors in other terms than GeoTIFF's tag.
        for key in before_rpcs.keys() - {"err_bias", "err_rand"}:
            assert_allclose(after_rpcs[key], before_rpcs[key], rtol=0, atol=1e-9)
        assert [after.tags(band)["RADIANCE_GAIN"] for band in (1, 2)] == ["9.0", "9.1"]
        assert [after.tags(band)["RADIANCE_BIAS"] for band in (1, 2)] == ["0.0", "0.1"]


def test_control_points_names_and_gains_of_a_vrt_are_kept(model: Path, tmp_path: Path) -> None:
    points = "".join(
        f'<GCP Id="{k}" Pixel="{17 * k}" Line="{9 * k * k}" X="{k / 3!r}" Y="{45 - k / 7!r}" '
        'Z="0"/>'
        for k in range(5)
    )
    more = "<Description>B0</Description><Offset>-0.5</Offset><Scale>0.25</Scale>"
    image = images.write_vrt(tmp_path / "a.vrt", images.digital_numbers(), more)
    text = image.read_text()
    place = text[text.index("<SRS>") : text.index("</GeoTransform>") + len("</GeoTransform>")]
    image.write_text(text.replace(place, f'<GCPList Projection="EPSG:4326">{points}</GCPList>'))
    restore(image, tmp_path / "out.tif", network=model)
    with rasterio.open(image) as before, rasterio.open(tmp_path / "out.tif") as after:
        assert after.descriptions == ("B0", "B0")
        assert (after.scales, after.offsets) == ((0.25, 0.25), (-0.5, -0.5))
        assert before.gcps[1] == after.gcps[1] == rasterio.CRS.from_epsg(4326)
        points_of = [[(p.col, p.row, p.x, p.y) for p in file.gcps[0]] for file in (before, after)]
    assert len(points_of[0]) == 5
    assert_allclose(points_of[1], points_of[0], rtol=0, atol=1e-9)


def test_alpha_in_a_jpeg_2000_and_a_mask_next_to_one_are_missing_pixels(tmp_path: Path) -> None:
    pixels = images.digital_numbers(bands=2)
    hidden = np.zeros((images.HEIGHT, images.WIDTH), bool)
    hidden[30:50, 40:] = True
    pixels[1] = np.where(hidden, 0, 4095)
    alpha = {"NBITS": 12, "PHOTOMETRIC": "MINISBLACK", "ALPHA": "YES"}
    images.write_jp2(tmp_path / "alpha.jp2", pixels, **alpha)
    images.write_jp2(tmp_path / "mask.jp2", pixels[:1], NBITS=12)
    images.write_mask(tmp_path / "mask.jp2", ~hidden)
    for kind in ("alpha", "mask"):
        with open_raster(tmp_path / f"{kind}.jp2") as source:
            rows = source.read(20, 60)
            assert (source.raster.bands, source.raster.mask_kind) == (1, kind)
            np.testing.assert_array_equal(np.ma.getdata(rows)[0], pixels[0, 20:60])
            np.testing.assert_array_equal(source.raster.missing(rows)[0], hidden[20:60])


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.95])
def test_a_truncated_jpeg_2000_is_an_error_of_one_line(
    share: float, model: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    image = images.write_jp2(tmp_path / "a.jp2", images.digital_numbers())
    content = image.read_bytes()
    image.write_bytes(content[: int(share * len(content)) + 50])
    with pytest.raises(ImageError, match=r"^.*a\.jp2.*whole image.*$"):
        restore(image, tmp_path / "out.tif", network=model, tile=64)
    assert [path.name for path in tmp_path.iterdir()] == ["a.jp2"]
    assert capfd.readouterr().err == ""


def test_a_tile_is_no_output(model: Path, tmp_path: Path) -> None:
    image = images.write_dimap(tmp_path / "DIM.XML", images.digital_numbers())
    tile = tmp_path / "IMG_R2C1.TIF"
    out = tmp_path / "out.tif"
    before = tile.read_bytes()
    with pytest.raises(BeersError, match="an input of this run"):
        restore(image, tile, network=model, overwrite=True)
    for words in (out, "--dry-run"):
        assert tile.name in refused(f"restore {image} {words} --json {tile}")
        assert tile.read_bytes() == before


def test_a_changed_tile_makes_another_image(tmp_path: Path) -> None:
    image = images.write_vrt(tmp_path / "a.vrt", images.digital_numbers())
    with open_raster(image) as source:
        before = fingerprint(source.files)
    images.write_jp2(
        tmp_path / "R64C80.jp2", np.zeros((2, images.HEIGHT - 64, images.WIDTH - 80), np.uint16)
    )
    assert fingerprint(source.files) != before
