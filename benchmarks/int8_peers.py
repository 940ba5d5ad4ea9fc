"""Our INT8 beside onnxruntime's and AMD Quark's: the same network, calibration patches and held-out
patches, one run.

    python benchmarks/int8_peers.py --images aerial-train/ --held-out aerial-test/ \
        --quark-python quark/bin/python
    python benchmarks/int8_peers.py --float mine.onnx --data samples.npz --held-out-data others.npz

On Linux. Prints a Markdown table. Each way quantises in a process of its own; its peak memory has
the interpreter and libraries in it. Peers get the plain graph, and the one that we quantise: planes
in, the correction out, the add left to the host.

With Quark a line below the table compares our VINT8 file with its own, of the rewritten graph:
which scales of ours its adjuster moves, and whether operators, types and pairs are alike.

Quark wants other versions of its libraries, so it lives in its own environment. Without the CPU
build of torch, pip would fetch gigabytes of CUDA packages:

    python3 -m venv quark
    quark/bin/pip install torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu
    quark/bin/pip install amd-quark==0.13 onnxruntime==1.28.0
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import onnx

from beers_deploy.float_onnx import float_model as read_float
from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.model.shipped import shipped_weights
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.network import Network
from beers_deploy.profiles.sensor_file import load_sensor, reference_for
from beers_deploy.quant.calibration import HELD_OUT_SEED, draw_patches
from beers_deploy.quant.graph import CORRECTION, PLANES, graph_to_onnx, read_network, read_planes
from beers_deploy.quant.host_part import HostPart, Plain
from beers_deploy.quant.samples import Pair, samples_of
from beers_deploy.quant.session import open_session, planes_of, result_of

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
    peers = [
        Way("onnxruntime min-max", False, OURS, ("minmax",)),
        Way("onnxruntime percentile 99.99", False, OURS, ("percentile",)),
        Way("Quark VINT8", False, QUARK, (), ("vint8",)),
        Way("Quark XINT8", False, QUARK, (), ("0",)),
        Way("Quark XINT8 + AdaRound", False, QUARK, (), (str(adaround_iterations),)),
    ]
    ours = Way("beers-deploy", False, OURS, ("ours",))
    kinds = product(peers, (False, True))
    return [ours, *(replace(peer, rewritten=rewritten) for peer, rewritten in kinds)]


@dataclass(frozen=True)
class Peered:
    """A float network, and the host's part around its graph as we quantise it."""

    model: onnx.ModelProto
    host_part: HostPart

    def written(self, plain: Path, core: Path) -> None:
        """The network as it came, and its graph rewritten: planes in, the correction out."""
        onnx.save(self.model, plain)
        graph = read_planes(read_network(self.model).graph)
        onnx.save(graph_to_onnx(graph, [CORRECTION], self.host_part.planes), core)

    def runner(self, path: Path) -> Restore:
        """A file as a function of images (1, C, H, W): one that reads planes
        gets the host's part.
        """
        session = open_session(onnx.load(path))
        if session.get_inputs()[0].name != PLANES:
            return lambda image: result_of(session, image)
        return lambda image: self.host_part.finish(
            image, result_of(session, planes_of(image, self.host_part))
        )


def scores(in_float: Restore, in_int8: Restore, pairs: list[Pair]) -> list[str]:
    """The table's columns of accuracy; PSNR and SSIM are means over patches, of images with
    references alone.
    """
    differences = []
    rows = []
    for image, reference in pairs:
        both = [_as_in_a_file(run(image), image) for run in (in_float, in_int8)]
        differences.append((both[1] - both[0]).ravel())
        rows.append(_against(reference, both))
    difference = np.concatenate(differences).astype(np.float64)
    mae = float(np.abs(difference).mean())
    std = float(difference.std())
    db_float, db_int8, similarity = np.mean(rows, axis=0)
    sizes = [f"{mae:.6f}", f"{std:.6f}", f"{np.abs(difference).max():.4f}", f"{std / mae:.2f}"]
    cells = (
        f"{db_float:.2f}",
        f"{db_int8:.2f}",
        f"{db_float - db_int8:.3f}",
        f"{similarity:.4f}",
    )
    return [*sizes, *(cell.replace("nan", "") for cell in cells)]


