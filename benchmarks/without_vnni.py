"""Run a command on this processor as onnxruntime would find one without VNNI, AVX-512 and AMX, at
full speed.

    python benchmarks/without_vnni.py python benchmarks/int8_kernels.py --variant convbeers-s
    python benchmarks/without_vnni.py python -m pytest tests/quant

An emulator shows that results are right, and says nothing of times. This shows both: onnxruntime
asks the processor by the instruction `cpuid`. In a copy of the library each is replaced by one that
no processor knows, and a handler of that signal answers in its place, leaving out what is newer
than AVX2. Needs Linux on x86-64, gcc and binutils.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

CPUID = b"\x0f\xa2"
UNKNOWN = b"\x0f\x0b"

HANDLER = r"""
#define _GNU_SOURCE
#include <signal.h>
#include <string.h>
#include <ucontext.h>

/* What stands after AVX2 in leaf 7: AVX-512 of all kinds, VNNI, AMX, and AVX-VNNI (256 bits). */
static const unsigned EBX0 = 1u<<16|1u<<17|1u<<21|1u<<26|1u<<27|1u<<28|1u<<30|1u<<31;
static const unsigned ECX0 = 1u<<1|1u<<6|1u<<11|1u<<12|1u<<14;
static const unsigned EDX0 = 1u<<2|1u<<3|1u<<8|1u<<22|1u<<23|1u<<24|1u<<25;
static const unsigned EAX1 = 1u<<4|1u<<5|1u<<21|1u<<23;
static const unsigned EDX1 = 1u<<4|1u<<5|1u<<10;

static void answer(int number, siginfo_t *info, void *context) {
    greg_t *r = ((ucontext_t *)context)->uc_mcontext.gregs;
    const unsigned char *code = (const unsigned char *)r[REG_RIP];
    if (code[0] != 0x0f || code[1] != 0x0b) { signal(SIGILL, SIG_DFL); return; }
    unsigned leaf = r[REG_RAX], part = r[REG_RCX], a, b, c, d;
    __asm__ volatile("cpuid" : "=a"(a), "=b"(b), "=c"(c), "=d"(d) : "a"(leaf), "c"(part));
    if (leaf == 7 && part == 0) { b &= ~EBX0; c &= ~ECX0; d &= ~EDX0; }
    if (leaf == 7 && part == 1) { a &= ~EAX1; d &= ~EDX1; }
    r[REG_RAX] = a; r[REG_RBX] = b; r[REG_RCX] = c; r[REG_RDX] = d;
    r[REG_RIP] += 2;
}

__attribute__((constructor)) static void install(void) {
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_sigaction = answer;
    action.sa_flags = SA_SIGINFO | SA_NODEFER;
    sigaction(SIGILL, &action, 0);
}
"""


def main() -> None:
    """Make the copy and the handler in a temporary folder, and run the command with them."""
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    with tempfile.TemporaryDirectory() as folder:
        handler = build_handler(Path(folder))
        site = copy_without_cpuid(Path(folder))
        paths = os.pathsep.join(
            filter(None, (str(site), str(Path.cwd()), os.environ.get("PYTHONPATH")))
        )
        environment = {**os.environ, "LD_PRELOAD": str(handler), "PYTHONPATH": paths}
        raise SystemExit(subprocess.run(sys.argv[1:], env=environment, check=False).returncode)  # noqa: S603


def build_handler(folder: Path) -> Path:
    """Compile the handler of the signal."""
    source = folder / "handler.c"
    library = folder / "handler.so"
    source.write_text(HANDLER, encoding="utf-8")
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", "-o", library, source], check=True)  # noqa: S603, S607
    return library


def copy_without_cpuid(folder: Path) -> Path:
    """A folder for PYTHONPATH with onnxruntime in it, which asks the handler."""
    origin = find_spec("onnxruntime")
    assert origin is not None and origin.origin is not None  # noqa: S101, PT018
    copied = folder / "site" / "onnxruntime"
    shutil.copytree(Path(origin.origin).parent, copied)
    (library,) = (copied / "capi").glob("onnxruntime_pybind11_state*.so")
    content = bytearray(library.read_bytes())
    for place in cpuid_places(library):
        assert content[place : place + 2] == CPUID  # noqa: S101
        content[place : place + 2] = UNKNOWN
    library.write_bytes(content)
    return copied.parent


def cpuid_places(library: Path) -> list[int]:
    """Where the instruction stands in the file, in bytes from its start."""
    code = _printed("objdump", "-d", "-j", ".text", str(library))
    section = re.search(
        r"\.text\s+PROGBITS\s+(\w+)\s+(\w+)", _printed("readelf", "-SW", str(library))
    )
    assert section is not None  # noqa: S101
    address, offset = (int(number, 16) for number in section.groups())
    return [
        int(match[1], 16) - address + offset
        for match in re.finditer(r"(\w+):\t[^\t]*\tcpuid", code)
    ]


def _printed(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout  # noqa: S603


if __name__ == "__main__":
    main()
