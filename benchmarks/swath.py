"""The swath engine beside the bare runtime on the same tiles in memory, and the memory of whole
swaths.

    python benchmarks/swath.py [--size 3000x2000] [--runtimes onnxruntime,openvino] \
        [--swaths 13600x9016,20000x20000]
    python benchmarks/swath.py --peers [--monai-python monai/bin/python]

`monai_child.py` says how to make MONAI's environment.

Random weights: speed and memory do not depend on them. Engine and bare runtime are interleaved; the
ratios are of their fastest times, by the clock and by the processor (with --threads 1 the latter
also holds on a busy machine). Swaths run in a process of their own, through a network of one block.
With --peers the engine runs beside dask.array.map_overlap, and beside MONAI where its Python is
given, from file to file: times interleaved, and how far their pixels lie from the engine's, which
are the whole image's.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tifffile
import torch

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.variants import VARIANTS, Variant
from beers_deploy.network import Network
from beers_deploy.performance.swath import parse_size
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.restoration.plan import make_plan
from beers_deploy.restoration.runtime import Runtime, open_runtime
from beers_deploy.restoration.tiles.exposures import restore_window
from beers_deploy.verbs.restore import restore

TILE_PX = 640
ENTRY = "from beers_deploy.cli.commands import app; app()"


def main() -> None:
    """Print a line a network and runtime, then a line a swath."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", default="3000x2000")
    parser.add_argument("--runtimes", default="onnxruntime")
    parser.add_argument("--variants", default="convbeers-xs,convbeers-s")
    parser.add_argument("--int8", type=Path, help="an INT8 network to time as well")
    parser.add_argument("--swaths", default="")
    parser.add_argument(
        "--peers", action="store_true", help="beside dask.array.map_overlap, and MONAI where given"
    )
    parser.add_argument(
        "--monai-python", help="interpreter of the environment that MONAI is installed in"
    )
    parser.add_argument(
        "--known-rows", type=int, help="rows of the swaths that hold pixels; below them is nodata"
    )
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        networks = [
            random_network(folder, v, VARIANTS[v]) for v in arguments.variants.split(",") if v
        ]
        for path in networks + ([arguments.int8] if arguments.int8 else []):
            for runtime in arguments.runtimes.split(","):
                way = Way(path, runtime, arguments.threads)
                size = parse_size(arguments.size)
                repeats = arguments.repeats
                if arguments.peers or arguments.monai_python:
                    beside_peers(folder, way, size, repeats, arguments.monai_python)
                else:
                    speed(folder, way, size, repeats)
        for size in filter(None, arguments.swaths.split(",")):
            memory(
                folder,
                random_network(folder, "one-block", Variant(1, 8)),
                parse_size(size),
                arguments.known_rows,
            )


@dataclass(frozen=True)
class Way:
    """A network, and what runs it.

    Attributes:
        path: of the network.
        runtime: the library.
        threads: of the library; 0 uses all cores.
    """

    path: Path
    runtime: Runtime
    threads: int

    @property
    def network(self) -> Network:
        """The network, read from its file."""
        return Network.load(self.path)

    def restore(self, image: Path, out: Path) -> None:
        """Restore a file in tiles, over an older result."""
        restore(
            image,
            out,
            network=self.path,
            tile=TILE_PX,
            runtime=self.runtime,
            threads=self.threads,
            overwrite=True,
            progress=False,
        )


