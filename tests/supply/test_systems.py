"""Tests that pages and workflows name the same systems, and that no module needs one of them."""

import ast
import re
from itertools import chain
from pathlib import Path

import pytest

from tests.project_files import ROOT, text_of

PACKAGES = ("deploy", "model", "quant", "profiles")
OF_ONE_SYSTEM = {
    "fcntl",
    "grp",
    "msvcrt",
    "nt",
    "posix",
    "pty",
    "pwd",
    "resource",
    "syslog",
    "termios",
    "tty",
    "winreg",
}
TORCH = re.compile(r"pip install[^\n]*?[ '\"]torch((?:[<>=!~]=?[\d.]+,?)+)")


def pages() -> list[Path]:
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob(".github/workflows/*.yml")]


def test_every_page_installs_the_same_torch() -> None:
    versions = {page.name: TORCH.findall(page.read_text(encoding="utf-8")) for page in pages()}
    assert versions["README.md"] == versions["CONTRIBUTING.md"] == ["<2.14"]
    assert {*chain.from_iterable(versions.values())} == {"<2.14"}


def test_the_workflow_and_its_page_name_the_same_systems() -> None:
    yaml = pytest.importorskip("yaml", reason="no package yaml to read the workflow with")
    jobs = yaml.safe_load(text_of(".github/workflows/ci.yml"))["jobs"]
    pythons = [job["strategy"]["matrix"]["python"] for job in jobs.values()]
    assert pythons == [["3.11", "3.12", "3.13", "3.14"]] * 2
    assert jobs["elsewhere"]["strategy"]["matrix"]["system"] == ["macos-latest", "windows-latest"]
    page = text_of("docs/reference/systems.md")
    rows = [line.split("|") for line in page.splitlines() if "job `elsewhere`)" in line]
    assert [row[1].split(",")[0].strip() for row in rows] == ["macOS", "Windows"]
    assert {row[2].strip() for row in rows} == {f"{pythons[1][0]} to {pythons[1][-1]}"}
    assert {row[4].strip() for row in rows} == {"never"}


def bound_to_a_system(source: str) -> list[str]:
    """Return a module's imports that only some systems have, and its calls without an encoding."""
    tree = ast.parse(source)
    imports = [node for node in tree.body if isinstance(node, ast.Import)]
    imported = [alias.name for alias in chain.from_iterable(node.names for node in imports)]
    imported += [str(node.module) for node in tree.body if isinstance(node, ast.ImportFrom)]
    calls = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    ]
    without_encoding = [
        ast.unparse(call)
        for call in calls
        if isinstance(call.func, ast.Attribute) and call.func.attr in ("read_text", "write_text")
        if not any(keyword.arg == "encoding" for keyword in call.keywords)
    ]
    return [name for name in imported if name.partition(".")[0] in OF_ONE_SYSTEM] + without_encoding


def test_every_module_imports_on_every_system_and_names_its_encodings() -> None:
    modules = list(chain.from_iterable((ROOT / package).rglob("*.py") for package in PACKAGES))
    bindings = {path: bound_to_a_system(path.read_text(encoding="utf-8")) for path in modules}
    assert len(modules) > 100
    assert {path: faults for path, faults in bindings.items() if faults} == {}
