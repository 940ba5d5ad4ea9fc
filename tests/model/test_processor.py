"""Tests of the report on the processor's int8 sums, and of the processor's name."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from beers_deploy.model import processor
from beers_deploy.model.processor import decided, int8_adds_exactly, processor_name


def test_the_check_of_int8_sums_is_reported() -> None:
    int8_adds_exactly()
    assert "int8 on onnxruntime" in decided()


NOWHERE = Path("no such file")


def name_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cpuinfo: str, comm: str = "python3\n"
) -> str | None:
    (tmp_path / "comm").write_text(comm, encoding="utf-8")
    (tmp_path / "cpuinfo").write_text(cpuinfo, encoding="utf-8")
    monkeypatch.setattr(processor, "COMM", tmp_path / "comm")
    monkeypatch.setattr(processor, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    return processor_name.__wrapped__()


X86 = "".join(
    f"processor\t: {core}\nmodel name\t: Some  CPU @ 2.0GHz\nflags\t\t: a b\n\n"
    for core in range(3)
)
CORE = "processor\t: {}\nCPU implementer\t: 0x41\nCPU architecture: 8\nCPU part\t: {}\n\n"
ARM = "".join(CORE.format(core, part) for core, part in enumerate(["0xd03", "0xd03", "0xd09"]))


@pytest.mark.parametrize(
    ("cpuinfo", "name"),
    [
        (X86, "Some CPU @ 2.0GHz"),
        (ARM, "ARM part 0xd03, 0xd09"),
        ("processor : 0\nisa : rv64imafdc\n", None),
        ("", None),
        ("\x00: \n:::\n", None),
    ],
)
def test_the_name_comes_from_cpuinfo_or_is_none(
    cpuinfo: str, name: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert name_from(monkeypatch, tmp_path, cpuinfo) == name


def test_an_emulated_processor_does_not_get_the_name_of_its_host(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert name_from(monkeypatch, tmp_path, X86, comm="qemu-x86_64\n") is None


@pytest.mark.skipif(
    shutil.which("qemu-x86_64") is None or platform.machine() != "x86_64",
    reason="no qemu-x86_64 (Debian's package qemu-user) on an x86-64 machine",
)
def test_under_a_real_emulator_there_is_no_name() -> None:
    ask = "from beers_deploy.model.processor import processor_name; print(processor_name())"
    command = ["qemu-x86_64", "-cpu", "Nehalem", sys.executable, "-c", ask]
    # Kernels that the environment chooses may need more than the emulated processor has.
    plain = {key: value for key, value in os.environ.items() if not key.startswith("OPENBLAS_")}
    process = subprocess.run(command, capture_output=True, text=True, check=True, env=plain)
    assert process.stdout == "None\n"


@pytest.mark.parametrize("system", ["Linux", "Darwin", "Windows", "Java", ""])
def test_a_system_that_does_not_state_the_name_gives_none(
    system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processor, "COMM", NOWHERE)
    monkeypatch.setattr(platform, "system", lambda: system)
    assert processor_name.__wrapped__() is None or system == platform.uname().system
