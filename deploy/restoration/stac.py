"""STAC items of a run: of its Cloud-Optimised GeoTIFF, with its place and how it was made, and of
its networks.

The items are of STAC 1.1 (https://stacspec.org) with the extensions processing 1.2, of which pystac
has no class, file 2.1 and machine-learning-model 1.4. The item of an image links to those of its
networks, which lie next to it, so that the image can be traced to a network by its digest. A
shipped network is made for the sensor of each run and has no file, so it is written as ONNX.
"""

import json
import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from fractions import Fraction
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import rasterio
from rasterio.warp import transform

from beers_deploy.model.io.files import write_text
from beers_deploy.model.raster.reader import OFFLINE, gdal
from beers_deploy.network import Network
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.run import Run

LONGITUDE_LATITUDE = "EPSG:4326"
WHEN = (
    "datetime is the time of the restoration: the image states no time of acquisition that "
    "is known here"
)
PROCESSING = "https://stac-extensions.github.io/processing/v1.2.0/schema.json"
LEVEL = "L4"
"""The processing level that the machine-learning-model extension asks for: output of a model."""

LINEAGE = (
    "consistency",
    "exposures",
    "detectors replaced",
    "self-check outside",
    "self-check not decidable",
)
"""The facts of a run that the lineage reports if the run has them."""

MAPS = {
    "self-check": "Agreement of the restored with the raw image, block by block",
    "interval": "Interval of each restored pixel",
}
"""Titles of the rasters that may be written with an image."""

NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_.\-\s]+[a-zA-Z0-9]")
"""The names of a model that the extension accepts."""

SHA256 = "1220"
"""Multihash prefix of a SHA-256 of 32 bytes, as the file extension writes checksums."""

AXES = ["batch", "channel", "height", "width"]
ANY = -1
"""A free side of an array."""


def write_item(run: Run, path: Path, maps: Mapping[str, Path]) -> None:
    """Write the STAC item of a Cloud-Optimised GeoTIFF that this tool has written, as JSON.

    The item describes the image's place on Earth and how it was made. An image without a transform
    and a coordinate system has no geometry in its item.

    Args:
        run: the run that wrote the image.
        path: the path of the item; the items of the run's networks are written next to it.
        maps: the paths of further rasters over the same place, such as the half-widths, by name.
            They become assets of the item.
    """
    pystac: Any = import_module("pystac")
    now = datetime.now(UTC)
    (row,) = run.rows
    figures = {
        name: f"{figure} {figure.unit}"
        for name, figure in row.figures.items()
        if figure.value is not None
    }
    facts = {**row.text, **figures}
    steps = [f"{name}: {facts[name]}" for name in LINEAGE if name in facts]
    # The runtime is stated with its version; the traditional pipeline has none.
    runtime, _, release = row.text.get("runtime", "").partition(" ")
    software = {"beers-deploy": version("beers-deploy"), **({runtime: release} if runtime else {})}
    with gdal(**OFFLINE), rasterio.open(run.path, driver="GTiff") as file:
        corners = _corners(file) if file.crs and not file.transform.is_identity else []
        restoration = {
            key.lower(): text for key, text in file.tags().items() if key.startswith("RESTORED_")
        }
        bands = [{"name": name or f"{k}"} for k, name in enumerate(file.descriptions, 1)]
    sides = list(zip(*corners, strict=True))
    item = pystac.Item(
        id=run.path.stem,
        geometry={"type": "Polygon", "coordinates": [[*corners, corners[0]]]} if corners else None,
        bbox=[*map(min, sides), *map(max, sides)] or None,
        datetime=now,
        properties={
            "description": f"restored by beers-deploy; {WHEN}",
            "processing:datetime": pystac.utils.datetime_to_str(now),
            "processing:lineage": "; ".join([f"Restored from {row.name}", *steps]),
            "processing:software": software,
            **restoration,
        },
        stac_extensions=[PROCESSING],
    )
    asset = pystac.Asset(
        _href(run.path, path),
        media_type=pystac.MediaType.COG,
        roles=["data"],
        extra_fields={"bands": bands},
    )
    item.add_asset("restored", asset)
    for name, raster in maps.items():
        title = MAPS.get(name, name)
        kind = pystac.MediaType.GEOTIFF
        quality = pystac.Asset(_href(raster, path), title, media_type=kind, roles=["metadata"])
        item.add_asset(name, quality)
    _add_networks(item, asset, run, path)
    _write(item, path)


