"""Tests that STAC items are valid, and state the place, the processing and the network's digest."""

import json
import re
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import rasterio

from tests.deploy.command_line import done, refused
from tests.deploy.restoration.runs import names
from tests.model.raster import formats as images

pytestmark = pytest.mark.usefixtures("unchecked")

pystac: Any = pytest.importorskip("pystac")
validation: Any = pytest.importorskip("pystac.validation")
mlm: Any = pytest.importorskip("pystac.extensions.mlm")

PROCESSING = {
    "type": "object",
    "properties": {
        "processing:datetime": {"type": "string", "pattern": r"^\d{4}-\d\d-\d\dT.*Z$"},
        "processing:expression": {"type": "object", "required": ["format", "expression"]},
        "processing:level": {"enum": ["RAW", "L0", "L1", "L2", "L3", "L4"]},
        "processing:lineage": {"type": "string"},
        "processing:software": {
            "type": "object",
            "additionalProperties": {"type": "string"},
        },
    },
    "patternProperties": {"^(?!processing:)": {}},
    "additionalProperties": False,
}
"""The fields of the processing extension 1.2.0 that are used, as its README defines them."""


def require_valid(content: dict[str, Any]) -> None:
    """Check an item by the schemas that pystac brings, and by the fields of processing.

    The schemas of the extensions are not used, because they must be fetched.
    """
    validation.validate_dict(content, extensions=[])
    for fields in (content["properties"], *content["assets"].values(), *content["links"]):
        jsonschema.validate(fields, PROCESSING)


def restored_item(image: Path, item: Path, options: str) -> dict[str, Any]:
    """Restore an image into out.tif next to it, and return its item, which is valid."""
    done(f"restore {image} {image.with_name('out.tif')} {options} --cog --stac {item}")
    content: dict[str, Any] = json.loads(item.read_text())
    require_valid(content)
    return content


def test_an_item_is_valid_and_has_the_place_of_the_image(model: Path, tmp_path: Path) -> None:
    image = images.write_tiff(tmp_path / "in.tif")
    content = restored_item(image, tmp_path / "catalogue" / "item.json", f"--network {model}")
    assert content["assets"]["restored"]["href"] == "../out.tif"
    assert "cloud-optimized" in content["assets"]["restored"]["type"]
    assert [band["name"] for band in content["assets"]["restored"]["bands"]] == ["B0", "B1"]
    assert content["properties"]["restored_full_scale"] == "4095 (assumed: 12 bits)"
    with rasterio.open(image) as file:
        from rasterio.warp import transform_bounds

        expected = transform_bounds(file.crs, "EPSG:4326", *file.bounds)
    assert content["bbox"] == pytest.approx(list(expected), abs=1e-8)


def test_addresses_are_uris(model: Path, tmp_path: Path) -> None:
    image = images.write_tiff(tmp_path / "in.tif")
    own = tmp_path / "50% é.onnx"
    own.write_bytes(model.read_bytes())
    item = tmp_path / "a #1.json"
    done("restore", image, tmp_path / "a #1?.tif", "--network", own, "--cog", "--stac", item)
    content = json.loads(item.read_text())
    assert content["assets"]["restored"]["href"] == "a%20%231%3F.tif"
    assert [link["href"] for link in content["links"]] == ["a%20%231-network.json"]
    network = json.loads((tmp_path / "a #1-network.json").read_text())
    assert network["assets"]["model"]["href"] == "50%25%20%C3%A9.onnx"


def test_an_image_without_a_place_has_no_geometry(model: Path, tmp_path: Path) -> None:
    image = images.write_tiff(tmp_path / "in.tif", crs=None, transform=None)
    content = restored_item(image, tmp_path / "item.json", f"--network {model}")
    assert content["geometry"] is None
    assert "bbox" not in content


