"""Cloud-Optimised GeoTIFFs are valid, and have the pixels and the place of the plain output."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.io.files import sha256
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.writer import cog_bytes
from beers_deploy.profiles.errors import MachineError
from beers_deploy.verbs.restore import restore
from tests.model.raster import formats as images
from tests.shipped import shipped_pair

cogeo: Any = pytest.importorskip("rio_cogeo")


def both(folder: Path, pixels: np.ndarray, network: Path, **options: Any) -> tuple[Path, Path]:
    """Return the plain output and the cloud-optimised one of an image."""
    image = images.write_tiff(folder / "in.tif", pixels, nodata=0)
    restore(image, folder / "plain.tif", network=network, **options)
    restore(image, folder / "cog.tif", network=network, cog=True, **options)
    assert sorted(path.name for path in folder.iterdir()) == ["cog.tif", "in.tif", "plain.tif"]
    return folder / "plain.tif", folder / "cog.tif"


@pytest.mark.parametrize("compression", get_args(Compression))
def test_it_is_valid_and_holds_the_same(
    compression: Compression, model: Path, tmp_path: Path
) -> None:
    pixels = np.tile(np.maximum(images.digital_numbers(), 1), (1, 4, 5))
    pixels[:, 30:60, 20:90] = 0
    if compression == "none":
        pixels = pixels.astype(np.float32)
    plain, cog = both(tmp_path, pixels, model)
    options: dict[str, Any] = {"compression": compression, "cog": True, "overwrite": True}
    restore(tmp_path / "in.tif", cog, network=model, **options)
    valid, errors, warnings = cogeo.cog_validate(cog, strict=True)
    assert (valid, errors, warnings) == (True, [], [])
    with rasterio.open(plain) as before, rasterio.open(cog) as after:
        assert_array_equal(after.read(), before.read())
        assert after.nodata == 0
        assert_array_equal(after.read() == 0, pixels == 0)
        assert_allclose(after.transform, images.profile()["transform"], rtol=0, atol=1e-9)
        assert after.crs == rasterio.CRS.from_epsg(32631)
        assert (after.descriptions, after.scales) == (("B0", "B1"), (0.1, 0.2))
        assert after.overviews(1) == [2]
        # GDAL 3.10 marks no file of uncompressed planes as a COG.
        if compression != "none":
            assert after.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        names = {"zlib": "deflate", "zstd": "zstd", "lzw": "lzw", "none": None}
        assert (after.compression and after.compression.value.lower()) == names[compression]
        predictor = after.tags(ns="IMAGE_STRUCTURE").get("PREDICTOR")
    assert predictor == (None if compression == "none" else "2")


def test_it_records_what_was_done(tmp_path: Path) -> None:
    int8 = shipped_pair("convbeers-xs")[1]
    _, cog = both(tmp_path, images.digital_numbers(), int8, tile=64)
    with rasterio.open(cog) as file:
        tags = file.tags()
    assert tags["RESTORED_NETWORK_SHA256"] == sha256(int8)
    assert tags["RESTORED_NETWORK"] == "convbeers-xs"
    assert tags["RESTORED_SENSOR"] == "pleiades-degraded"
    assert tags["RESTORED_FULL_SCALE"] == "4095 (assumed: 12 bits)"
    assert tags["RESTORED_BY"].startswith("beers-deploy ")


def test_a_run_stopped_while_it_is_written_goes_on(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: dict[str, Any] = {"network": model, "tile": 64, "cog": True}
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    restore(image, tmp_path / "expected.tif", **options)
    (tmp_path / "out.tif").write_bytes(b"the old one")

    def full(*_: object, **__: object) -> None:
        (tmp_path / ".out.tif.part" / "cog.tif.ovr.tmp").touch()
        raise RuntimeError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr("beers_deploy.model.raster.writer.copy", full)
        with pytest.raises(MachineError, match=r"no space left.*`resume` from row 150 of 150"):
            restore(image, tmp_path / "out.tif", overwrite=True, **options)
    assert (tmp_path / "out.tif").read_bytes() == b"the old one"
    calls: list[str] = []
    monkeypatch.setattr(
        "beers_deploy.restoration.tiles.exposures.restore_window", lambda *_: calls.append("tile")
    )
    restore(image, tmp_path / "out.tif", resume=True, **options)
    assert calls == []
    assert (tmp_path / "out.tif").read_bytes() == (tmp_path / "expected.tif").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["expected.tif", "in.tif", "out.tif"]


@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(height=st.integers(1, 700), width=st.integers(1, 700))
@example(height=600, width=1)
def test_it_is_valid_at_any_size(height: int, width: int, model: Path, tmp_path: Path) -> None:
    images.write_tiff(tmp_path / "in.tif", np.full((1, height, width), 700, np.uint16))
    options: dict[str, Any] = {"tile": 256, "cog": True, "overwrite": True}
    restore(tmp_path / "in.tif", tmp_path / "out.tif", network=model, **options)
    assert cogeo.cog_validate(tmp_path / "out.tif")[0]


@pytest.mark.parametrize("shape", [(1, 150, 118), (2, 520, 90), (2, 90, 1700)])
def test_all_that_is_on_the_disk_at_a_time_is_checked_before_the_run(
    shape: tuple[int, int, int], model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One byte less is refused before any work. The space that is asked for is used, apart from
    tags and indexes.
    """
    image = images.write_tiff(tmp_path / "in.tif", np.full(shape, 700, np.uint16))
    out = tmp_path / "out.tif"
    options: dict[str, Any] = {"network": model, "tile": 256, "cog": True, "compression": "none"}
    free = 0
    tiles = shape[0] * -(-shape[1] // 256) * -(-shape[2] // 256) * 256**2
    needed = 2 * shape[0] * shape[1] * shape[2] + 2 * tiles + cog_bytes(shape, 2)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    free = needed - 1
    with pytest.raises(MachineError, match="of disk"):
        restore(image, out, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["in.tif"]
    free = needed
    used_bytes = list[int]()
    replace_file = Path.replace

    def counted(self: Path, target: Path) -> Path:
        if target == out:
            used_bytes.append(sum(path.stat().st_size for path in self.parent.iterdir()))
        return replace_file(self, target)

    monkeypatch.setattr(Path, "replace", counted)
    restore(image, out, **options)
    assert 0.4 * needed < used_bytes[0] < needed + 64_000
