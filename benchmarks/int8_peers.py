"""Our INT8 beside onnxruntime's and AMD Quark's: the same network, calibration patches and held-out patches, one run.

    python benchmarks/int8_peers.py --images aerial-train/ --held-out aerial-test/ --quark-python quark/bin/python

On Linux. Prints a Markdown table. Each way quantises in a process of its own; its peak memory has the interpreter and
libraries in it. Peers get the plain graph, and the one that we quantise: planes in, the correction out, the add
left to the host.

Quark wants other versions of its libraries, so it lives in its own environment. Without the CPU build of torch, pip
would fetch gigabytes of CUDA packages:

    python3 -m venv quark
    quark/bin/pip install torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu
    quark/bin/pip install amd-quark==0.13 onnxruntime==1.28.0
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx

from deploy.export import float_model as read_float
from model.metrics.fidelity import psnr_db, ssim
from model.shipped import shipped_weights
from model.simulator.procedural import load_scenes
from profiles import load_sensor
from profiles.sensor_file import reference_for
from quant.calibration import HELD_OUT_SEED, Pair, draw_patches
from quant.graph import CORRECTION, PLANES, correction_graph, graph_to_onnx, read_planes
from quant.session import open_session, planes_of

HERE = Path(__file__).parent
QUARK = HERE / "quark_child.py"
OURS = HERE / "int8_child.py"
Restore = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Way:
    """One line of the table: who quantises, which graph, and the command but for its files."""

    name: str
    rewritten: bool
    script: Path
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


def ways(adaround_iterations: int) -> list[Way]:
    """All that are compared, the slowest last."""
    peers: list[tuple[str, Path, tuple[str, ...], tuple[str, ...]]] = [
        ("onnxruntime min-max", OURS, ("minmax",), ()),
        ("onnxruntime percentile 99.99", OURS, ("percentile",), ()),
        ("Quark XINT8", QUARK, (), ("0",)),
        ("Quark XINT8 + AdaRound", QUARK, (), (str(adaround_iterations),)),
    ]
    ours = [Way(f"beers-deploy {regime}", False, OURS, (regime,)) for regime in ("legal", "free")]
    return ours + [
        Way(name, graph, script, before, after) for name, script, before, after in peers for graph in (False, True)
    ]


def restorer(path: Path) -> Restore:
    """A network as a function of images (1, 1, H, W): one that reads planes gets the host's add."""
    session = open_session(path)
    name = session.get_inputs()[0].name

    def restore(image: np.ndarray) -> np.ndarray:
        fed = planes_of(image) if name == PLANES else image
        result = np.asarray(session.run(None, {name: fed})[0])
        return np.asarray(np.clip(image + result if name == PLANES else result, 0, 1))

    return restore


def scores(in_float: Restore, in_int8: Restore, pairs: list[Pair]) -> list[str]:
    """The table's columns of accuracy; PSNR and SSIM are means over patches."""
    differences, rows = [], []
    for degraded, reference in pairs:
        both = in_float(degraded), in_int8(degraded)
        differences.append((both[1] - both[0]).ravel())
        rows.append([*(psnr_db(b, reference, 1.0) for b in both), ssim(both[1][0, 0], reference[0, 0], 1.0)])
    difference = np.concatenate(differences).astype(np.float64)
    mae, std = float(np.abs(difference).mean()), float(difference.std())
    db_float, db_int8, similarity = np.mean(rows, axis=0)
    sizes = [f"{mae:.6f}", f"{std:.6f}", f"{np.abs(difference).max():.4f}", f"{std / mae:.2f}"]
    return [*sizes, f"{db_float:.2f}", f"{db_int8:.2f}", f"{db_float - db_int8:.3f}", f"{similarity:.4f}"]


