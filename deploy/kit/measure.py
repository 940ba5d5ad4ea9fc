#!/usr/bin/env python3
"""Measure a network on a board, and write the file that `beers-deploy bench --measured board.json`
reads.

The script needs Python 3.8, numpy and onnxruntime with the board's execution provider, but not
beers-deploy. Copy this file and the model to the board, then:

    python3 measure.py core.onnx --provider VitisAIExecutionProvider \
        --option config_file=/usr/bin/vaip_config.json \
        --configuration C32B3 --frames 300 --threads 3 --out board.json

It has been run with onnxruntime's CPU provider only, never on a board: see docs/how-to/board.md.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import threading
import time
from pathlib import Path

import numpy as np

# From 1.29 on onnxruntime reports its use, unless this is set before it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime as ort

POWER_SAMPLE_S = 0.05
WARM_UP_CALLS = 5
LATENCY_CALLS = 20


def main() -> int:
    """Run the script: measure the network and add the result to the JSON file.

    Return the exit code: 0 when done, 2 for an error that the user can correct.
    """
    options = arguments()
    try:
        # Files that cannot be read are refused before minutes are spent on a run.
        read_runs(options.out)
        read_power_w(options.power_file)
        entry = measure(options)
        runs = [*read_runs(options.out), entry]
        options.out.write_text(json.dumps(runs, indent=1) + "\n", encoding="utf-8")
    except (OSError, RuntimeError, ValueError) as error:
        print(f"measure.py: {error}", file=sys.stderr)
        return 2
    print(f"wrote {options.out}: {entry}")
    return 0


def arguments() -> argparse.Namespace:
    """Parse the command line. `--help` describes the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("model", type=Path, help="QDQ ONNX: the file of 'beers-deploy quantize --board-file'")
    add("--out", type=Path, default=Path("board.json"), help="JSON list; a new run is added to it")
    add("--provider", default="VitisAIExecutionProvider", help="onnxruntime's execution provider")
    add(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the provider; repeat it for several",
    )
    # No default: the rate of another DPU would correct the predictions of the named one.
    add("--configuration", required=True, help="DPU in the bitstream, such as C32B3 or B4096")
    sides = "tile side in image pixels; by default that of host.json next to the model, or 640"
    add("--tile", type=count, help=sides)
    add("--batch", type=count, default=1, help="tiles in one call")
    add("--frames", type=count, default=300, help="tiles to time, after a warm-up")
    add("--threads", type=count, default=1, help="calls in flight, up to one per batch handler")
    power = "file of the power in microwatts, such as hwmon's power1_input; repeat it to add more"
    add("--power-file", type=Path, action="append", default=[], help=power)
    add("--no-compare", action="store_true", help="skip the comparison with the CPU provider")
    return parser.parse_args()


