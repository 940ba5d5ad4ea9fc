"""Peers of the swath engine: dask.array.map_overlap here, MONAI's SlidingWindowInferer in an environment of its own.

`swath.py --peers` and `--monai-python` run them, from file to file like the engine: the same image, network, tile,
overlap and runtime, interleaved. `monai_child.py` says how to make MONAI's environment.
"""

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import onnx
import tifffile

from beers_deploy.profiles.target import TILE_PX
from beers_deploy.quant.tiling.walk import tiling_of
from beers_deploy.restoration.engine import restore_window
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.run import restore_file
from beers_deploy.restoration.runtime import open_runtime

HERE = Path(__file__).parent
CHILD = HERE / "monai_child.py"
Run = Callable[[], float | None]
"""One turn; returns what another process took of the processor, if one did."""


@dataclass(frozen=True)
class Task:
    """One image through one network, into a file of each way's own."""

    image: Path
    options: Options
    cores: int

    @property
    def halo_px(self) -> int:
        """Of the engine, and of the peers."""
        return tiling_of(onnx.load(self.options.model)).halo_px

    def out(self, way: str) -> Path:
        """Where a way writes."""
        return self.image.with_name(f"{way.replace(',', '').replace(' ', '-')}.tif")


@contextmanager
def ways(task: Task, monai_python: str | None) -> Iterator[dict[str, Run]]:
    """The engine first, then its peers, ready to run."""

    def engine() -> None:
        restore_file(task.image, task.out("engine"), task.options)

    runs: dict[str, Run] = {
        "engine": engine,
        "dask, a chunk at a time": overlapped(task, "dask, a chunk at a time", 1),
        "dask, a chunk a core": overlapped(task, "dask, a chunk a core", task.cores),
    }
    if monai_python is None:
        yield runs
        return
    with child(task, monai_python) as turn:
        yield {**runs, "MONAI": turn}


def overlapped(task: Task, way: str, chunks_at_once: int) -> Run:
    """dask.array.map_overlap over chunks that are a tile with their overlap, the cores shared among those at work."""
    core_px, halo_px = (task.options.tile_px or TILE_PX) - 2 * task.halo_px, task.halo_px
    out, threads = task.out(way), max(task.cores // chunks_at_once, 1)

    def run() -> None:
        infer, _ = open_runtime(task.options.runtime, onnx.load(task.options.model), threads)

        def restored(block: np.ndarray) -> np.ndarray:
            return np.asarray(np.rint(restore_window(block, infer)), np.uint16)

        image = da.from_array(tifffile.imread(task.image), chunks=core_px)  # type: ignore[no-untyped-call]
        lazy = image.map_overlap(restored, depth=halo_px, boundary="none", meta=np.empty((0, 0), np.uint16))
        pixels = lazy.compute(scheduler="threads", num_workers=chunks_at_once)
        write(out, pixels)

    return run


def write(path: Path, pixels: np.ndarray) -> None:
    """As the engine writes, but for its strategy of zlib, which tifffile has no option for."""
    packed: dict[str, Any] = {"compression": "zlib", "compressionargs": {"level": 1}, "predictor": 2}
    tifffile.imwrite(path, pixels, tile=(256, 256), maxworkers=os.cpu_count(), **packed)


@contextmanager
def child(task: Task, python: str) -> Iterator[Run]:
    """MONAI in its process, loaded and waiting; each call is one turn, and returns its seconds of the processor."""
    out, tile_px = task.out("MONAI"), task.options.tile_px or TILE_PX
    given = (task.options.model, task.image, out, tile_px, 2 * task.halo_px / tile_px, task.cores)
    command = [python, str(CHILD), *map(str, given)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603

        def turn() -> float:
            assert process.stdin is not None  # noqa: S101 - asked for above
            assert process.stdout is not None  # noqa: S101
            process.stdin.write("go\n")
            process.stdin.flush()
            said = process.stdout.readline()
            if not said:
                raise RuntimeError(f"MONAI ended with {process.wait()}; its message stands above")
            return float(json.loads(said)["cpu_seconds"])

        yield turn


def difference_dn(ours: Path, theirs: Path) -> tuple[float, float]:
    """Largest and mean difference of two files, in digital numbers."""
    error = np.abs(tifffile.imread(ours).astype(np.float64) - tifffile.imread(theirs))
    return float(error.max()), float(error.mean())