def quantise(way: Way, files: dict[bool, tuple[Path, Path]], out: Path, python: str) -> tuple[float, float]:
    """Run one way; seconds and peak MB.

    Raises:
        RuntimeError: it failed; what it said last.
    """
    command = [python, str(way.script), *way.before, *map(str, files[way.rewritten]), str(out), *way.after]
    paths = {**os.environ, "PYTHONPATH": str(HERE.parent)} if way.script == OURS else {**os.environ, "PYTHONPATH": ""}
    at = out.parent  # Quark drops files where it runs
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=paths, cwd=at)  # noqa: S603 - our own
    if done.returncode:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise RuntimeError(f"exit {done.returncode}: {last}")
    told = json.loads(done.stdout.strip().splitlines()[-1])
    return told["seconds"], told["peak_mb"]


def table(arguments: argparse.Namespace, folder: Path) -> Iterator[str]:
    """Line by line, as each way ends."""
    network = read_float(arguments.float or shipped_weights(arguments.variant))
    drawn = []
    for images, sensor, count, seed in (
        (arguments.images, arguments.sensor, arguments.patches, arguments.seed),
        (arguments.held_out, arguments.held_out_sensor, arguments.held_out_patches, arguments.seed + HELD_OUT_SEED),
    ):
        profile = load_sensor(sensor)
        aim = reference_for(profile)
        scenes = load_scenes(images, aim.nominal(), seed)
        drawn.append(list(draw_patches(scenes, profile, aim, count, seed).pairs))
    degraded = np.concatenate([image for image, _ in drawn[0]])
    files = {False: (folder / "plain.onnx", folder / "plain.npy"), True: (folder / "core.onnx", folder / "core.npy")}
    onnx.save(network, files[False][0])
    onnx.save(graph_to_onnx(read_planes(correction_graph(network)), [CORRECTION]), files[True][0])
    np.save(files[False][1], degraded)
    np.save(files[True][1], planes_of(degraded))
    in_float = restorer(files[False][0])
    yield "| tool | graph | MAE | std | max | std/MAE | PSNR float dB | PSNR INT8 dB | drop dB | SSIM | s | peak MB |"
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    for number, way in enumerate(ways(arguments.adaround_iterations)):
        graph = "rewritten" if way.rewritten or way.name.startswith("beers") else "plain"
        if not re.search(arguments.only, f"{way.name}, {graph}"):
            continue
        python = sys.executable if way.script == OURS else arguments.quark_python
        if python is None:
            yield f"| {way.name} | {graph} | unavailable: no --quark-python |{' |' * 9}"
            continue
        out = folder / f"{number:02d}-{way.name.replace(' ', '-')}-{graph}.onnx"
        try:
            seconds, peak_mb = quantise(way, files, out, python)
        except RuntimeError as error:
            yield f"| {way.name} | {graph} | unavailable: {error} |{' |' * 9}"
            continue
        cells = [*scores(in_float, restorer(out), drawn[1]), f"{seconds:.0f}", f"{peak_mb:.0f}"]
        yield f"| {way.name} | {graph} | {' | '.join(cells)} |"


def main() -> None:
    """Print the table; with --keep, the files stay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="convbeers-s", help="shipped weights of this name")
    parser.add_argument("--float", type=Path, help="another float network, .onnx or .safetensors")
    parser.add_argument("--images", type=Path, help="folder of scenes for calibration; drawn ones if none")
    parser.add_argument("--sensor", default="pleiades-variable", help="profile of the calibration patches")
    parser.add_argument("--held-out", type=Path, help="folder of scenes for evaluation; drawn ones if none")
    parser.add_argument("--held-out-sensor", default="pleiades-degraded", help="profile of the held-out patches")
    parser.add_argument("--patches", type=int, default=64, help="calibration patches of 128 x 128")
    parser.add_argument("--held-out-patches", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quark-python", help="interpreter of the environment that AMD Quark is installed in")
    parser.add_argument("--adaround-iterations", type=int, default=60, help="a layer; Quark's own default is 1000")
    parser.add_argument("--only", default="", help='rows whose "tool, graph" this regular expression finds')
    parser.add_argument("--keep", type=Path, help="folder for the quantised files")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.keep or Path(temporary)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for line in table(arguments, folder):
            print(line, flush=True)


if __name__ == "__main__":
    main()
