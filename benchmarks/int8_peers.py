"""Compare INT8 by `quantize` with INT8 by AMD Quark, on small networks.

    python -m benchmarks.int8_peers --images aerial-train/ --held-out aerial-test/ \
        --quark-python quark/bin/python

The script prints a Markdown table: the mean and the worst loss of PSNR in dB, over samples that
neither training nor calibration saw, and the processor time of quantising in seconds. With --tuned
it adds our integers fine-tuned on eight times the samples, and Quark's weights rounded by AdaRound.

Quark needs other versions of its libraries, so it is installed in an environment of its own.
Without the CPU build of torch, pip would fetch gigabytes of CUDA packages:

    python3 -m venv quark
    quark/bin/pip install torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu
    quark/bin/pip install amd-quark==0.13 onnxruntime==1.28.0
"""

import resource
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from beers_deploy import quantize
from beers_deploy.quant.onnx_file import save_onnx
from benchmarks.small_networks import (
    NETWORKS,
    Drawn,
    Small,
    names_in,
    options,
    prepared,
)

MORE = 8
"""The factor by which fine-tuning uses more samples."""
ADAROUND_STEPS = 1000
"""AdaRound steps per layer, Quark's own default."""
Quantize = Callable[[Small, Path], object]


def ours(network: Small, out: Path) -> None:
    """Quantise as `quantize` does."""
    int8 = quantize(network.path, samples=network.samples.images, progress=False)
    save_onnx(int8.model, out)


def tuned(more: Drawn, network: Small, out: Path) -> None:
    """Quantise and fine-tune as `quantize --finetune auto` does."""
    samples = more.images, more.references
    int8 = quantize(network.path, samples=samples, finetune="auto", progress=False)
    save_onnx(int8.model, out)


def quark(python: Path, adaround_steps: int, network: Small, out: Path) -> None:
    """Quantise with Quark, in its own environment."""
    samples = network.path.with_suffix(".npy")
    np.save(samples, network.samples.images)
    script = Path(__file__).with_name("quark_child.py")
    files = (script, network.path, samples, out)
    command = [str(python.absolute()), *map(str, files), str(adaround_steps)]
    # Quark writes files into its working folder.
    subprocess.run(command, check=True, capture_output=True, cwd=out.parent)  # noqa: S603


def processor_s() -> float:
    """Return the processor time in seconds of this process and of those that it ran."""
    parts = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in parts)


def main() -> None:
    """Print one row for each network as soon as it is done."""
    parser = options(__doc__)
    parser.add_argument("--tuned", action="store_true", help="fine-tune as well; minutes a network")
    parser.add_argument("--quark-python", type=Path, help="interpreter that has AMD Quark")
    arguments = parser.parse_args()
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for number, name in enumerate(names_in(arguments)):
            network = prepared(name, arguments, folder)
            ways: dict[str, Quantize] = {"ours": ours}
            if arguments.tuned:
                kind, _ = NETWORKS[name]
                more = Drawn.of(kind, arguments.images, 5, MORE * arguments.batches)
                ways["ours, fine-tuned"] = partial(tuned, more)
            if arguments.quark_python:
                ways["Quark XINT8"] = partial(quark, arguments.quark_python, 0)
            if arguments.quark_python and arguments.tuned:
                ways["Quark XINT8, AdaRound"] = partial(
                    quark, arguments.quark_python, ADAROUND_STEPS
                )
            if number == 0:
                print(f"| network | {' | '.join(ways)} |\n|---{'|---' * len(ways)}|")
            cells = []
            for way in ways.values():
                int8 = folder / "int8.onnx"
                before_s = processor_s()
                way(network, int8)
                spent_s = processor_s() - before_s
                losses_db = network.losses_db(int8)
                cells.append(f"{losses_db.mean():.2f}, {losses_db.max():.2f}, {spent_s:.0f} s")
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
