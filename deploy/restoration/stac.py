"""A STAC item beside a restored image: where it lies, what was done, and the file to fetch.

An item of STAC 1.1 (https://stacspec.org) without extensions, so that it is judged by the core schema alone.
"""

import json
import os
import warnings
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from beers_deploy.model.io.files import write_text
from beers_deploy.restoration.gdal_source import ENVIRONMENT, OFFLINE, require_package

LONGITUDE_LATITUDE = "EPSG:4326"
WHEN = "datetime is the time of the restoration: the image states no time of acquisition that is known here"


def require_stac() -> None:
    """Find out before the run that a package is missing."""
    for package in ("rasterio", "pystac"):
        require_package(package, "stac", "a package that writes it")


def write_item(image: Path, path: Path) -> None:
    """Write the item of a Cloud-Optimised GeoTIFF that this tool has written, as JSON.

    An image without a transform and a coordinate system has no geometry in its item.
    """
    pystac: Any = import_module("pystac")
    rasterio: Any = import_module("rasterio")
    with (
        warnings.catch_warnings(action="ignore"),  # an image need not lie anywhere on Earth
        rasterio.Env(**ENVIRONMENT, **OFFLINE),
        rasterio.open(image, driver="GTiff") as file,
    ):
        corners = _corners(file) if file.crs and not file.transform.is_identity else []
        done = {key.lower(): text for key, text in file.tags().items() if key.startswith("RESTORED_")}
        bands = [{"name": name or f"{k}"} for k, name in enumerate(file.descriptions, 1)]
    item = pystac.Item(
        id=image.stem,
        geometry={"type": "Polygon", "coordinates": [[*corners, corners[0]]]} if corners else None,
        bbox=_box(corners) if corners else None,
        datetime=datetime.now(UTC),
        properties={"description": f"restored by beers-deploy; {WHEN}", **done},
    )
    href = Path(os.path.relpath(image, path.parent)).as_posix()
    asset = pystac.Asset(href, media_type=pystac.MediaType.COG, roles=["data"], extra_fields={"bands": bands})
    item.add_asset("restored", asset)
    write_text(path, json.dumps(item.to_dict(include_self_link=False, transform_hrefs=False), indent=1) + "\n")


def _corners(file: Any) -> list[tuple[float, float]]:
    """Longitude and latitude of the four corners of the first and last pixels, in degrees, counter-clockwise."""
    places = [(0, 0), (0, file.height), (file.width, file.height), (file.width, 0)]
    x, y = zip(*(file.transform @ place for place in places), strict=True)
    longitudes, latitudes = import_module("rasterio.warp").transform(file.crs, LONGITUDE_LATITUDE, x, y)
    return list(zip(longitudes, latitudes, strict=True))


def _box(corners: Iterable[tuple[float, float]]) -> list[float]:
    """West, south, east, north."""
    longitudes, latitudes = zip(*corners, strict=True)
    return [min(longitudes), min(latitudes), max(longitudes), max(latitudes)]
