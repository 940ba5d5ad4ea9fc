"""Cloud-Optimised GeoTIFFs: valid, with the pixels and the place of the plain output, and what was
done.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from beers_deploy.model.io.files import sha256
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.writer import cog_bytes
from beers_deploy.profiles.errors import MachineError
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.run import restore_file
from tests.model.raster import formats as images
from tests.shipped import shipped_pair

cogeo: Any = pytest.importorskip("rio_cogeo")


def both(folder: Path, pixels: np.ndarray, options: Options) -> tuple[Path, Path]:
    """The plain output and the cloud-optimised one of an image."""
    image = images.write_tiff(folder / "in.tif", pixels)
    restore_file(image, folder / "plain.tif", options)
    restore_file(image, folder / "cog.tif", replace(options, cog=True))
    assert sorted(path.name for path in folder.iterdir()) == ["cog.tif", "in.tif", "plain.tif"]
    return folder / "plain.tif", folder / "cog.tif"


@pytest.mark.parametrize("compression", Compression)
def test_it_is_valid_and_holds_the_same(
    compression: Compression, model: Path, tmp_path: Path
) -> None:
    pixels = np.tile(images.digital_numbers(), (1, 4, 5))
    if compression is Compression.none:
        pixels = pixels.astype(np.float32)
    options = Options(model, compression=Compression.zlib)
    plain, cog = both(tmp_path, pixels, options)
    restore_file(tmp_path / "in.tif", cog, replace(options, compression=compression, cog=True))
    valid, errors, warnings = cogeo.cog_validate(cog, strict=True)
    assert (valid, errors, warnings) == (True, [], [])
    with rasterio.open(plain) as before, rasterio.open(cog) as after:
        np.testing.assert_array_equal(after.read(), before.read())
        np.testing.assert_allclose(
            after.transform, images.profile()["transform"], rtol=0, atol=1e-9
        )
        assert after.crs == rasterio.CRS.from_epsg(32631)
        assert (after.descriptions, after.scales) == (("B0", "B1"), (0.1, 0.2))
        assert after.overviews(1) == [2]
        # GDAL 3.10 marks no file of uncompressed planes as a COG.
        if compression is not Compression.none:
            assert after.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        names = {"zlib": "deflate", "zstd": "zstd", "lzw": "lzw", "none": None}
        assert (after.compression and after.compression.value.lower()) == names[compression.value]
        predictor = after.tags(ns="IMAGE_STRUCTURE").get("PREDICTOR")
    assert predictor == (None if compression is Compression.none else "2")


def test_it_says_what_was_done(tmp_path: Path) -> None:
    int8 = shipped_pair("convbeers-xs")[1]
    _, cog = both(tmp_path, images.digital_numbers(), Options(int8, tile_px=64))
    with rasterio.open(cog) as file:
        tags = file.tags()
    assert tags["RESTORED_NETWORK_SHA256"] == sha256(int8)
    assert tags["RESTORED_NETWORK"] == "convbeers-xs"
    assert tags["RESTORED_SENSOR"] == "pleiades-degraded"
    assert tags["RESTORED_FULL_SCALE"] == "4095 (assumed: 12 bits)"
    assert tags["RESTORED_BY"].startswith("beers-deploy ")


def test_missing_pixels_are_kept(model: Path, tmp_path: Path) -> None:
    pixels = np.maximum(images.digital_numbers(), 1)
    pixels[:, 30:60, 20:90] = 0
    image = images.write_tiff(tmp_path / "in.tif", pixels, nodata=0)
    restore_file(image, tmp_path / "out.tif", Options(model, tile_px=64, cog=True))
    with rasterio.open(tmp_path / "out.tif") as file:
        assert file.nodata == 0
        np.testing.assert_array_equal(file.read() == 0, pixels == 0)


def test_a_run_stopped_while_it_is_written_goes_on(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = Options(model, tile_px=64, cog=True)
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    restore_file(image, tmp_path / "expected.tif", options)
    (tmp_path / "out.tif").write_bytes(b"the old one")

    def full(*_: object, **__: object) -> None:
        (tmp_path / ".out.tif.part" / "cog.tif.ovr.tmp").touch()
        raise RuntimeError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr("beers_deploy.model.raster.writer.copy", full)
        with pytest.raises(MachineError, match=r"no space left.*`resume` from row 150 of 150"):
            restore_file(image, tmp_path / "out.tif", options)
    assert (tmp_path / "out.tif").read_bytes() == b"the old one"
    calls: list[str] = []
    monkeypatch.setattr(
        "beers_deploy.restoration.tiles.exposures.restore_window", lambda *_: calls.append("tile")
    )
    restore_file(image, tmp_path / "out.tif", replace(options, resume=True))
    assert calls == []
    assert (tmp_path / "out.tif").read_bytes() == (tmp_path / "expected.tif").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["expected.tif", "in.tif", "out.tif"]


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(height=st.integers(1, 700), width=st.integers(1, 700))
@example(height=600, width=1)
def test_it_is_valid_at_any_size(height: int, width: int, model: Path, tmp_path: Path) -> None:
    images.write_tiff(tmp_path / "in.tif", np.full((1, height, width), 700, np.uint16))
    restore_file(tmp_path / "in.tif", tmp_path / "out.tif", Options(model, tile_px=256, cog=True))
    assert cogeo.cog_validate(tmp_path / "out.tif")[0]


@pytest.mark.parametrize("shape", [(1, 150, 118), (2, 520, 90), (2, 90, 1700), (3, 1100, 700)])
def test_the_disk_is_asked_for_all_that_stands_on_it_at_a_time(
    shape: tuple[int, int, int], model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One byte less is refused before any work; what was asked for is taken, and tags and indexes
    beside it.
    """
    image = images.write_tiff(tmp_path / "in.tif", np.full(shape, 700, np.uint16))
    out = tmp_path / "out.tif"
    options = Options(model, tile_px=256, cog=True, compression=Compression.none)
    free = 0
    tiles = shape[0] * -(-shape[1] // 256) * -(-shape[2] // 256) * 256**2
    needed = 2 * shape[0] * shape[1] * shape[2] + 2 * tiles + cog_bytes(shape, 2)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    free = needed - 1
    with pytest.raises(MachineError, match="of disk"):
        restore_file(image, out, options)
    assert [path.name for path in tmp_path.iterdir()] == ["in.tif"]
    free = needed
    used_bytes = list[int]()
    replace_file = Path.replace

    def counted(self: Path, target: Path) -> Path:
        if target == out:
            used_bytes.append(sum(path.stat().st_size for path in self.parent.iterdir()))
        return replace_file(self, target)

    monkeypatch.setattr(Path, "replace", counted)
    restore_file(image, out, options)
    assert 0.4 * needed < used_bytes[0] < needed + 64_000
