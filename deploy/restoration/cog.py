"""A finished TIFF as a Cloud-Optimised GeoTIFF, with tiles, overviews and a head that says where
they lie.

GDAL's driver COG writes it, of the package rasterio
(https://gdal.org/en/stable/drivers/raster/cog.html). What was done to the image goes into its
metadata, beside what the image said of itself. The item is of STAC 1.1 (https://stacspec.org)
without extensions, so that it is judged by the core schema alone.
"""

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import onnx

from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.errors import CODE_FAULTS
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.gdal_source import ENVIRONMENT, LEAST_CACHE_BYTES, OFFLINE
from beers_deploy.restoration.options import Compression
from beers_deploy.restoration.output import padded_px
from beers_deploy.restoration.radiometry import FullScale
from beers_deploy.restoration.source import RESTORED_BY

CODECS = {
    Compression.none: "NONE",
    Compression.zlib: "DEFLATE",
    Compression.zstd: "ZSTD",
    Compression.lzw: "LZW",
}
BLOCK_PX = 512

LONGITUDE_LATITUDE = "EPSG:4326"
WHEN = (
    "datetime is the time of the restoration: the image states no time of acquisition that "
    "is known here"
)


def what_was_done(
    networks: Sequence[onnx.ModelProto], digests: str, scale: FullScale
) -> dict[str, str]:
    """The run as an image's metadata: tool, networks in the order of the bands, their sensors and
    full scale.
    """
    networks_metadata = [metadata(network) for network in networks]
    return {
        RESTORED_BY: f"beers-deploy {version('beers-deploy')}",
        "RESTORED_NETWORK_SHA256": digests,
        "RESTORED_NETWORK": ", ".join(
            entry.get("variant", "not stated") for entry in networks_metadata
        ),
        "RESTORED_SENSOR": ", ".join(
            entry.get("sensor", "not stated") for entry in networks_metadata
        ),
        "RESTORED_FULL_SCALE": scale.words,
    }


def disk_bytes(shape: tuple[int, int, int], itemsize: int) -> int:
    """Disk that writing a COG of an image (bands, height, width) takes, as if nothing could be
    packed.

    The driver halves the image until it is one block, and writes these overviews into a file of
    their own first.
    """
    bands, height, width = shape
    full = padded_px(shape, BLOCK_PX)
    overviews = 0
    while max(height, width) > BLOCK_PX:
        height = -(-height // 2)
        width = -(-width // 2)
        overviews += padded_px((bands, height, width), BLOCK_PX)
    return (full + 2 * overviews) * itemsize


def write_cog(plain: Path, cog: Path, compression: Compression, about: Mapping[str, str]) -> None:
    """Write the TIFF `plain` as the Cloud-Optimised GeoTIFF `cog`, with `about`
    among its metadata.
    """
    rasterio: Any = import_module("rasterio")
    options: dict[str, Any] = {
        "COMPRESS": CODECS[compression],
        # The horizontal predictor of integers.
        "PREDICTOR": "NO" if compression is Compression.none else "YES",
        "BLOCKSIZE": BLOCK_PX,
        "BIGTIFF": "IF_SAFER",
        # An average of known pixels does not overshoot them.
        "RESAMPLING": "AVERAGE",
    }
    environment = {**ENVIRONMENT, **OFFLINE, "GDAL_CACHEMAX": LEAST_CACHE_BYTES}
    try:
        with warnings.catch_warnings(action="ignore"), rasterio.Env(**environment):
            with rasterio.open(plain, "r+", driver="GTiff") as file:
                file.update_tags(**about)
                # Readers compute from its width by how much an overview is reduced.
                if file.width == 1:
                    options["OVERVIEWS"] = "NONE"
            import_module("rasterio.shutil").copy(plain, cog, driver="COG", **options)
    except CODE_FAULTS:
        raise
    # rasterio has a class of its own for each of GDAL's errors.
    except Exception as error:
        raise OSError(" ".join(str(error.__cause__ or error).split())) from error


def write_item(image: Path, path: Path) -> None:
    """Write the item of a Cloud-Optimised GeoTIFF that this tool has written, as JSON.

    An image without a transform and a coordinate system has no geometry in its item.
    """
    pystac: Any = import_module("pystac")
    rasterio: Any = import_module("rasterio")
    with (
        # An image need not lie anywhere on Earth.
        warnings.catch_warnings(action="ignore"),
        rasterio.Env(**ENVIRONMENT, **OFFLINE),
        rasterio.open(image, driver="GTiff") as file,
    ):
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
    x, y = zip(*(file.transform @ place for place in places), strict=True)
    longitudes, latitudes = import_module("rasterio.warp").transform(
        file.crs, LONGITUDE_LATITUDE, x, y
    )
    return list(zip(longitudes, latitudes, strict=True))
