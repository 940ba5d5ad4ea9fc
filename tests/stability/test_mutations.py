"""docs/explanation/mutations.md is true to the code: what would be broken is there, and the tests
that noticed.
"""

import re
from pathlib import Path

import pytest

from docs.make import mutations as maker

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_fresh_and_all_ten_name_a_test() -> None:
    page = maker.TARGET.read_text(encoding="utf-8")
    assert page.startswith(maker.OPENING)
    assert len(maker.MUTATIONS) == 10
    for mutation in maker.MUTATIONS:
        (row,) = (
            line
            for line in page.splitlines()
            if line.startswith(f"| {maker.described(mutation)} |")
        )
        assert mutation.tests
        assert [name for name in mutation.tests if f"`{name}` (" not in row] == [], mutation.name


@pytest.mark.parametrize("mutation", maker.MUTATIONS, ids=lambda mutation: mutation.name)
def test_what_would_be_broken_stands_there_once_and_the_tests_are_there(
    mutation: maker.Mutation,
) -> None:
    original = (ROOT / mutation.file).read_text(encoding="utf-8")
    mutated = maker.broken(original, mutation)
    compile(mutated, mutation.file, "exec")
    assert (
        1
        <= sum(a != b for a, b in zip(original.splitlines(), mutated.splitlines(), strict=True))
        <= 2
    )
    for file, name in (test.split("::") for test in mutation.tests):
        assert re.search(
            rf"^def {name}\(", (ROOT / maker.SUITE / file).read_text(encoding="utf-8"), re.MULTILINE
        )
