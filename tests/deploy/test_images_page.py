"""The commands of docs/how-to/images.md, as a reader would run them."""

import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from deploy.cli import app
from tests.deploy.restoration import images

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "images.md"


def test_the_page_s_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rio_cogeo")
    pytest.importorskip("pystac")
    rio: Any = pytest.importorskip("rasterio.rio.main")
    import click.testing

    monkeypatch.chdir(tmp_path)
    pixels = images.digital_numbers(bands=1)
    images.write_jp2(Path("raw.jp2"), pixels, NBITS=12)
    images.write_vrt(Path("mosaic.vrt"), pixels)
    images.write_dimap(Path("DIM_product.XML"), pixels)
    images.write_tiff(Path("bands.tif"), images.digital_numbers())
    blocks = re.findall(r"```console\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line.split() for block in blocks for line in block.splitlines()]
    assert len(lines) == 7
    for program, *words in lines:
        done: Any
        if program == "rio":
            done = click.testing.CliRunner().invoke(rio.main_group, words)
        else:
            assert program == "beers-deploy"
            done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, (words, done.output, done.exception)
        if words[0] == "cogeo":
            assert "is a valid cloud optimized GeoTIFF" in done.output
    assert {"restored.tif", "restored.json", "mosaic-restored.tif", "info.json"} <= {
        path.name for path in tmp_path.iterdir()
    }


def test_the_page_names_limits_as_they_are() -> None:
    from deploy.restoration import cog, index_files
    from deploy.restoration.source import GDAL_DRIVERS

    page = PAGE.read_text(encoding="utf-8")
    assert f"{index_files.INDEX_BYTES >> 20} MiB" in page
    assert f"{index_files.ELEMENTS:,} elements".replace(",", " ") in page
    assert f"more than {index_files.LEVELS} deep" in page
    assert f"tiles of {cog.BLOCK_PX} pixels" in page
    for suffix in GDAL_DRIVERS:
        assert suffix in page or suffix.upper() in page
