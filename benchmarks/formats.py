"""One image as TIFF, JPEG 2000, VRT of four tiles and COG: what restoring each takes beside the
plain TIFF.

    python benchmarks/formats.py [--size 13600x9016] [--model convbeers-xs-int8] [--repeats 1]

Each run is a process of its own with one thread; times are of the processor, so that they hold on a
busy machine. Decoding is timed apart, as reading every row by the plan's strips. The digests show
that the pixels are the same.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import tifffile
from rasterio.shutil import copy
from rasterio.transform import from_origin
from rasterio.windows import Window

from beers_deploy.model.raster.reader import open_raster
from beers_deploy.performance.swath import parse_size

BLOCK_PX = 1024
STRIP_PX = 640
TIFF = "TIFF"
COUNTED = """
import resource, sys
from beers_deploy.cli.commands import app
try:
    app()
finally:
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(used.ru_utime + used.ru_stime, file=sys.stderr)
"""


def scene(width: int, height: int) -> np.ndarray:
    """(height, width) uint16 of 12 bits: a smooth picture with the noise of a sensor."""
    generator = np.random.default_rng(0)
    down = np.arange(height)[:, None] / 97
    across = np.arange(width)[None] / 131
    smooth = 1500 + 900 * np.sin(down) * np.cos(across)
    return np.clip(smooth + generator.normal(0, 20, (height, width)), 0, 4095).astype(np.uint16)


def write(path: Path, pixels: np.ndarray, driver: str, **options: Any) -> Path:
    """One band with a place on Earth."""
    height, width = pixels.shape
    about = {"count": 1, "dtype": "uint16", "width": width, "height": height, "crs": "EPSG:32631"}
    with rasterio.open(
        path, "w", driver=driver, transform=from_origin(3e5, 4.8e6, 0.7, 0.7), **about, **options
    ) as f:
        f.write(pixels, 1)
    return path


def write_tiff(path: Path, pixels: np.ndarray) -> Path:
    """In tiles, deflated."""
    return write(
        path,
        pixels,
        "GTiff",
        tiled=True,
        blockxsize=256,
        blockysize=256,
        compress="deflate",
        predictor=2,
    )


def write_jp2(path: Path, pixels: np.ndarray) -> Path:
    """Lossless, in tiles."""
    lossless = {
        "QUALITY": "100",
        "REVERSIBLE": "YES",
        "BLOCKXSIZE": BLOCK_PX,
        "BLOCKYSIZE": BLOCK_PX,
        "NBITS": 12,
    }
    return write(path, pixels, "JP2OpenJPEG", **lossless)


def write_vrt(path: Path, pixels: np.ndarray) -> Path:
    """Four tiles of TIFF."""
    height, width = pixels.shape
    rows, columns = ((0, side // 2, side) for side in (height, width))
    corners = product(pairwise(rows), pairwise(columns))
    parts = [Window.from_slices(y, x) for y, x in corners]
    sources = ""
    for k, part in enumerate(parts):
        write_tiff(path.with_name(f"{k}.tif"), pixels[part.toslices()])
        size = f'xSize="{part.width}" ySize="{part.height}"'
        sources += (
            "<SimpleSource><SourceFilename "
            f'relativeToVRT="1">{k}.tif</SourceFilename><SourceBand>1</SourceBand>'
            f'<SrcRect xOff="0" yOff="0" {size}/><DstRect xOff="{part.col_off}" '
            f'yOff="{part.row_off}" {size}/>'
            "</SimpleSource>"
        )
    band = f'<VRTRasterBand dataType="UInt16" band="1">{sources}</VRTRasterBand>'
    path.write_text(f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">{band}</VRTDataset>')
    return path


def write_cog(path: Path, pixels: np.ndarray) -> Path:
    """With overviews."""
    plain = write_tiff(path.with_name("plain.tif"), pixels)
    copy(plain, path, driver="COG", COMPRESS="DEFLATE", PREDICTOR="YES", OVERVIEWS="AUTO")
    return path


FORMATS: dict[str, tuple[str, Callable[[Path, np.ndarray], Path]]] = {
    TIFF: ("a.tif", write_tiff),
    "JPEG 2000": ("a.jp2", write_jp2),
    "VRT of 4 TIFFs": ("a.vrt", write_vrt),
    "COG": ("cog.tif", write_cog),
}


def restored(image: Path, model: str, *more: str) -> tuple[float, float, str]:
    """Processor time in s, peak memory in GB, and a digest of the pixels."""
    out = image.with_name("out.tif")
    figures = image.with_name("out.json")
    words = [
        "restore",
        str(image),
        str(out),
        "--network",
        model,
        "--threads",
        "1",
        "--json",
        str(figures),
        *more,
    ]
    process = subprocess.run(  # noqa: S603
        [sys.executable, "-c", COUNTED, *words], capture_output=True, text=True, check=True
    )
    row = json.loads(figures.read_text())["rows"][0]["figures"]
    digest = hashlib.sha256(tifffile.imread(out).tobytes()).hexdigest()[:12]
    out.unlink()
    return float(process.stderr.split()[-1]), float(row["peak memory"]["value"]), digest


def decoding_s(image: Path) -> float:
    """Processor time of reading every row once, threads that decode included."""
    with open_raster(image) as source:
        height_px = source.raster.height_px
        started = time.process_time()
        for top in range(0, height_px, STRIP_PX):
            source.read(top, min(top + STRIP_PX, height_px))
        return time.process_time() - started


def main() -> None:
    """Print a line a format."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", default="13600x9016")
    parser.add_argument("--model", default="convbeers-xs-int8")
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    # The tiles have no georeference, about which rasterio warns.
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as name:
        pixels = scene(*parse_size(arguments.size))
        first = 0.0
        for label, (file, make) in FORMATS.items():
            image = make(Path(name) / file, pixels)
            runs = [restored(image, arguments.model) for _ in range(arguments.repeats)]
            time_s, memory_gb, digest = min(runs)
            decoding = min(decoding_s(image) for _ in range(arguments.repeats))
            first = first or time_s
            speed = f"{first / time_s:.3f} of the TIFF's speed"
            print(
                f"{label}: {time_s:.1f} s, {speed}; decoding {decoding:.1f} s; {memory_gb:.2f} "
                f"GB; {digest}",
                flush=True,
            )
        time_s, memory_gb, digest = restored(Path(name) / "a.tif", arguments.model, "--cog")
        print(
            f"TIFF to COG: {time_s:.1f} s, {first / time_s:.3f} of the speed to TIFF; "
            f"{memory_gb:.2f} GB; {digest}"
        )


if __name__ == "__main__":
    main()
