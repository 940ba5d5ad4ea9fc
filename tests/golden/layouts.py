"""Raster layouts, and the result of `restore` for each: pixels and metadata, or the error.

GDAL reads the results. Compressed bytes are not stored, because they change with the writer.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from rasterio.control import GroundControlPoint
from rasterio.rpc import RPC
from typer.testing import CliRunner

from beers_deploy.cli.commands import app

HEIGHT_PX = 48
WIDTH_PX = 70
NODATA = 65535
ORIGIN = Affine(0.5, 0, 600000, 0, -0.5, 4800000)
TILED: dict[str, object] = {"tiled": True, "blockxsize": 32, "blockysize": 16}
CREATION: dict[str, dict[str, object]] = {
    "striped": {"blockysize": 7},
    "tiled": TILED,
    "planar": {"interleave": "band"},
    "lzw": {"compress": "lzw"},
    "zstd": {"compress": "zstd"},
    "deflate, predictor 2": {"compress": "deflate", "predictor": 2},
    "deflate, predictor 3": {"compress": "deflate", "predictor": 3, "dtype": "float32"},
    "jpeg": {"compress": "jpeg", "jpeg_quality": 95, "dtype": "uint8", **TILED},
    "big-endian": {"ENDIANNESS": "BIG"},
    "bigtiff": {"BIGTIFF": "YES", **TILED},
    "12 bits packed": {"NBITS": 12},
    "nodata": {"nodata": NODATA},
    "internal mask": {},
    "alpha": {"ALPHA": "YES"},
    "rpcs and ground control points": {},
    "jpeg 2000": {"driver": "JP2OpenJPEG", "QUALITY": 100, "REVERSIBLE": "YES"},
    "vrt": {},
    "float with nan": {"dtype": "float32"},
}
"""Creation options of GDAL by layout."""


def ground(height_px: int, width_px: int, edge: int) -> np.ndarray:
    """Return digital numbers of texture, an edge, and noise."""
    rows, columns = np.mgrid[:height_px, :width_px] / 20
    even = 900 + 700 * np.sin(5 * rows) * np.cos(3 * columns) + 1400 * (rows + columns > edge)
    return np.asarray(even + 12 * np.random.default_rng(0).standard_normal(even.shape))


def digitised(pixels: np.ndarray) -> np.ndarray:
    """Return digital numbers as uint16 of 12 bits."""
    return np.asarray(np.rint(pixels.clip(0, 4095)).astype(np.uint16))


def bands_of(name: str) -> list[np.ndarray]:
    """Return the planes of a layout: the scene, and the property that the layout tests."""
    image = digitised(ground(HEIGHT_PX, WIDTH_PX, 3))
    if name in ("nodata", "float with nan"):
        image = image.astype(np.float32) if name == "float with nan" else image
        image[20:23, 30:41] = np.nan if name == "float with nan" else NODATA
    if name == "jpeg":
        image = image // 16
    if name == "planar":
        return [image, image[::-1]]
    if name == "alpha":
        opaque = np.full_like(image, NODATA)
        opaque[:5, :9] = 0
        return [image, opaque]
    return [image]


def written(name: str, folder: Path) -> Path:
    """Write a layout's file."""
    bands = bands_of(name)
    options = {"driver": "GTiff", "dtype": "uint16"} | CREATION[name]
    path = folder / f"{name}.{'jp2' if name == 'jpeg 2000' else 'tif'}"
    if "control" in name:
        options |= {"crs": "EPSG:4326", "gcps": corner_points(), "rpcs": coefficients()}
    else:
        options |= {"crs": "EPSG:32631", "transform": ORIGIN}
    with rasterio.open(
        path, "w", height=HEIGHT_PX, width=WIDTH_PX, count=len(bands), **options
    ) as file:
        file.write(np.stack(bands))
        describe(file, name)
    return virtual(path) if name == "vrt" else path


def describe(file: Any, name: str) -> None:
    """Add the metadata that a layout tests to a file that is being written."""
    if name == "internal mask":
        known = np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8)
        known[30:35, 50:58] = 0
        file.write_mask(known)
    if name == "planar":
        file.descriptions = ("forward", "backward")


