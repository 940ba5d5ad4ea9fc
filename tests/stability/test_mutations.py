"""docs/explanation/mutations.md is true to the code: what would be broken is there, and the tests that noticed."""

import re
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
