"""Programs in C, compiled with every warning as an error, and run on planes."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

COMPILER = shutil.which("gcc") or shutil.which("clang") or shutil.which("cc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler: gcc, clang or cc")
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wmissing-prototypes", "-Werror"]
SANITIZERS = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
FAST = ["-O2"]
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


def run_program(
    text: str, planes: np.ndarray, shape: tuple[int, ...], folder: Path, flags: list[str]
) -> np.ndarray:
    """Compile a program and run it on planes (N, P, H, W), one after another.

    Args:
        text: of the program.
        planes: what it reads.
        shape: (N, C, H', W') of what it writes.
        folder: for the files.
        flags: of the compiler.
    """
    (folder / "network.c").write_text(text)
    (folder / "main.c").write_text(MAIN)
    sizes = [f"-DIN_SIZE={planes[0].size}", f"-DOUT_SIZE={int(np.prod(shape[1:]))}"]
    program = folder / "program"
    files = [folder / "network.c", folder / "main.c", "-o", program]
    done = subprocess.run(
        [str(COMPILER), "-std=c99", *WARNINGS, *flags, *sizes, *files],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    result = subprocess.run([program], input=planes.tobytes(), capture_output=True)
    assert result.returncode == 0, result.stderr[-3000:]
    return np.frombuffer(result.stdout, np.int8).reshape(shape)