def _as_in_a_file(result: np.ndarray, image: np.ndarray) -> np.ndarray:
    # A result with the image's channels is an image, which a file stores in [0, 1].
    return np.clip(result, 0, 1) if result.shape[1:2] == image.shape[1:2] else result


def _against(reference: np.ndarray, both: list[np.ndarray]) -> list[float]:
    if reference.shape != both[0].shape:
        return [math.nan] * 3
    similarity = [
        ssim(one, other, 1.0) for one, other in zip(both[1][0], reference[0], strict=True)
    ]
    return [*(psnr_db(result, reference, 1.0) for result in both), float(np.mean(similarity))]


def quantize_in_child(
    way: Way, files: dict[bool, tuple[Path, Path]], out: Path, python: str
) -> tuple[float, float]:
    """Run one way; seconds and peak MB.

    Raises:
        RuntimeError: it failed; what it said last.
    """
    command = [
        python,
        str(way.script),
        *way.before,
        *map(str, files[way.rewritten]),
        str(out),
        *way.after,
    ]
    paths = (
        {**os.environ, "PYTHONPATH": str(HERE.parent)}
        if way.script == OURS
        else {**os.environ, "PYTHONPATH": ""}
    )
    # Quark drops files into its working folder.
    at = out.parent
    process = subprocess.run(  # noqa: S603 - our own
        command, check=False, capture_output=True, text=True, env=paths, cwd=at
    )
    if process.returncode:
        last = (process.stderr.strip() or "no message").splitlines()[-1]
        raise RuntimeError(f"exit {process.returncode}: {last}")
    record = json.loads(process.stdout.strip().splitlines()[-1])
    return record["seconds"], record["peak_mb"]


def layout(path: Path) -> Counter[tuple[str, ...]]:
    """How often an operator reads what: of each input the operator that writes it, or the type of a
    constant.
    """
    graph = onnx.load(path).graph
    sources = {
        tensor.name: onnx.TensorProto.DataType.Name(tensor.data_type)
        for tensor in graph.initializer
    }
    for node in graph.node:
        sources |= dict.fromkeys(node.output, node.op_type)
    return Counter(
        (node.op_type, *(sources.get(name, "input") for name in node.input)) for node in graph.node
    )


def vint8_words(host: Path, theirs: Path, tile_px: int, python: str) -> str:
    """What Quark's adjuster makes of our VINT8 file, and where the layout is not that of Quark's
    own.
    """
    ours = Network.load(host).core("vek385", tile_px).save(host.with_name("vint8.onnx"))
    process = subprocess.run(  # noqa: S603
        [python, str(QUARK), "adjust", str(ours)], check=True, capture_output=True, text=True
    )
    one = layout(ours)
    other = layout(theirs)
    return (
        f"VINT8: {process.stdout.strip().splitlines()[-1]}; ours alone {[*(one - other)]}, "
        f"Quark's {[*(other - one)]}"
    )


COLUMNS = (
    *(
        "tool",
        "graph",
        "MAE",
        "std",
        "max",
        "std / MAE",
        "PSNR float dB",
        "PSNR INT8 dB",
        "drop dB",
        "SSIM",
    ),
    *("s", "peak MB"),
)


def drawn(model: onnx.ModelProto, arguments: argparse.Namespace) -> tuple[list[Pair], list[Pair]]:
    """What the network is calibrated and judged on: a user's samples where given, else simulated
    patches.
    """
    if arguments.data:
        both = (
            samples_of(model, path)
            for path in (arguments.data, arguments.held_out_data or arguments.data)
        )
        calibration, held_out = (list(samples.all.pairs) for samples in both if samples)
        return calibration, held_out
    other = arguments.seed + HELD_OUT_SEED
    return (
        _simulated(arguments.images, arguments.sensor, arguments.patches, arguments.seed),
        _simulated(
            arguments.held_out, arguments.held_out_sensor, arguments.held_out_patches, other
        ),
    )


