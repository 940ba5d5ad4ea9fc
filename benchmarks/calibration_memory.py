"""Peak memory and time of `quantize` for few and many patches, and for large ones: each in a
process of its own.

    python benchmarks/calibration_memory.py --float mine.onnx --images aerial/

Memory is the largest resident set that the system counted for the process: the interpreter, torch
and onnxruntime are in it (measured alone in the first line), and so are the scenes, which stay in
memory whatever is drawn from them.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMMAND = [sys.executable, "-c", "from beers_deploy.cli.commands import app; app()"]
IMPORTS = [sys.executable, "-c", "import beers_deploy.quant.quantize"]
CASES = ((64, 128), (1024, 128), (16, 640))
"""Number of patches, and their side in pixels."""


def measure(command: list[str]) -> tuple[float, float, float]:
    """Peak MB of one process, its seconds by the clock, and its seconds of
    computing on all cores.
    """
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603 - our own command
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} failed")
    # ru_maxrss is in bytes on macOS and in KiB elsewhere.
    unit = 1 if sys.platform == "darwin" else 1024
    return (
        usage.ru_maxrss * unit / 1e6,
        time.perf_counter() - started,
        usage.ru_utime + usage.ru_stime,
    )


def main() -> None:
    """Measure each case and print a line for it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--float", type=Path, required=True, help="a float network for one sensor")
    parser.add_argument("--images", type=Path, help="folder of scenes; drawn ones if none")
    arguments = parser.parse_args()
    scenes = ["--images", str(arguments.images)] if arguments.images else []
    print(f"{'imports alone':24s} {measure(IMPORTS)[0]:7.0f} MB")
    with tempfile.TemporaryDirectory() as folder:
        network = str(arguments.float)
        int8 = str(Path(folder) / "int8.onnx")
        for patches, side in CASES:
            options = [
                "--sensor",
                "pleiades-variable",
                "--patches",
                str(patches),
                "--patch",
                str(side),
                *scenes,
            ]
            peak, seconds, computing = measure(
                [*COMMAND, "quantize", network, "--out", int8, *options]
            )
            work = f"{patches:5d} of {f'{side} x {side}':16s}"
            print(
                f"{work} {peak:7.0f} MB {seconds:6.0f} s, computing {computing:.0f} s", flush=True
            )


if __name__ == "__main__":
    main()
