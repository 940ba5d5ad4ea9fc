"""docs/explanation/mutations.md is true to the code: what would be broken is there, and the tests that noticed."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from tests.stability.makers import load_maker

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "explanation" / "mutations.md"
NAMES = (
    "clamp removed",
    "float32 variance",
    "missing halo",
    "off by half a pixel",
    "wrong rounding mode",
    "bias off by one fractional bit",
    "reflect instead of zero padding",
    "global seed",
    "non-orthonormal FFT",
    "unstable inverse",
)
REPORT = """<testsuites><testsuite>
<testcase classname="tests.stability.test_a" name="test_x[1 x 1]"><failure message="AssertionError: &#10;a | b&#10;c"
/></testcase><testcase classname="tests.stability.test_a" name="test_x[2]"><failure message="assert 1 == 2"
/></testcase>
<testcase classname="tests.stability.test_a" name="test_y"><error message="ValueError: no"/></testcase>
<testcase classname="tests.stability.test_a" name="test_z"/></testsuite></testsuites>"""


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    return load_maker("mutations")


def faults(page: str, maker: ModuleType) -> list[str]:
    """What the page lacks: a mutation as it stands in the list, or a test that is named for it."""
    rows = [line for line in page.splitlines() if line.startswith("| **")]
    lacking = [] if page.startswith(maker.OPENING) else ["the opening"]
    for mutation in maker.MUTATIONS:
        row = next((line for line in rows if line.startswith(f"| {maker.described(mutation)} |")), "")
        lacking += [f"{mutation.name}: {name}" for name in mutation.tests if f"`{name}` (" not in row]
    return lacking


def gone(mutation: object, maker: ModuleType) -> list[str]:
    """The tests named for a mutation that are not there."""
    named = [name.split("::") for name in mutation.tests]  # type: ignore[attr-defined]
    files = {file: (ROOT / maker.SUITE / file).read_text(encoding="utf-8") for file, _ in named}
    return [name for file, name in named if not re.search(rf"^def {name}\(", files[file], re.MULTILINE)]


def test_all_ten_are_listed_and_each_names_a_test(maker: ModuleType) -> None:
    assert tuple(mutation.name for mutation in maker.MUTATIONS) == NAMES
    assert all(mutation.tests for mutation in maker.MUTATIONS)


@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_what_would_be_broken_stands_there_once_and_the_tests_are_there(number: int, maker: ModuleType) -> None:
    mutation = maker.MUTATIONS[number]
    sound = (ROOT / mutation.file).read_text(encoding="utf-8")
    broken = maker.broken(sound, mutation)
    compile(broken, mutation.file, "exec")
    assert 1 <= sum(a != b for a, b in zip(sound.splitlines(), broken.splitlines(), strict=True)) <= 2
    assert gone(mutation, maker) == []


def test_the_page_is_fresh(maker: ModuleType) -> None:
    assert faults(PAGE.read_text(encoding="utf-8"), maker) == []


def test_a_stale_page_and_a_stale_list_are_found(maker: ModuleType) -> None:
    page, first = PAGE.read_text(encoding="utf-8"), maker.MUTATIONS[0]
    assert faults(page.replace("without", "with").replace(first.changes[0][1], "something else"), maker)
    assert faults(page.replace(f"`{first.tests[0]}`", "none", 1), maker) == [f"{first.name}: {first.tests[0]}"]
    assert gone(replace(first, tests=["test_traps.py::test_gone"]), maker) == ["test_gone"]
    for text in ("", 2 * first.changes[0][0]):
        with pytest.raises(SystemExit, match="not once"):
            maker.broken(text, first)


def test_a_mutation_that_no_named_test_notices_survives(maker: ModuleType) -> None:
    noticed = {m.name: {name: ["assert False"] for name in m.tests} for m in maker.MUTATIONS}
    assert maker.survivors(noticed) == []
    assert maker.survivors({**noticed, "global seed": {"test_traps.py::test_gone": ["x"]}}) == ["global seed"]


def test_a_report_is_read_case_by_case(maker: ModuleType) -> None:
    found = maker.read_report(REPORT)
    assert found == {"test_a.py::test_x": ["a | b", "assert 1 == 2"], "test_a.py::test_y": ["ValueError: no"]}
    first = replace(maker.MUTATIONS[0], tests=["test_a.py::test_x"])
    assert maker.row(first, found).endswith("| `test_a.py::test_x` (2), `test_a.py::test_y` (1) | `a / b` |\n")


@pytest.mark.skipif(shutil.which("git") is None or not (ROOT / ".git").exists(), reason="git says what is copied")
def test_one_broken_copy_is_noticed(maker: ModuleType) -> None:
    """And the copy is what runs: the test that says so is among those chosen."""
    fft = maker.MUTATIONS[NAMES.index("non-orthonormal FFT")]
    with maker.repository_copy() as copy:
        found = maker.failures_of(copy, fft, "-k", "copy or (every_case and black)")
        assert list(found) == fft.tests
        assert "losses" in found[fft.tests[0]][0]
        assert (copy / fft.file).read_text(encoding="utf-8") == (ROOT / fft.file).read_text(encoding="utf-8")