def _simulated(images: Path | None, sensor: str, count: int, seed: int) -> list[Pair]:
    profile = load_sensor(sensor)
    aim = reference_for(profile)
    return list(
        draw_patches(load_scenes(images, aim.nominal(), seed), profile, aim, count, seed).pairs
    )


def table(arguments: argparse.Namespace, folder: Path) -> Iterator[str]:
    """Line by line, as each way ends."""
    model = read_float(arguments.float or shipped_weights(arguments.variant))
    network = Peered(model, HostPart.of(read_network(model), Plain()))
    calibration, held_out = drawn(model, arguments)
    images = np.concatenate([image for image, _ in calibration])
    files = {
        False: (folder / "plain.onnx", folder / "plain.npy"),
        True: (folder / "core.onnx", folder / "core.npy"),
    }
    network.written(files[False][0], files[True][0])
    np.save(files[False][1], images)
    np.save(files[True][1], planes_of(images, network.host_part))
    in_float = network.runner(files[False][0])
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|---" * len(COLUMNS) + "|"
    created: dict[str, Path] = {}
    for number, way in enumerate(ways(arguments.adaround_iterations)):
        graph = "rewritten" if way.rewritten or way.name.startswith("beers") else "plain"
        if not re.search(arguments.only, f"{way.name}, {graph}"):
            continue
        python = sys.executable if way.script == OURS else arguments.quark_python
        if python is None:
            yield (
                f"| {way.name} | {graph} | unavailable: no --quark-python "
                f"|{' |' * (len(COLUMNS) - 3)}"
            )
            continue
        out = folder / f"{number:02d}-{way.name.replace(' ', '-')}-{graph}.onnx"
        try:
            seconds, peak_mb = quantize_in_child(way, files, out, python)
        except RuntimeError as error:
            yield f"| {way.name} | {graph} | unavailable: {error} |{' |' * (len(COLUMNS) - 3)}"
            continue
        cells = [
            *scores(in_float, network.runner(out), held_out),
            f"{seconds:.0f}",
            f"{peak_mb:.0f}",
        ]
        yield f"| {way.name} | {graph} | {' | '.join(cells)} |"
        created[f"{way.name}, {graph}"] = out
    host = created.get("beers-deploy, rewritten")
    theirs = created.get("Quark VINT8, rewritten")
    if host and theirs:
        yield vint8_words(host, theirs, images.shape[2], arguments.quark_python)


def main() -> None:
    """Print the table; with --keep, the files stay."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variant", default="convbeers-s", help="shipped weights of this name")
    parser.add_argument("--float", type=Path, help="another float network, .onnx or .safetensors")
    parser.add_argument(
        "--data", type=Path, help="samples to calibrate on, as 'quantize --samples' takes them"
    )
    parser.add_argument(
        "--held-out-data", type=Path, help="samples to judge on; those of --data if none"
    )
    parser.add_argument(
        "--images", type=Path, help="folder of scenes for calibration; drawn ones if none"
    )
    parser.add_argument(
        "--sensor", default="pleiades-variable", help="profile of the calibration patches"
    )
    parser.add_argument(
        "--held-out", type=Path, help="folder of scenes for evaluation; drawn ones if none"
    )
    parser.add_argument(
        "--held-out-sensor", default="pleiades-degraded", help="profile of the held-out patches"
    )
    parser.add_argument("--patches", type=int, default=64, help="calibration patches of 128 x 128")
    parser.add_argument("--held-out-patches", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--quark-python", help="interpreter of the environment that AMD Quark is installed in"
    )
    parser.add_argument(
        "--adaround-iterations", type=int, default=60, help="a layer; Quark's own default is 1000"
    )
    parser.add_argument(
        "--only", default="", help='rows whose "tool, graph" this regular expression finds'
    )
    parser.add_argument("--keep", type=Path, help="folder for the quantised files")
    print_lines(table, parser.parse_args())


def print_lines(
    table: Callable[[argparse.Namespace, Path], Iterator[str]], arguments: argparse.Namespace
) -> None:
    """Print each line of a table as it comes, the files of its networks in the folder of --keep if
    there is one.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.keep or Path(temporary)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for line in table(arguments, folder):
            print(line, flush=True)


if __name__ == "__main__":
    main()
