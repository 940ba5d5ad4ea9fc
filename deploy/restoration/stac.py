"""The STAC item of a Cloud-Optimised GeoTIFF.

It is of STAC 1.1 (https://stacspec.org) without extensions, so the core schema alone judges it.
"""

import json
import os
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import rasterio
from rasterio.warp import transform

from beers_deploy.model.io.files import write_text
from beers_deploy.model.raster.reader import OFFLINE, gdal

LONGITUDE_LATITUDE = "EPSG:4326"
WHEN = (
    "datetime is the time of the restoration: the image states no time of acquisition that "
    "is known here"
)


def write_item(image: Path, path: Path) -> None:
    """Write the item of a Cloud-Optimised GeoTIFF that this tool has written, as JSON.

    An image without a transform and a coordinate system has no geometry in its item.
    """
    pystac: Any = import_module("pystac")
    with gdal(**OFFLINE), rasterio.open(image, driver="GTiff") as file:
        corners = _corners(file) if file.crs and not file.transform.is_identity else []
        restoration = {
            key.lower(): text for key, text in file.tags().items() if key.startswith("RESTORED_")
        }
        bands = [{"name": name or f"{k}"} for k, name in enumerate(file.descriptions, 1)]
    sides = list(zip(*corners, strict=True))
    item = pystac.Item(
        id=image.stem,
        geometry={"type": "Polygon", "coordinates": [[*corners, corners[0]]]} if corners else None,
        bbox=[*map(min, sides), *map(max, sides)] or None,
        datetime=datetime.now(UTC),
        properties={"description": f"restored by beers-deploy; {WHEN}", **restoration},
    )
    href = Path(os.path.relpath(image, path.parent)).as_posix()
    asset = pystac.Asset(
        href, media_type=pystac.MediaType.COG, roles=["data"], extra_fields={"bands": bands}
    )
    item.add_asset("restored", asset)
    content = item.to_dict(include_self_link=False, transform_hrefs=False)
    write_text(path, json.dumps(content, indent=1) + "\n")


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