def test_an_item_needs_its_package(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = images.write_tiff(tmp_path / "in.tif")
    command = f"restore {image} {tmp_path}/out.tif --network {model} --cog --stac"
    monkeypatch.setitem(sys.modules, "pystac", None)
    assert "beers-deploy[stac]" in refused(command, tmp_path / "i.json")
    assert names(tmp_path) == ["in.tif"]


def test_an_item_states_how_the_image_was_restored(tmp_path: Path) -> None:
    """A shipped network is built for the sensor, so it is written. The item has its digest."""
    image = images.write_tiff(tmp_path / "in.tif")
    options = "--network convbeers-xs-int8 --sensor pleiades-degraded --self-check"
    content = restored_item(image, tmp_path / "out.json", f"{options} {tmp_path}/blocks.tif")
    about = content["properties"]
    assert about["processing:datetime"] == about["datetime"]
    assert set(about["processing:software"]) == {"beers-deploy", "onnxruntime"}
    assert "Restored from in.tif; consistency: on" in about["processing:lineage"]
    # The image is noise, which no sensor sees.
    assert "self-check outside: 100 %" in about["processing:lineage"]
    assert content["assets"]["self-check"]["href"] == "blocks.tif"
    expression = content["assets"]["restored"]["processing:expression"]
    assert expression == {
        "format": "stac-mlm",
        "expression": "out-network.json",
    }
    assert [link["href"] for link in content["links"]] == ["out-network.json"]
    network = network_item(tmp_path / "out-network.json")
    asset = network.assets["model"]
    digest = sha256((tmp_path / asset.href).read_bytes()).hexdigest()
    assert asset.extra_fields["file:checksum"] == f"1220{digest}"
    # These are the tags of the image, too.
    assert about["restored_network_sha256"] == digest
    assert about["restored_network"] == "convbeers-xs"
    assert about["restored_sensor"] == "pleiades-degraded"
    assert about["restored_by"].startswith("beers-deploy ")
    model = mlm.MLMExtension.ext(network)
    assert model.architecture == "ConvBEERS"
    assert model.hyperparameters.to_dict() == {"precision": "int8", "sensor": "pleiades-degraded"}


def network_item(path: Path) -> Any:
    """Return the item of a network, valid by the core schema and with all that its extension asks
    for.
    """
    content = json.loads(path.read_text())
    validation.validate_dict(content, extensions=[])
    # These are the other rules of the extension's schema. pystac itself refuses an item that lacks
    # a required field.
    assert any("mlm:model" in asset["roles"] for asset in content["assets"].values())
    assert "mlm:pretrained_source" not in content["properties"]
    item = pystac.Item.from_dict(content)
    model = mlm.MLMExtension.ext(item)
    assert re.fullmatch(r"[a-zA-Z][a-zA-Z0-9_.\-\s]+[a-zA-Z0-9]", model.mlm_name)
    assert model.tasks
    (image,) = model.input
    (restored,) = model.output
    assert len(image.input.shape) == len(image.input.dim_order) == len(restored.result.shape)
    return item


def test_a_network_with_a_file_is_linked_where_it_is(model: Path, tmp_path: Path) -> None:
    """The extension does not accept the name 1, so that the item has a general name."""
    own = tmp_path / "networks" / "1.onnx"
    own.parent.mkdir()
    own.write_bytes(model.read_bytes())
    image = images.write_tiff(tmp_path / "in.tif")
    restored_item(image, tmp_path / "items" / "a.json", f"--network {own}")
    network = network_item(tmp_path / "items" / "a-network.json")
    assert network.assets["model"].href == "../networks/1.onnx"
    assert mlm.MLMExtension.ext(network).mlm_name == "network"
    assert names(tmp_path / "items") == ["a-network.json", "a.json"]


def test_each_sensor_has_a_network_and_the_traditional_pipeline_has_none(tmp_path: Path) -> None:
    pixels = images.digital_numbers()
    image = images.write_tiff(tmp_path / "in.tif", pixels)
    sensors = "--network convbeers-xs --sensor B0=pleiades-degraded,B1=blind"
    older = tmp_path / "a-network-2.json"
    older.touch()
    command = f"restore {image} {tmp_path}/out.tif {sensors} --cog --stac {tmp_path}/a.json"
    assert f"{older} exists already" in refused(command)
    older.unlink()
    content = restored_item(image, tmp_path / "a.json", sensors)
    names = ["a-network-1.json", "a-network-2.json"]
    assert content["assets"]["restored"]["processing:expression"]["expression"] == names
    items = [network_item(tmp_path / name) for name in names]
    stated = [mlm.MLMExtension.ext(item).hyperparameters.to_dict()["sensor"] for item in items]
    assert stated == ["pleiades-degraded", "blind"]

    small = images.write_tiff(tmp_path / "small.tif", np.ascontiguousarray(pixels[:, :24, :24]))
    how = "--method traditional --quality fast --sensor pleiades-degraded --overwrite"
    content = restored_item(small, tmp_path / "b.json", how)
    assert content["links"] == []
    assert "processing:level" not in content["assets"]["restored"]
