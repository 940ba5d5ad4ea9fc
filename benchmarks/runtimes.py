"""OpenVINO beside onnxruntime: the shipped networks on one tile, in float32 and in INT8.

    python benchmarks/runtimes.py [--networks convbeers-xs,convbeers-s] [--threads 1,2]

Both run in turn in one process, and the fastest of several runs counts, so that what else the
machine does falls on both.
"""

import argparse
import time
from itertools import product
from typing import get_args

import numpy as np

from beers_deploy.model.processor import processor_name
from beers_deploy.model.shipped import SENSOR, shipped_names, shipped_weights
from beers_deploy.network_files import Conditioned
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.runtime import Infer, Runtime, open_runtime

TILE_PX = 640
TURNS = 5


def main() -> None:
    """Print a row a network, precision and number of threads."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", default=",".join(shipped_names()))
    parser.add_argument("--threads", default="1,2")
    arguments = parser.parse_args()
    image = np.random.default_rng(0).random((1, 1, TILE_PX, TILE_PX), np.float32)
    sensor = Sensor.load(SENSOR)
    print(f"{processor_name()}, a tile of {TILE_PX} x {TILE_PX} pixels")
    print("| network | threads | onnxruntime ms | OpenVINO ms | times faster | difference |")
    print("|---|---|---|---|---|---|")
    for name, int8, threads in product(
        arguments.networks.split(","), (False, True), map(int, arguments.threads.split(","))
    ):
        model = Conditioned(name, shipped_weights(name)).model(sensor, int8)
        runs = [open_runtime(runtime, model, threads)[0] for runtime in get_args(Runtime)]
        results = [run(image) for run in runs]
        difference = float(np.abs(results[0] - results[1]).max())
        first_s, second_s = fastest_s(runs, image)
        label = f"{name}, {'INT8' if int8 else 'float32'}"
        print(
            f"| {label} | {threads} | {1e3 * first_s:.0f} | {1e3 * second_s:.0f} "
            f"| {first_s / second_s:.2f} | {difference:.1g} |",
            flush=True,
        )


def fastest_s(runs: list[Infer], image: np.ndarray) -> list[float]:
    """Return the shortest time of each of some runs, which take turns, in seconds."""
    times = np.zeros((TURNS, len(runs)))
    for turn, k in product(range(TURNS), range(len(runs))):
        started = time.perf_counter()
        runs[k](image)
        times[turn, k] = time.perf_counter() - started
    return [float(seconds) for seconds in times.min(0)]


if __name__ == "__main__":
    main()