def count(text: str) -> int:
    """Convert an option's text to a whole number of at least 1; argparse names the option."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {number}")
    return number


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Measure the rate, the latency and, if asked, the power of a network.

    The outputs are first compared with those of onnxruntime's CPU provider, unless this is switched
    off. Progress is printed.

    Args:
        options: the options of the command line.

    Returns:
        An entry of board.json: the name of the model, the DPU's configuration, the tile side, the
        rate in frames per second, the provider and, if measured, the mean power in W.
    """
    pairs = [option.partition("=") for option in options.option]
    if not all(sign for _, sign, _ in pairs):
        raise ValueError(f"--option must be KEY=VALUE, got {' '.join(options.option)}.")
    tile_px = kit_tile_px(options.model.parent / "host.json", options.tile)
    session = open_session(options.model, options.provider, {key: value for key, _, value in pairs})
    feed = make_feed(session, options.batch, tile_px)
    try:
        session.run(None, feed)
    # onnxruntime raises a class of its own for each status code.
    except Exception as error:
        raise ValueError(
            f"{options.provider} cannot run {options.model} on tiles of {tile_px} px: {error}. "
            "Give the --tile that it accepts."
        ) from error
    if not options.no_compare:
        compare(options.model, session, feed)
    stamps, _ = run_threads(session, feed, 1 + WARM_UP_CALLS + LATENCY_CALLS, 1, [])
    latency_ms = 1e3 * statistics.median(np.diff(stamps)[WARM_UP_CALLS:])
    print(
        f"latency of a call of {options.batch}: median {latency_ms:.2f} ms over {LATENCY_CALLS} "
        "calls, one thread"
    )
    stamps, power_w = run_threads(
        session, feed, -(-options.frames // options.batch), options.threads, options.power_file
    )
    fps = throughput(stamps, options.batch)
    print(
        f"throughput: {fps:.3f} frame/s over {len(stamps) * options.batch} frames, "
        f"{options.threads} threads"
    )
    entry: dict[str, object] = {"model": options.model.name, "configuration": options.configuration}
    entry.update(tile_px=tile_px, fps=round(fps, 4), provider=options.provider)
    if power_w:
        entry["power_w"] = round(statistics.fmean(power_w), 3)
    return entry


def kit_tile_px(facts: Path, asked_px: int | None) -> int:
    """Return the tile side in pixels that a kit's host.json states; without that file `asked_px`,
    or 640.

    Raises:
        ValueError: the kit was made for another side than `asked_px`.
    """
    if not facts.is_file():
        return asked_px or 640
    tile_px = int(json.loads(facts.read_text(encoding="utf-8"))["tile_px"])
    # The rate would be recorded as that of tiles that never ran.
    if asked_px not in (None, tile_px):
        raise ValueError(
            f"This kit's cores are made for tiles of {tile_px} px, but --tile is {asked_px}. Leave "
            "--tile out."
        )
    return tile_px


def open_session(model: Path, provider: str, options: dict[str, str]) -> ort.InferenceSession:
    """Open a network in onnxruntime, and make sure that the provider itself runs it.

    Args:
        model: the ONNX file.
        provider: the name of the execution provider, such as VitisAIExecutionProvider.
        options: the options of the provider, by name.

    Raises:
        ValueError: the provider is not available, cannot open the file, or onnxruntime fell back
            to another.
    """
    if provider not in ort.get_available_providers():
        raise ValueError(
            f"onnxruntime has no provider {provider} here, only "
            f"{', '.join(ort.get_available_providers())}."
        )
    if not model.is_file():
        raise ValueError(f"{model}: no such file. Give an ONNX file.")
    try:
        session = ort.InferenceSession(str(model), providers=[provider], provider_options=[options])
    # onnxruntime raises a class of its own for each status code.
    except Exception as error:
        raise ValueError(f"{provider} cannot open {model}: {error}") from error
    if session.get_providers()[0] != provider:
        raise ValueError(
            f"{provider} does not run the model: onnxruntime fell back to "
            f"{session.get_providers()[0]}."
        )
    return session


def make_feed(session: ort.InferenceSession, batch: int, tile_px: int) -> dict[str, np.ndarray]:
    """Make an input of noise, the same in every run, that int8 represents exactly.

    Values are int8 if the network reads int8, otherwise float32 multiples of 2^-7.

    Args:
        session: the network. Sizes that it fixes are used, because a core may read a border around
            its tile, or squares of pixels as channels.
        batch: the number of tiles in a call.
        tile_px: side of a tile in pixels, for sizes that the network leaves open.

    Returns:
        The arrays (batch, C, H, W) by the name of the input.

    Raises:
        ValueError: the network is fixed to another number of tiles.
    """
    random = np.random.default_rng(0)
    feed = {}
    for tensor in session.get_inputs():
        free = [batch, tensor.shape[1], tile_px, tile_px]
        sizes = zip(tensor.shape, free)  # noqa: B905 - a board's Python may be old
        shape = [size if isinstance(size, int) else other for size, other in sizes]
        if shape[0] != batch:
            raise ValueError(
                f"{tensor.name} is fixed to {shape[0]} tiles in a call, not {batch}. Give --batch "
                f"{shape[0]}."
            )
        values = random.integers(-100, 100, shape)
        feed[tensor.name] = (
            values.astype(np.int8) if "int8" in tensor.type else (values / 128).astype(np.float32)
        )
    return feed


def compare(model: Path, session: ort.InferenceSession, feed: dict[str, np.ndarray]) -> None:
    """Print how much the outputs differ from those of onnxruntime's CPU provider.

    A network that compiles for the board may still compute other values there.

    Args:
        model: the ONNX file.
        session: the network on the provider that is measured.
        feed: the inputs by name.
    """
    expected = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"]).run(None, feed)
    for tensor, ours, reference in zip(session.get_outputs(), session.run(None, feed), expected):  # noqa: B905
        difference = np.abs(ours.astype(np.float64) - reference)
        print(
            f"{tensor.name}: largest difference from the CPU provider {difference.max():.3g}, "
            f"mean {difference.mean():.3g}, {100 * np.mean(difference > 0):.1f} % of values differ"
        )


def run_threads(
    session: ort.InferenceSession,
    feed: dict[str, np.ndarray],
    calls: int,
    threads: int,
    power_files: list[Path],
) -> tuple[list[float], list[float]]:
    """Run the network many times from several threads.

    Args:
        session: the network.
        feed: the inputs of each call by name.
        calls: the number of calls of all threads together.
        threads: the number of threads, each of which has one call in flight.
        power_files: files with the power in microwatts, which are summed; empty to measure none.

    Returns:
        The time at which each call ended in s, ascending, and samples of the power in W.
    """
    stamps: list[float] = []
    # All threads share this iterator: one step of it is not interrupted by another thread.
    numbers = iter(range(calls))

    def work() -> None:
        for _ in numbers:
            session.run(None, feed)
            stamps.append(time.perf_counter())

    workers = [threading.Thread(target=work) for _ in range(threads)]
    for worker in workers:
        worker.start()
    power_w: list[float] = []
    while power_files and (not power_w or workers[0].is_alive()):
        power_w.append(read_power_w(power_files))
        time.sleep(POWER_SAMPLE_S)
    for worker in workers:
        worker.join()
    return sorted(stamps), power_w


def read_power_w(files: list[Path]) -> float:
    """Return the power in W, summed over files that state it in microwatts."""
    return sum(int(file.read_text(encoding="utf-8")) for file in files) / 1e6


def throughput(stamps: list[float], batch: int) -> float:
    """Compute the frames per second: batch (N - 1) / (t_N - t_1) for N calls.

    The first call only starts the clock, so its latency does not count.

    Args:
        stamps: the times t_1 ... t_N in s at which the calls ended, ascending.
        batch: the number of frames (tiles) in a call.

    Raises:
        ValueError: there are fewer than two calls.
    """
    if len(stamps) < 2:
        raise ValueError(
            f"The throughput needs at least two calls, got {len(stamps)}. Give more --frames."
        )
    return batch * (len(stamps) - 1) / (stamps[-1] - stamps[0])


def read_runs(path: Path) -> list[object]:
    """Read the list in a JSON file; an absent file has an empty one.

    Raises:
        ValueError: the file does not contain a list, or its folder does not exist.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path.parent} is not a folder. Give another --out.")
    try:
        runs = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    except ValueError:
        runs = None
    if not isinstance(runs, list):
        raise ValueError(f"{path} must be a JSON list of runs. Give another --out.")
    return runs


if __name__ == "__main__":
    sys.exit(main())
