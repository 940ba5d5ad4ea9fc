"""The same pixels on 64-bit ARM: `restore` and the integer tests, here and under `qemu-aarch64`.

    python benchmarks/arm.py ROOT [--json FILE]

As root on Debian with debootstrap and qemu-user (apt-get install debootstrap qemu-user). ROOT
becomes a small ARM system, 0.5 GB: bookworm's Python, and the packages of the versions here from
their own wheels. It is kept, and what is there already is not made again. Nothing is changed
outside of it. docs/explanation/processors.md says what came out.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from importlib.metadata import version
from itertools import product
from pathlib import Path

import numpy as np

from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network

PROJECT = Path(__file__).resolve().parents[1]
PROCESSORS = ("cortex-a72", "neoverse-n1", "max")
"""Of `qemu-aarch64 -cpu help`: NEON alone; dot products of int8 too; matrix
products of int8 too.
"""
NETWORKS = ("convbeers-xs", "convbeers-s")
PINNED = ("numpy", "onnx", "onnxruntime", "pillow", "psutil", "tifffile")
OTHERS = (
    "docstring-parser",
    "filelock",
    "hypothesis",
    "jinja2",
    "jsonschema",
    "pytest",
    "rich",
    "typer",
)
PLATFORMS = [
    f"{name}_aarch64"
    for name in ("manylinux_2_28", "manylinux_2_27", "manylinux_2_26", "manylinux2014")
]
TESTS = ("test_integers.py", "test_restore.py")
"""Of tests/processors: what needs no torch, whose ARM wheel alone has 0.5 GB."""
CPUINFO = """processor\t: 0
BogoMIPS\t: 100.00
Features\t: fp asimd aes pmull sha1 sha2 crc32 cpuid
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x0
CPU part\t: 0xd08
CPU revision\t: 3

"""
"""A Cortex-A72's.

An emulated process would see the x86 host's, on which onnxruntime's ARM build crashes.
"""


def build(root: Path) -> None:
    """Make the ARM system: Debian's packages unpacked, never run, so that no kernel support is
    asked for.
    """
    if not (root / "usr/bin/python3.11").exists():
        packages = ["--variant=minbase", "--include=python3,libstdc++6", "bookworm", str(root)]
        _call(["debootstrap", "--foreign", "--arch=arm64", *packages])
        # Packages are unpacked and never run, so that no kernel support is needed.
        for package in sorted((root / "var/cache/apt/archives").glob("*.deb")):
            with subprocess.Popen(  # noqa: S603
                ["dpkg-deb", "--fsys-tarfile", package],  # noqa: S607
                stdout=subprocess.PIPE,
            ) as unpacked:
                _call(
                    ["tar", "-x", "-C", str(root), "--keep-directory-symlink"],
                    stdin=unpacked.stdout,
                )
    if not _site(root).exists():
        names = [*(f"{name}=={version(name)}" for name in PINNED), *OTHERS]
        platforms = [f"--platform={name}" for name in PLATFORMS]
        options = [
            "--only-binary=:all:",
            "--python-version",
            "3.11",
            "--target",
            str(_site(root)),
            *platforms,
        ]
        _call([sys.executable, "-m", "pip", "install", "--quiet", *options, *names])
    project = ["--no-deps", "--upgrade", "--target", str(_site(root)), str(PROJECT)]
    _call([sys.executable, "-m", "pip", "install", "--quiet", *project])
    proc = root / "proc"
    # Where debootstrap cannot mount /proc, it leaves a link to the host's.
    if proc.is_symlink():
        proc.unlink()
    proc.mkdir(exist_ok=True)
    # An emulated process would see the x86 host's processor, on which onnxruntime's ARM build
    # crashes.
    (proc / "cpuinfo").write_text(CPUINFO, encoding="utf-8")


def on_arm(root: Path, processor: str, *arguments: str) -> None:
    """Run the ARM system's Python with the project, one thread, as that processor."""
    emulator = [
        "qemu-aarch64",
        "-cpu",
        processor,
        "-L",
        str(root),
        str(root / "usr/bin/python3.11"),
    ]
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("OPENBLAS_")
    }
    environment |= {
        "PYTHONPATH": f"{_site(root)}:{PROJECT}",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    _call([*emulator, *arguments], env=environment, cwd=PROJECT)


def restored(networks: list[Path], out: Path) -> None:
    """Write what `restore` makes of one image with each network, float32 of full scale 4095, by its
    file's name.
    """
    from beers_deploy.verbs.restore import restore

    generator = np.random.default_rng(4)
    y, x = np.mgrid[:83, :131]
    dn = 2048 + 1500 * np.sin(y / 9) * np.cos(x / 7) + generator.normal(0, 600, y.shape) * (x > 65)
    image = np.rint(np.clip(dn, 0, 4095)).astype(np.float32)
    pixels = {path.stem: restore(image, network=path, tile=64, threads=1) for path in networks}
    np.savez(out, **pixels)


def compare(root: Path, processors: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """The largest difference in DN from this processor's pixels, by emulated
    processor and network.
    """
    with tempfile.TemporaryDirectory() as folder:
        networks = [
            Network.load(name, sensor=SENSOR, int8=int8)
            for name, int8 in product(NETWORKS, (False, True))
        ]
        files = [network.save(Path(folder) / f"{network.name}.onnx") for network in networks]
        here = Path(folder) / "here.npz"
        restored(files, here)
        expected = dict(np.load(here))
        differences = {}
        for processor in processors:
            out = Path(folder) / f"{processor}.npz"
            on_arm(root, processor, __file__, "--restore", str(out), *map(str, files))
            pixels = np.load(out)
            differences[processor] = {
                name: float(np.abs(pixels[name] - expected[name]).max()) for name in expected
            }
    return differences


def _site(root: Path) -> Path:
    return root / "opt/packages"


def _call(command: list[str], **how: object) -> None:
    subprocess.run(command, check=True, **how)  # type: ignore[call-overload]  # noqa: S603 - our own commands


def main() -> None:
    """Build, compare, test; exit code 1 where an INT8 pixel differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, nargs="?")
    parser.add_argument("--processors", nargs="+", default=PROCESSORS)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--restore", nargs="+", type=Path, metavar=("OUT", "NETWORK"), help=argparse.SUPPRESS
    )
    arguments = parser.parse_args()
    if arguments.restore:
        restored(arguments.restore[1:], arguments.restore[0])
        return
    root = arguments.root.resolve()
    build(root)
    by_processor = compare(root, tuple(arguments.processors))
    for processor, differences in by_processor.items():
        print(
            processor,
            ", ".join(f"{name}: {value:.3g} DN apart" for name, value in differences.items()),
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(by_processor, indent=2) + "\n", encoding="utf-8")
    tests = [f"tests/processors/{name}" for name in TESTS]
    for processor in arguments.processors:
        print(f"integer tests as {processor}", flush=True)
        on_arm(root, processor, "-m", "pytest", "-p", "no:cacheprovider", *tests)
    for differences in by_processor.values():
        if any(value for name, value in differences.items() if name.endswith("int8")):
            sys.exit(1)


if __name__ == "__main__":
    main()
