"""A run killed on an image that GDAL reads, or while its COG is written, is resumed to the same
bytes.
"""

import time
from pathlib import Path

import pytest

from beers_deploy.model.io.lock import part_folder
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import begin
from tests.model.raster import formats as images

pytestmark = pytest.mark.slow

TILE_PX = 16


@pytest.mark.parametrize("name", ["a.jp2", "a.vrt", "DIM.XML"])
def test_killed_among_its_rows_and_at_its_cog_it_is_resumed_to_the_same_bytes(
    name: str, model: Path, tmp_path: Path
) -> None:
    image = images.FORMATS[name](tmp_path / name, images.digital_numbers())
    expected = tmp_path / "expected.tif"
    out = tmp_path / "out.tif"
    restore(image, expected, network=model, tile=TILE_PX, threads=1, cog=True)
    before = {path.name for path in tmp_path.iterdir()}
    out.write_bytes(b"old")
    killed = []
    # The journal is there when some rows are finished, the TIFF when all rows are.
    for sign in ("journal.json", "out.tif"):
        running = begin(image, out, "--network", model, "--tile", TILE_PX, "--cog", "--resume")
        while running.poll() is None and not (part_folder(out) / sign).exists():
            time.sleep(0.001)
        running.kill()
        output, _ = running.communicate()
        killed.append(running.returncode != 0)
        assert running.returncode <= 0, output
        assert out.read_bytes() in (b"old", expected.read_bytes())
    assert killed[0]
    last = begin(image, out, "--network", model, "--tile", TILE_PX, "--cog", "--resume")
    output, _ = last.communicate(timeout=120)
    assert last.returncode == 0, output
    assert out.read_bytes() == expected.read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == before | {"out.tif"}
