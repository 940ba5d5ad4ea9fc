"""The STAC item of a Cloud-Optimised GeoTIFF: its place, and how it was made.

It is of STAC 1.1 (https://stacspec.org) with the extensions processing 1.2, of which pystac has no
class, and file 2.1. A network is an item of its own, which the item links to (`network`): the
fields of the machine-learning-model extension make an item that of a model.
"""

import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import rasterio
from rasterio.warp import transform

from beers_deploy.model.io.files import write_text
from beers_deploy.model.raster.reader import OFFLINE, gdal
from beers_deploy.profiles.figures import Row
from beers_deploy.restoration.run import Run
from beers_deploy.restoration.stac.network import network_paths, write_network_item

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
"""What the lineage reports of a run, where it has it."""

MAPS = {
    "self-check": "Agreement of the restored with the raw image, block by block",
    "interval": "Interval of each restored pixel",
}
"""Titles of the rasters that may be written with an image."""


def write_item(run: Run, path: Path, maps: Mapping[str, Path]) -> None:
    """Write the item of a Cloud-Optimised GeoTIFF that this tool has written, as JSON.

    An image without a transform and a coordinate system has no geometry in its item.

    Args:
        run: that wrote the image.
        path: of the item; the items of its networks are written next to it.
        maps: further rasters over the same place, by name: they become assets.
    """
    pystac: Any = import_module("pystac")
    now = datetime.now(UTC)
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
            "processing:lineage": lineage(run.rows[0]),
            "processing:software": _software(run.rows[0]),
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
        quality = pystac.Asset(_href(raster, path), title, None, pystac.MediaType.GEOTIFF)
        quality.roles = ["metadata"]
        item.add_asset(name, quality)
    _add_networks(item, asset, run, path)
    content = item.to_dict(include_self_link=False, transform_hrefs=False)
    write_text(path, json.dumps(content, indent=1) + "\n")


def lineage(row: Row) -> str:
    """Return a sentence on what was done to one image, by the row of its run."""
    figures = {name: f"{figure} {figure.unit}" for name, figure in row.figures.items()}
    facts = {**row.text, **figures}
    steps = [f"{name}: {facts[name]}" for name in LINEAGE if name in facts]
    return "; ".join([f"Restored from {row.name}", *steps])


def _software(row: Row) -> dict[str, str]:
    """Return the versions of this tool and of the runtime that ran the network."""
    own = {"beers-deploy": version("beers-deploy")}
    name, _, release = row.text.get("runtime", "").partition(" ")
    return {**own, name: release} if release else own


def _add_networks(item: Any, asset: Any, run: Run, path: Path) -> None:
    """Write the items of a run's networks, and refer to them as the extension of machine-learning
    models recommends for what a model has made.
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
            "processing:expression": {"format": "stac-mlm", "expression": _alone(made_by)},
        }


def _alone(items: Sequence[str]) -> str | Sequence[str]:
    """Return the only one of several, or all."""
    return items[0] if len(items) == 1 else items


def _href(file: Path, item: Path) -> str:
    """Return the address of a file, relative to the folder of an item."""
    return Path(os.path.relpath(file, item.parent)).as_posix()


def _corners(file: Any) -> list[tuple[float, float]]:
    """Longitude and latitude of the four corners of the first and last pixels, in degrees,
    counter-clockwise.
    """
    places = [(0, 0), (0, file.height), (file.width, file.height), (file.width, 0)]
    a, b, c, d, e, f = file.transform[:6]
    x = [a * column + b * row + c for column, row in places]
    y = [d * column + e * row + f for column, row in places]
    longitudes, latitudes = transform(file.crs, LONGITUDE_LATITUDE, x, y)
    return list(zip(longitudes, latitudes, strict=True))