def speed(folder: Path, way: Way, size: tuple[int, int], repeats: int) -> None:
    """Engine from file to file over the bare runtime on the same windows, already float32 in
    memory, one by one.
    """
    image = folder / "image.tif"
    dn = write_noise(image, size)
    network = way.network.model
    tiling = tiling_of(network)
    plan = make_plan((1, *dn.shape), TILE_PX, tiling.halo_px, tiling)
    tiles = [dn[r.start : r.stop, c.start : c.stop] for r, c in product(plan.rows, plan.columns)]
    windows = [
        np.ascontiguousarray(pixels, np.float32)[None, None] / np.float32(4095) for pixels in tiles
    ]
    infer, version = open_runtime(way.runtime, network, way.threads)

    def bare() -> None:
        for window in windows:
            infer(window)

    def engine() -> None:
        way.restore(image, folder / "out.tif")

    (bare_s, bare_cpu_s), (engine_s, engine_cpu_s) = fastest([bare, engine], repeats)
    print(
        f"{way.network.name:18} {version:20} {plan.tiles} tiles: bare {bare_s:.2f} s, engine "
        f"{engine_s:.2f} s "
        f"({dn.size / engine_s / 1e6:.3f} Mpx/s); engine over bare {bare_s / engine_s:.3f} by "
        "the clock, "
        f"{bare_cpu_s / engine_cpu_s:.3f} by the processor",
        flush=True,
    )


def beside_peers(
    folder: Path, way: Way, size: tuple[int, int], repeats: int, monai_python: str | None
) -> None:
    """Engine and peers from file to file; peers run on onnxruntime or OpenVINO here, MONAI on
    onnxruntime.
    """
    image = folder / "image.tif"
    dn = write_noise(image, size)
    task = Task(image, way, way.threads or os.cpu_count() or 1)
    with ways(task, monai_python) as runs:
        times_s = fastest(list(runs.values()), repeats)
    for name, (clock_s, cpu_s) in zip(runs, times_s, strict=True):
        largest, mean = difference_dn(task.out("engine"), task.out(name))
        print(
            f"{way.network.name:18} {way.runtime:12} {name:24} {clock_s:.2f} s "
            f"({dn.size / clock_s / 1e6:.3f} Mpx/s); over the engine "
            f"{clock_s / times_s[0, 0]:.2f} by the clock, "
            f"{cpu_s / times_s[0, 1]:.2f} by the processor; off by {largest:.0f} DN at most, "
            f"{mean:.4f} on average",
            flush=True,
        )


Run = Callable[[], float | None]
"""One turn; returns what another process took of the processor, if one did."""


@dataclass(frozen=True)
class Task:
    """One image through one network, into a file for each program."""

    image: Path
    way: Way
    cores: int

    @property
    def halo_px(self) -> int:
        """Of the engine, and of the peers."""
        return self.way.network.tiling.halo_px

    def out(self, program: str) -> Path:
        """Return the file that a program writes."""
        return self.image.with_name(f"{program.replace(',', '').replace(' ', '-')}.tif")


@contextmanager
def ways(task: Task, monai_python: str | None) -> Iterator[dict[str, Run]]:
    """The engine first, then its peers, ready to run."""

    def engine() -> None:
        task.way.restore(task.image, task.out("engine"))

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