def _add_networks(item: Any, asset: Any, run: Run, path: Path) -> None:
    """Write the items of a run's networks, and refer to them as the extension of machine-learning
    models recommends for products of a model.
    """
    pystac: Any = import_module("pystac")
    networks = list(dict.fromkeys(run.networks))
    paths = network_paths(path, len(networks))
    for network, place in zip(networks, paths, strict=True):
        write_network_item(network, place, item.datetime)
        link = pystac.Link("derived_from", _href(place, path), pystac.MediaType.GEOJSON)
        link.extra_fields = {"processing:level": LEVEL}
        item.add_link(link)
    if networks:
        made_by = [_href(place, path) for place in paths]
        asset.extra_fields |= {
            "processing:level": LEVEL,
            "processing:expression": {
                "format": "stac-mlm",
                "expression": made_by if len(made_by) > 1 else made_by[0],
            },
        }


def _write(item: Any, path: Path) -> None:
    content = item.to_dict(include_self_link=False, transform_hrefs=False)
    write_text(path, json.dumps(content, indent=1) + "\n")


def _href(file: Path, item: Path) -> str:
    """Return the address of a file, relative to the folder of an item, as the URI that STAC asks
    for.
    """
    return quote(Path(os.path.relpath(file, item.parent)).as_posix(), errors="surrogateescape")


def _corners(file: Any) -> list[tuple[float, float]]:
    """Return longitude and latitude, in degrees, of the four corners of an open image,
    counter-clockwise from the upper left one.
    """
    rows = [0, file.height, file.height, 0]
    columns = [0, 0, file.width, file.width]
    x, y = file.xy(rows, columns, offset="ul")
    longitudes, latitudes = transform(file.crs, LONGITUDE_LATITUDE, x, y)
    return list(zip(longitudes, latitudes, strict=True))


def network_paths(item: Path, count: int) -> list[Path]:
    """Return the paths at which the STAC items of a run's networks are written.

    The ONNX file of a network that has no file yet is written there too, with the suffix .onnx.

    Args:
        item: the path of the item of the restored image.
        count: the number of networks.
    """
    ends = [""] if count == 1 else [f"-{number}" for number in range(1, count + 1)]
    return [item.with_name(f"{item.stem}-network{end}.json") for end in ends]


def write_network_item(network: Network, path: Path, when: datetime) -> None:
    """Write the STAC item that describes a network, and its ONNX file if it has none.

    Args:
        network: a network of a run.
        path: the path of the item. A network that is only in memory is saved next to it.
        when: the time of the run, because STAC has no item without a time.
    """
    pystac: Any = import_module("pystac")
    files: Any = import_module("pystac.extensions.file")
    mlm: Any = import_module("pystac.extensions.mlm")
    # If the digest of the network's file is not known, the file is written here and digested.
    file = network.path if network.file_sha256 else None
    file = file or network.save(path.with_suffix(".onnx"))
    item = pystac.Item(
        id=f"{network.name}-{network.sha256[:12]}",
        geometry=None,
        bbox=None,
        datetime=when,
        properties={"description": "a network that restores images; datetime is the time of a run"},
    )
    tiling = network.geometry
    tasks = [mlm.TaskType.REGRESSION]
    if tiling.scale > 1:
        tasks.append(mlm.TaskType.SUPER_RESOLUTION)
    reads = _array(tiling.channels_in, tiling.fixed_px, Fraction(1))
    gives = _array(tiling.channels_out, tiling.fixed_px, tiling.scale)
    scale = "pixel values over the value that is full scale"
    variant = metadata(network.model).get("variant", "")
    mlm.MLMExtension.ext(item, add_if_missing=True).apply(
        name=network.name if NAME.fullmatch(network.name) else "network",
        architecture="ConvBEERS" if variant.startswith("convbeers") else "unknown",
        tasks=tasks,
        input=[mlm.ModelInput.create("image", [], mlm.InputStructure.create(**reads), scale)],
        output=[
            mlm.ModelOutput.create("restored", tasks, mlm.ResultStructure.create(**gives), scale)
        ],
        framework="ONNX",
        hyperparameters=mlm.Hyperparameters.create(
            precision=network.precision, sensor=network.sensor or "not stated"
        ),
    )
    # pystac writes null, which would mean that the network was trained from scratch.
    del item.properties["mlm:pretrained_source"]
    asset = pystac.Asset(
        _href(file, path),
        media_type="application/octet-stream",
        roles=["mlm:model", "mlm:weights", "data"],
    )
    item.add_asset("model", asset)
    kind = file.suffix.removeprefix(".").lower()
    mlm.AssetGeneralMLMExtension.ext(asset).apply(artifact_type=kind)
    checks = files.FileExtension.ext(asset, add_if_missing=True)
    checks.apply(checksum=f"{SHA256}{network.sha256}", size=file.stat().st_size)
    _write(item, path)


def _array(channels: int, side_px: int | None, scale: Fraction) -> dict[str, Any]:
    """Return shape, axes and type of images of a network; a free side is ANY."""
    side = ANY if side_px is None else int(side_px * scale)
    return {"shape": [ANY, channels, side, side], "dim_order": AXES, "data_type": "float32"}
