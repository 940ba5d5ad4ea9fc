"""Runs of `restore` in a process of their own, runs that are stopped, and an image to restore."""

import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile

import beers_deploy as bd
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.profiles.figures import Row
from beers_deploy.restoration.tiles.engine import Restorer, Tile
from beers_deploy.verbs.restore import restore


def noise(*shape: int, seed: int = 1) -> np.ndarray:
    """Return digital numbers of 12 bits, uint16, none of them 0."""
    return np.random.default_rng(seed).integers(1, 4096, shape).astype(np.uint16)


def restored(
    folder: Path, pixels: np.ndarray, tags: Mapping[str, Any] | None = None, **options: Any
) -> tuple[np.ndarray, Row]:
    """Write pixels to a file, restore it, and read the result.

    Args:
        folder: the folder of the two files.
        pixels: the pixels of the image.
        tags: options of tifffile for the image.
        options: the options of `restore`.
    """
    tifffile.imwrite(folder / "in.tif", pixels, **(tags or {}))
    (row,) = restore(folder / "in.tif", folder / "out.tif", overwrite=True, **options).rows
    with warnings.catch_warnings(action="ignore"), rasterio.open(folder / "out.tif") as file:
        pixels = file.read()
    return pixels if len(pixels) > 1 else pixels[0], row


def source_of(pixels: np.ndarray, nodata: float | None = None) -> ArraySource:
    """Return pixels (H, W) or (bands, H, W) as an image."""
    planes = pixels if pixels.ndim == 3 else pixels[None]
    bands, height_px, width_px = planes.shape
    return ArraySource(planes, Raster(bands, height_px, width_px, planes.dtype, nodata))


def names(folder: Path) -> list[str]:
    """Return the sorted names of all that a folder contains."""
    return sorted(path.name for path in folder.iterdir())


def marked(nodata: float) -> dict[str, Any]:
    """Return options of tifffile for a TIFF in which this value marks missing pixels."""
    return {"extratags": [(42113, "s", 0, f"{nodata}", True)]}


PLANES: dict[str, Any] = {"planarconfig": "separate", "photometric": "minisblack"}
"""Options of tifffile for a TIFF of several bands."""

NAME = "pleiades-degraded"
TRANSFORM = rasterio.Affine(0.5, 0.1, 500000, 0.05, -0.5, 4600000)
NODATA = 65535


def two_bands(path: Path) -> np.ndarray:
    """Write a georeferenced image of two bands (150, 214), and return the first band.

    In the second band the first 64 x 64 pixels are missing.
    """
    band = pair_of_bands().degraded[:150]
    second = band.copy()
    second[:64, :64] = NODATA
    with rasterio.open(
        path, "w", driver="GTiff", width=214, height=150, count=2, dtype="uint16",
        crs="EPSG:32631", transform=TRANSFORM, nodata=NODATA,
    ) as file:  # fmt: skip
        file.write(np.stack([band, second]))
        file.descriptions = ("blue", "red")
    return band


def simulated(**options: Any) -> bd.Pair:
    """Simulate one pair: without a folder to write, `simulate` returns one."""
    pair = bd.simulate(**options)
    assert isinstance(pair, bd.Pair)
    return pair


@cache
def pair_of_bands() -> bd.Pair:
    """Return a drawn scene of 214 x 214 pixels as `NAME` acquires it."""
    return simulated(sensor=NAME, size=214, seed=3)


def begin(image: Path, out: Path, *options: object) -> subprocess.Popen[str]:
    """Start a run on one thread."""
    command = [sys.executable, "-m", "beers_deploy", "restore", image, out, "--threads", 1]
    return subprocess.Popen(
        list(map(str, [*command, *options])),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def until(running: subprocess.Popen[str], word: str) -> bool:
    """Wait until a run prints a word or ends; return True if it printed the word."""
    assert running.stdout is not None
    return any(word in line for line in running.stdout)


def stop_after(tiles: int, patch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Raise an error in the engine after this number of tiles."""
    count = iter(range(10**6))
    tile = Restorer.tile

    def stopping(self: Restorer, *rest: object) -> Tile:
        if next(count) == tiles:
            raise error
        return tile(self, *rest)  # type: ignore[arg-type]

    patch.setattr(Restorer, "tile", stopping)


@contextmanager
def stopped_after(tiles: int, error: BaseException | None = None) -> Iterator[None]:
    """Stop the run in this block after some tiles, by an error or as Ctrl-C does."""
    error = error or KeyboardInterrupt()
    with pytest.MonkeyPatch.context() as patch:
        stop_after(tiles, patch, error)
        with pytest.raises(type(error)):
            yield
