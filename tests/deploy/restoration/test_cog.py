"""Tests that Cloud-Optimised GeoTIFFs are valid and equal the plain output."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.writer import cog_bytes
from beers_deploy.profiles.errors import MachineError
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import names, stop_after
from tests.model.raster import formats as images

pytestmark = pytest.mark.usefixtures("unchecked")

cogeo: Any = pytest.importorskip("rio_cogeo")


@pytest.mark.parametrize("compression", get_args(Compression))
def test_a_cog_is_valid_and_equals_the_plain_output(
    compression: Compression, model: Path, tmp_path: Path
) -> None:
    pixels = np.tile(np.maximum(images.digital_numbers(), 1), (1, 4, 5))
    pixels[:, 30:60, 20:90] = 0
    if compression == "none":
        pixels = pixels.astype(np.float32)
    image = images.write_tiff(tmp_path / "in.tif", pixels, nodata=0)
    plain, cog = (tmp_path / name for name in ("plain.tif", "cog.tif"))
    restore(image, plain, network=model)
    restore(image, cog, network=model, compression=compression, cog=True)
    assert names(tmp_path) == ["cog.tif", "in.tif", "plain.tif"]
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
        codecs = {"zlib": "deflate", "zstd": "zstd", "lzw": "lzw", "none": None}
        assert (after.compression and after.compression.value.lower()) == codecs[compression]
        predictor = after.tags(ns="IMAGE_STRUCTURE").get("PREDICTOR")
    assert predictor == (None if compression == "none" else "2")


def test_a_run_that_stops_while_it_writes_can_be_resumed(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = partial(restore, network=model, tile=64, cog=True)
    image = images.write_tiff(tmp_path / "in.tif")
    run(image, tmp_path / "expected.tif")
    out = tmp_path / "out.tif"
    out.write_bytes(b"the old one")

    def full(*_: object, **__: object) -> None:
        (tmp_path / ".out.tif.part" / "cog.tif.ovr.tmp").touch()
        raise RuntimeError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr("beers_deploy.model.raster.writer.copy", full)
        with pytest.raises(MachineError, match=r"no space left.*`resume` from row 150 of 150"):
            run(image, out, overwrite=True)
    assert out.read_bytes() == b"the old one"
    stop_after(0, monkeypatch, AssertionError("restored what was finished"))
    run(image, out, resume=True)
    assert out.read_bytes() == (tmp_path / "expected.tif").read_bytes()
    assert names(tmp_path) == ["expected.tif", "in.tif", "out.tif"]


@pytest.mark.parametrize("shape", [(1, 150, 118), (1, 600, 1), (2, 520, 90), (2, 90, 1700)])
def test_the_space_for_all_files_on_the_disk_is_checked_before_the_run(
    shape: tuple[int, int, int], model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One byte less is refused before any work. The space that is asked for is used, apart from
    tags and indexes.
    """
    image = images.write_tiff(tmp_path / "in.tif", np.full(shape, 700, np.uint16))
    out = tmp_path / "out.tif"
    run = partial(restore, network=model, tile=256, cog=True, compression="none")
    free = 0
    tiles = shape[0] * -(-shape[1] // 256) * -(-shape[2] // 256) * 256**2
    needed = 2 * shape[0] * shape[1] * shape[2] + 2 * tiles + cog_bytes(shape, 2)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    free = needed - 1
    with pytest.raises(MachineError, match="of disk"):
        run(image, out)
    assert names(tmp_path) == ["in.tif"]
    free = needed
    used_bytes = list[int]()
    replace_file = Path.replace

    def counted(self: Path, target: Path) -> Path:
        if target == out:
            used_bytes.append(sum(path.stat().st_size for path in self.parent.iterdir()))
        return replace_file(self, target)

    monkeypatch.setattr(Path, "replace", counted)
    run(image, out)
    assert 0.4 * needed < used_bytes[0] < needed + 64_000
    assert cogeo.cog_validate(out)[0]
