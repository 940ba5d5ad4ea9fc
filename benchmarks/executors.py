"""Compare the results of executors for INT8 files with the golden vectors, integer by integer.

    python -m benchmarks.executors int8.onnx --aidge-python aidge/bin/python --compiler gcc "zig cc"

The script prints a Markdown table: the share of the last layer's integers that differ from the
golden vectors of a DPU, in percent. Without files, it compares the shipped networks. Executors
that are not available are left out. Eclipse Aidge is installed in an environment of its own:

    python3 -m venv aidge
    aidge/bin/pip install aidge-core==0.10.1 aidge-onnx==0.10.1 aidge-backend-cpu==0.10.1
"""

import argparse
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
from onnx import TensorProto

from beers_deploy.kit.golden import PICTURE, read_golden, write_golden
from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.network import Network
from beers_deploy.quant.c_code import c_program
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import board_model
from beers_deploy.quant.graph import CORRECTION, PLANES
from beers_deploy.quant.host_part import ZERO
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.onnx.image_input import any_size, fixed_tile_px
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.quant.session import open_session, with_outputs

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
TILE_PX = 64
MAIN = """\
#include <stdint.h>
#include <stdio.h>

void run(const int8_t *in, int8_t *out);

static int8_t in[IN_SIZE], out[OUT_SIZE];

int main(void)
{
    while (fread(in, 1, IN_SIZE, stdin) == IN_SIZE) {
        run(in, out);
        fwrite(out, 1, OUT_SIZE, stdout);
    }
    return 0;
}
"""


def run_c(
    compiler: Sequence[str], text: str, planes: np.ndarray, shape: Sequence[int]
) -> np.ndarray:
    """Compile a program of `export --c`, and return its output for planes (N, P, H, W).

    Args:
        compiler: its command and flags, in addition to all warnings as errors.
        text: the source of the program.
        planes: int8.
        shape: (C, H', W') of the output for one tile.

    Raises:
        RuntimeError: the program does not compile or run, with the messages.
    """
    sizes = [f"-DIN_SIZE={planes[0].size}", f"-DOUT_SIZE={int(np.prod(shape))}"]
    with TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("network.c", "main.c", "program")]
        files[0].write_text(text)
        files[1].write_text(MAIN)
        command = [*compiler, *STRICT, *sizes, *files[:2], "-o", files[2]]
        _done(command, b"")
        result = _done([files[2]], planes.tobytes())
    return np.frombuffer(result, np.int8).reshape(len(planes), *shape)


def _done(command: Sequence[object], content: bytes) -> bytes:
    """Return the output of a command, or raise RuntimeError with its messages."""
    done = subprocess.run([*map(str, command)], input=content, capture_output=True)  # noqa: S603
    if done.returncode:
        raise RuntimeError(done.stderr.decode()[-3000:])
    return done.stdout


def run_aidge(python: Path, board: onnx.ModelProto, planes: np.ndarray) -> np.ndarray:
    """Return the result of Eclipse Aidge for a board's file, in the scale of its output.

    Raises:
        RuntimeError: Aidge does not accept the file, with its messages.
    """
    script = Path(__file__).with_name("aidge_executor.py")
    with TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("board.onnx", "planes.npy", "result.npy")]
        save_onnx(board, files[0])
        np.save(files[1], planes)
        _done([python, script, *files], b"")
        return np.asarray(np.load(files[2]))


