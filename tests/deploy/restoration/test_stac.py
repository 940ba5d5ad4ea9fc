"""STAC items are valid by the core schema, and have the place of the image and what was done."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import rasterio

from tests.deploy.command_line import done, refused
from tests.model.raster import formats as images

pystac: Any = pytest.importorskip("pystac")


def restored_item(image: Path, item: Path, model: Path) -> dict[str, Any]:
    out = image.with_name("out.tif")
    done(f"restore {image} {out} --network {model} --cog --stac {item}")
    content: dict[str, Any] = json.loads(item.read_text())
    return content


def test_an_item_is_valid_and_has_the_place_of_the_image(model: Path, tmp_path: Path) -> None:
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    content = restored_item(image, tmp_path / "catalogue" / "item.json", model)
    pystac.Item.from_dict(content).validate()
    assert content["assets"]["restored"]["href"] == "../out.tif"
    assert "cloud-optimized" in content["assets"]["restored"]["type"]
    assert [band["name"] for band in content["assets"]["restored"]["bands"]] == ["B0", "B1"]
    assert content["properties"]["restored_full_scale"] == "4095 (assumed: 12 bits)"
    with rasterio.open(image) as file:
        from rasterio.warp import transform_bounds

        expected = transform_bounds(file.crs, "EPSG:4326", *file.bounds)
    assert content["bbox"] == pytest.approx(list(expected), abs=1e-8)


def test_an_image_without_a_place_has_no_geometry(model: Path, tmp_path: Path) -> None:
    image = images.write_tiff(
        tmp_path / "in.tif", images.digital_numbers(), crs=None, transform=None
    )
    content = restored_item(image, tmp_path / "item.json", model)
    pystac.Item.from_dict(content).validate()
    assert content["geometry"] is None
    assert "bbox" not in content


def test_an_item_needs_a_cog_and_its_package(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = images.write_tiff(tmp_path / "in.tif", images.digital_numbers())
    command = f"restore {image} {tmp_path}/out.tif --stac {tmp_path}/i.json --network {model}"
    monkeypatch.setitem(sys.modules, "pystac", None)
    assert "--stac has no effect without --cog" in refused(command)
    assert "beers-deploy[stac]" in refused(f"{command} --cog")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.tif"]
