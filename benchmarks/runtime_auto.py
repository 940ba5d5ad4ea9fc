"""What `--runtime auto` chooses beside every choice that it has: time of the engine from file to file.

    python benchmarks/runtime_auto.py NETWORK.onnx ... [--size 3000x2000] [--repeats 3] [--threads 0]

All settings are interleaved; figures are their fastest times, by the clock and by the processor (on a busy machine
only the latter tells of the setting). The last line of a network is the time of the best over that of the chosen one.
Every output's pixels are compared with the usual one's.
"""

import argparse
import os
import tempfile
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import tifffile
from swath import fastest, write_noise

from deploy.bench.tables import parse_size
from deploy.networks import CACHE_VARIABLE
from deploy.restoration.choice import SIDES_PX, settled
from deploy.restoration.options import TILE_PX, Options, Runtime
from deploy.restoration.run import restore_file
from deploy.restoration.runtime import lanes_for
from model.processor import processor_name
from quant.onnx_file import is_quantised, load_onnx


def main() -> None:
    """Print a line a setting, and one for what was chosen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("networks", type=Path, nargs="+")
    parser.add_argument("--size", default="3000x2000")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    arguments = parser.parse_args()
    print(processor_name(), flush=True)
    with tempfile.TemporaryDirectory() as name:
        os.environ[CACHE_VARIABLE] = str(Path(name) / "cache")
        for path in arguments.networks:
            race(Path(name), path, parse_size(arguments.size), arguments.repeats, arguments.threads)


def race(folder: Path, path: Path, size: tuple[int, int], repeats: int, threads: int) -> None:
    """One network in all settings, and in the one chosen."""
    image, network = folder / "image.tif", load_onnx(path)
    dn = write_noise(image, size)
    automatic = Options(path, runtime=Runtime.auto, threads=threads)
    chosen, _ = settled(network, (1, *dn.shape), automatic, lambda words: print(path.stem, words, flush=True))
    runtimes = (Runtime.onnxruntime, Runtime.openvino) if is_quantised(network) else (Runtime.onnxruntime,)
    settings = list(product(runtimes, sorted({TILE_PX, *SIDES_PX}), lanes_for(threads, 1 << 20)))
    each = [Options(path, tile, runtime=runtime, threads=threads, lanes=n) for runtime, tile, n in settings]
    outs = [folder / f"{k}.tif" for k in range(len(each))]
    works = [partial(restored, image, out, options) for out, options in zip(outs, each, strict=True)]
    times_s = fastest(works, repeats)
    same = all(np.array_equal(tifffile.imread(out), tifffile.imread(outs[0])) for out in outs)
    for (runtime, tile, lanes), (clock_s, cpu_s) in zip(settings, times_s, strict=True):
        print(f"{path.stem:14} {runtime:12} tile {tile:4} lanes {lanes}: {clock_s:.2f} s, processor {cpu_s:.2f} s")
    at = each.index(chosen)
    clock, cpu = times_s.min(axis=0) / times_s[at]
    print(f"{path.stem}: best over chosen {clock:.3f} by the clock, {cpu:.3f} by the processor; same pixels: {same}")


def restored(image: Path, out: Path, options: Options) -> None:
    """From file to file."""
    restore_file(image, out, options, lambda _: None)


if __name__ == "__main__":
    main()