@dataclass(frozen=True)
class Vectors:
    """The golden vectors of a network for one tile.

    Attributes:
        host: the INT8 file.
        core: its integer core.
        tile_px: side of the tile.
        planes: of all cases, (N, P, H, W) int8.
        result: of all cases, (N, C, H', W').
        images: of the cases that have one, (M, C, H, W), in the order of the first planes.
    """

    host: onnx.ModelProto
    core: IntCore
    tile_px: int
    planes: np.ndarray
    result: np.ndarray
    images: np.ndarray

    @classmethod
    def of(cls, network: Network, tile_px: int) -> "Vectors":
        """Write and read the golden vectors of a network, at its own tile size if it has one."""
        tile_px = fixed_tile_px(network.model) or tile_px
        with TemporaryDirectory() as folder:
            golden = read_golden(write_golden(network, folder, tile=tile_px))
            images = {path.parent.name: np.load(path) for path in Path(folder).glob(f"*/{PICTURE}")}
        # The odd case is of another size than the tile.
        cases = [case for case in golden.cases if case != "odd"]
        cases.sort(key=lambda case: case not in images)
        planes, result = (
            np.concatenate([golden.cases[case][name] for case in cases])
            for name in (PLANES, CORRECTION)
        )
        pictures = np.concatenate([images[case] for case in cases if case in images])
        return cls(network.model, golden.core, tile_px, planes.astype(np.int8), result, pictures)

    @property
    def board_feed(self) -> np.ndarray:
        """The planes as the board's file reads them, in float32."""
        return self.planes * np.float32(self.core.scale(PLANES))

    def integers(self, result: np.ndarray) -> np.ndarray:
        """Return a result of the board's file converted to integers."""
        return np.rint(result / self.core.scale(CORRECTION)).astype(np.int16)

    def by_c(self, compiler: Sequence[str]) -> np.ndarray:
        """Return the result of the C program."""
        text = c_program(self.core, self.tile_px, "network")
        return run_c(compiler, text, self.planes, self.result.shape[1:])

    def by_aidge(self, python: Path) -> np.ndarray:
        """Return the result of Aidge for the board's file."""
        board = board_model(self.core, {}, self.tile_px)
        return self.integers(run_aidge(python, board, self.board_feed))

    def by_onnxruntime_board(self) -> np.ndarray:
        """Return the result of onnxruntime for the board's file."""
        session = open_session(board_model(self.core, {}))
        return self.integers(session.run(None, {PLANES: self.board_feed})[0])

    def by_onnxruntime_host(self) -> np.ndarray:
        """Return the result of onnxruntime for the host's file, for the cases with an image."""
        model = with_outputs(any_size(self.host), {CORRECTION: TensorProto.UINT8})
        session = open_session(model)
        name = session.get_inputs()[0].name
        stored = [session.run([CORRECTION], {name: image[None]})[0] for image in self.images]
        return np.concatenate(stored).astype(np.int16) - ZERO

    def half_even(self) -> np.ndarray:
        """Return the result of the integer core if ties are rounded to even, as in onnxruntime."""
        return run_core(self.core, self.planes, half_even=True)[0][CORRECTION]

    def differing(self, result: np.ndarray) -> float:
        """Return the share of integers that differ from the golden ones."""
        return float((result != self.result[: len(result)]).mean())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", help="INT8 files; the shipped networks if none")
    parser.add_argument("--aidge-python", type=Path, help="Python of the environment of Aidge")
    compilers = [name for name in ("gcc", "clang") if shutil.which(name)]
    parser.add_argument("--compiler", nargs="*", default=compilers, help="C compilers")
    parser.add_argument("--tile", type=int, default=TILE_PX, help="side of the tile in pixels")
    arguments = parser.parse_args()
    columns: dict[str, Callable[[Vectors], np.ndarray]] = {}
    for compiler in arguments.compiler:
        command = [*shlex.split(compiler), "-O2"]
        columns[f"C99, {compiler}"] = partial(Vectors.by_c, compiler=command)
    if arguments.aidge_python is not None:
        columns["Aidge, board's file"] = partial(Vectors.by_aidge, python=arguments.aidge_python)
    columns["onnxruntime, board's file"] = Vectors.by_onnxruntime_board
    print(f"| network | integers | {' | '.join(columns)} |")
    print("|---" * (2 + len(columns)) + "|")
    for name in arguments.files or [f"{name}{INT8}" for name in shipped_names()]:
        network = Network.load(name, int8=True)
        vectors = Vectors.of(network, arguments.tile)
        cells = []
        for run in columns.values():
            try:
                cells.append(f"{100 * vectors.differing(run(vectors)):.2f} %")
            except RuntimeError as error:
                # The last words of the messages name the reason.
                cells.append(f"fails: {' '.join(str(error).split())[-60:]}")
        print(f"| {network.name} | {vectors.result.size} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