def overlapped(task: Task, program: str, chunks_at_once: int) -> Run:
    """dask.array.map_overlap over chunks that are a tile with their overlap, the cores shared among
    those at work.
    """
    core_px = TILE_PX - 2 * task.halo_px
    halo_px = task.halo_px
    out = task.out(program)
    threads = max(task.cores // chunks_at_once, 1)

    def run() -> None:
        import dask.array as da

        infer, _ = open_runtime(task.way.runtime, task.way.network.model, threads)

        def restored(block: np.ndarray) -> np.ndarray:
            return np.asarray(np.rint(restore_window(block, infer)), np.uint16)

        image = da.from_array(tifffile.imread(task.image), chunks=core_px)  # type: ignore[no-untyped-call]
        lazy = image.map_overlap(
            restored, depth=halo_px, boundary="none", meta=np.empty((0, 0), np.uint16)
        )
        pixels = lazy.compute(scheduler="threads", num_workers=chunks_at_once)
        # The engine writes the same, except for its zlib strategy, for which tifffile has no
        # option.
        packed: dict[str, Any] = {
            "compression": "zlib",
            "compressionargs": {"level": 1},
            "predictor": 2,
        }
        tifffile.imwrite(out, pixels, tile=(256, 256), maxworkers=os.cpu_count(), **packed)

    return run


@contextmanager
def child(task: Task, python: str) -> Iterator[Run]:
    """MONAI in its process, loaded and waiting; each call is one turn, and returns its seconds of
    the processor.
    """
    words = (
        task.way.path,
        task.image,
        task.out("MONAI"),
        TILE_PX,
        2 * task.halo_px / TILE_PX,
        task.cores,
    )
    command = [python, str(Path(__file__).with_name("monai_child.py")), *map(str, words)]
    with subprocess.Popen(  # noqa: S603
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:

        def turn() -> float:
            assert process.stdin is not None  # noqa: S101 - asked for above
            assert process.stdout is not None  # noqa: S101
            process.stdin.write("go\n")
            process.stdin.flush()
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(f"MONAI ended with {process.wait()}; its message stands above")
            return float(json.loads(line)["cpu_seconds"])

        yield turn


def difference_dn(ours: Path, theirs: Path) -> tuple[float, float]:
    """Largest and mean difference of two files, in digital numbers."""
    error = np.abs(tifffile.imread(ours).astype(np.float64) - tifffile.imread(theirs))
    return float(error.max()), float(error.mean())


def write_noise(path: Path, size: tuple[int, int]) -> np.ndarray:
    """A noisy image of width x height, in packed tiles; returns its pixels."""
    dn = np.random.default_rng(0).integers(100, 3000, size[::-1]).astype(np.uint16)
    tifffile.imwrite(path, dn, tile=(256, 256), compression="zlib")
    return dn


def fastest(works: Sequence[Callable[[], float | None]], repeats: int) -> np.ndarray:
    """The fastest (clock, processor) times of each in s, interleaved; the first turn is not
    counted.

    A work returns what another process took of the processor, if one did.
    """
    times_s = np.zeros((repeats + 1, len(works), 2))
    for turn in times_s:
        for k, work in enumerate(works):
            before = time.perf_counter(), time.process_time()
            elsewhere_s = work() or 0.0
            turn[k] = time.perf_counter() - before[0], time.process_time() - before[1] + elsewhere_s
    return np.asarray(times_s[1:].min(axis=0))


def memory(folder: Path, model: Path, size: tuple[int, int], known_rows: int | None) -> None:
    """Peak memory of the command on a drawn swath, compressed in tiles, never whole in memory."""
    width, height = size
    image = folder / "swath.tif"
    figures = folder / "swath.json"
    write_swath(image, height, width, known_rows or height)
    arguments = ["restore", image, folder / "swath-out.tif", "--network", model, "--json", figures]
    subprocess.run([sys.executable, "-c", ENTRY, *map(str, arguments)], check=True)  # noqa: S603
    row = json.loads(figures.read_text(encoding="utf-8"))["rows"][0]["figures"]
    time_s = row["time"]["value"]
    peak_gb = row["peak memory"]["value"]
    print(f"{width} x {height}: {time_s:.0f} s, peak memory {peak_gb:.3f} GB", flush=True)


def write_swath(path: Path, height: int, width: int, known_rows: int) -> None:
    """A ramp of uint16 over the known rows, tile by tile; tiles below them are left out of the
    file, as nodata.
    """
    ramp = np.arange(1, 257, dtype=np.uint16) * np.ones((256, 1), np.uint16)
    across = -(-width // 256)
    block_count = -(-known_rows // 256) * across
    count = -(-height // 256) * across
    tifffile.imwrite(
        path,
        # tifffile leaves a tile out of the file if it is None. Readers see nodata there.
        (ramp + np.uint16(k % 3000) if k < block_count else None for k in range(count)),
        shape=(height, width),
        dtype=np.uint16,
        tile=(256, 256),
        compression="zlib",
        bigtiff=True,
        extratags=[(42113, "s", 0, "0", True)],
    )


def random_network(folder: Path, name: str, variant: Variant) -> Path:
    """A float network with random weights."""
    network = ConvBEERS(variant)
    initialise(network, torch.Generator().manual_seed(0))
    onnx.save(to_onnx(network, {}), folder / f"{name}.onnx")
    return folder / f"{name}.onnx"


if __name__ == "__main__":
    main()
