"""`.ci/emulate` fails where one processor's tests do, and says in one line why it runs none."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / ".ci" / "emulate"
TOOLS = ("bash", "cat", "dirname", "env", "mktemp", "rm", "sed", "tail")


@pytest.fixture
def tools(tmp_path: Path) -> Path:
    """The only programs that the script finds: an x86-64 Linux, neither root nor with an emulator."""
    for name in TOOLS:
        found = shutil.which(name)
        if found is None:
            pytest.skip(f"no {name} on this system")
        (tmp_path / name).symlink_to(found)
    program(tmp_path, "uname", "echo Linux x86_64")
    program(tmp_path, "id", "echo 1000")
    return tmp_path


def program(folder: Path, name: str, does: str) -> None:
    (folder / name).write_text(f"#!{shutil.which('bash')}\n{does}\n", encoding="utf-8")
    (folder / name).chmod(0o755)


def emulate(tools: Path) -> tuple[int, str]:
    """Exit code and all that is said."""
    done = subprocess.run([SCRIPT, "python"], capture_output=True, text=True, env={**os.environ, "PATH": str(tools)})
    return done.returncode, done.stdout + done.stderr


def test_who_is_not_root_is_told_what_to_install(tools: Path) -> None:
    code, said = emulate(tools)
    assert code == 0
    assert said.startswith("skipped: no qemu-x86_64, and not root")
    assert said.count("\n") == 1


@pytest.mark.parametrize("fails_at", ["update", "install"])
def test_where_nothing_can_be_installed_the_installer_s_reason_is_given(fails_at: str, tools: Path) -> None:
    program(tools, "id", "echo 0")
    program(tools, "apt-get", f'if [ "$1" = {fails_at} ]; then echo "E: no network"; exit 100; fi')
    assert emulate(tools) == (0, "skipped: no qemu-x86_64, and apt-get cannot install it: E: no network\n")


def test_another_kind_of_machine_is_told_so(tools: Path) -> None:
    program(tools, "uname", "echo Darwin arm64")
    assert emulate(tools) == (0, "skipped: qemu-user runs this Python on Linux x86_64, not on Darwin arm64\n")


def test_one_processor_that_fails_fails_all(tools: Path) -> None:
    """The emulator is called with -cpu PROCESSOR PYTHON ARGUMENTS."""
    program(tools, "qemu-x86_64", 'echo "$3 $4"; [ "$2" != Nehalem ] || [ "$4" != -m ]')
    code, said = emulate(tools)
    assert code == 1
    assert "as Haswell: passed" in said
    assert "as Nehalem: FAILED" in said
