"""INT8 beside float32 on onnxruntime, as this processor computes them and as one without VNNI would
have to.

    python benchmarks/int8_kernels.py --variant convbeers-s --tile 640 --threads 1 2

`int8` is what every command runs here. `ways` takes, whatever the processor, the ways of one whose
int8 kernels saturate (`quant.kernels`): where they do, the two are the same. `plain` is the file as
it stands, which is right only where int8 products add exactly; int8 / plain is what exactness
costs. Sessions are interleaved, so that what else the machine does falls on each of them; ratios
are of the fastest turns. On another processor: benchmarks/without_vnni.py.
"""

import argparse
from collections import Counter
from functools import partial
from statistics import median

import numpy as np
import onnx
import onnxruntime as ort

from beers_deploy.model.processor import decided, int8_adds_exactly, processor_name
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network
from beers_deploy.performance.timing import interleaved
from beers_deploy.quant.kernels import filled, made_exact
from beers_deploy.quant.session import open_session, run

VARIANTS = ("convbeers-xs", "convbeers-s", "convbeers")


def main() -> None:
    """Print the ways by layer, then the times and their ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variant", choices=VARIANTS, nargs="+", default=["convbeers-s"])
    parser.add_argument("--tile", type=int, default=640)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--turns", type=int, default=5)
    arguments = parser.parse_args()
    int8_adds_exactly()
    print(
        f"{processor_name()}, onnxruntime {ort.__version__}; int8: "
        f"{decided()['int8 on onnxruntime']}"
    )
    image = np.random.default_rng(0).random(
        (1, 1, arguments.tile, arguments.tile), dtype=np.float32
    )
    for variant in arguments.variant:
        floating, integer = (
            Network.load(variant, sensor=SENSOR, int8=int8).model for int8 in (False, True)
        )
        print_ways(variant, integer)
        for threads in arguments.threads:
            print_times(variant, floating, integer, image, threads, arguments.turns)


def print_ways(variant: str, integer: onnx.ModelProto) -> None:
    """How each layer is computed where the fast kernels saturate."""
    ways = made_exact(filled(integer))[1]
    counts = ", ".join(f"{count} {way}" for way, count in Counter(ways.values()).items())
    others = ", ".join(name for name, way in ways.items() if way.name != "signed")
    print(f"{variant}: {counts} ({others})")


def print_times(
    variant: str,
    floating: onnx.ModelProto,
    integer: onnx.ModelProto,
    image: np.ndarray,
    threads: int,
    turns: int,
) -> None:
    """The fastest run of each session, and the ratios."""
    sessions = {
        "float32": open_session(floating, threads),
        "int8": open_session(integer, threads),
        "ways": open_session(integer, threads, exact=True),
        "plain": open_session(integer, threads, exact=False),
    }
    calls = [partial(run, session, image) for session in sessions.values()]
    rounds = interleaved(calls, turns + 1)
    times_s = {
        name: [time_s for time_s, _ in pairs] for name, pairs in zip(sessions, rounds, strict=True)
    }
    # The first turn sets up the session and is left out.
    fastest_s = {name: min(times[1:]) for name, times in times_s.items()}
    spread = max(median(times[1:]) / fastest_s[name] for name, times in times_s.items())
    cells = ", ".join(f"{name} {time_s:.3f} s" for name, time_s in fastest_s.items())
    ratios = {name: fastest_s["float32"] / fastest_s[name] for name in ("int8", "ways")}
    cost = fastest_s["int8"] / fastest_s["plain"]
    print(
        f"{variant}, {image.shape[-1]} x {image.shape[-1]}, {threads} threads: {cells}; "
        f"float32 / int8 {ratios['int8']:.2f}, float32 / ways {ratios['ways']:.2f}, int8 / "
        f"plain {cost:.2f}; "
        f"median up to {spread:.2f} times the fastest"
    )


if __name__ == "__main__":
    main()