def corner_points() -> list[GroundControlPoint]:
    """Return the ground control points of the corners."""
    corners = [(0, 0), (0, WIDTH_PX), (HEIGHT_PX, 0), (HEIGHT_PX, WIDTH_PX)]
    return [
        GroundControlPoint(row, column, 2.3 + column / 9e4, 48.8 - row / 9e4, 120.0)
        for row, column in corners
    ]


def coefficients() -> RPC:
    """Return rational polynomials that are linear in longitude and latitude."""
    return RPC(
        err_bias=1.0,
        err_rand=0.5,
        height_off=120.0,
        height_scale=500.0,
        lat_off=48.8,
        lat_scale=0.01,
        long_off=2.3,
        long_scale=0.01,
        line_off=HEIGHT_PX / 2,
        line_scale=HEIGHT_PX / 2,
        samp_off=WIDTH_PX / 2,
        samp_scale=WIDTH_PX / 2,
        line_num_coeff=[0.0, 0.0, -1.0] + [0.0] * 17,
        line_den_coeff=[1.0] + [0.0] * 19,
        samp_num_coeff=[0.0, 1.0] + [0.0] * 18,
        samp_den_coeff=[1.0] + [0.0] * 19,
    )


def virtual(source: Path) -> Path:
    """Write a virtual raster of one file next to it."""
    path = source.with_suffix(".vrt")
    path.write_text(
        f"""<VRTDataset rasterXSize="{WIDTH_PX}" rasterYSize="{HEIGHT_PX}">
<SRS>EPSG:32631</SRS><GeoTransform>{", ".join(map(str, ORIGIN.to_gdal()))}</GeoTransform>
<VRTRasterBand dataType="UInt16" band="1"><SimpleSource>
<SourceFilename relativeToVRT="1">{source.name}</SourceFilename><SourceBand>1</SourceBand>
<SrcRect xOff="0" yOff="0" xSize="{WIDTH_PX}" ySize="{HEIGHT_PX}"/>
<DstRect xOff="0" yOff="0" xSize="{WIDTH_PX}" ySize="{HEIGHT_PX}"/>
</SimpleSource></VRTRasterBand></VRTDataset>""",
        encoding="utf-8",
    )
    return path


def restored(name: str, network: str, folder: Path) -> Mapping[str, object]:
    """Restore a layout by INT8, and return what GDAL reads of the result, or the error.

    Args:
        name: the name of the layout.
        network: the file of an INT8 network.
        folder: the folder for all files.
    """
    image = written(name, folder)
    out = folder / f"{name}, restored.tif"
    top = "255" if name == "jpeg" else "4095"
    words = ["restore", str(image), str(out), "--network", network, "--full-scale", top]
    result = CliRunner().invoke(app, [*words, "--tile", "64", "-q"], catch_exceptions=False)
    if result.exit_code:
        error = result.stderr.replace(str(folder), "FOLDER")
        return {"exit code": result.exit_code, "message": " ".join(error.split())}
    return read_back(out)


def read_back(path: Path) -> dict[str, object]:
    """Return what GDAL reads of a restored file, its pixels by their digest and mean."""
    with rasterio.open(path) as file:
        pixels = file.read()
        mask = file.dataset_mask()
        points, system = file.gcps
        place = str(file.crs or system)
        facts: dict[str, object] = {
            "shape": list(pixels.shape),
            "type": str(pixels.dtype),
            "nodata": None if file.nodata is None else str(file.nodata),
            "colours": [each.name for each in file.colorinterp],
            "descriptions": list(file.descriptions),
            "system": place,
            "transform": list(file.transform)[:6],
            "control points": [[each.row, each.col, each.x, each.y, each.z] for each in points],
            "rpcs": digest(str(sorted(file.rpcs.to_dict().items()))) if file.rpcs else None,
        }
    facts["pixels"] = digest(pixels.tobytes())
    facts["mean"] = round(float(np.nanmean(pixels.astype(np.float64))), 3)
    facts["mask"] = digest(mask.tobytes())
    facts["missing"] = int((mask == 0).sum())
    return facts


def digest(content: bytes | str) -> str:
    """Return the first sixteen digits of the SHA-256."""
    whole = content.encode() if isinstance(content, str) else content
    return hashlib.sha256(whole).hexdigest()[:16]
