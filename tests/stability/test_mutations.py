"""Tests that the code and the tests named in mutations.toml exist."""

import re

import pytest

from tests.project_files import text_of
from tests.stability import mutations as maker


def test_all_ten_mutations_name_a_test() -> None:
    assert len(maker.MUTATIONS) == 10
    assert all(mutation.tests for mutation in maker.MUTATIONS)


def test_a_mutation_survives_unless_every_test_that_it_names_fails() -> None:
    mutation = next(each for each in maker.MUTATIONS if len(each.tests) == 2)
    first, second = mutation.tests
    assert maker.summary(mutation, {first: 3}).startswith("SURVIVED")
    assert maker.summary(mutation, {first: 3, second: 1}).startswith("noticed")


@pytest.mark.parametrize("mutation", maker.MUTATIONS, ids=lambda mutation: mutation.name)
def test_a_mutation_changes_one_or_two_lines_and_its_tests_exist(
    mutation: maker.Mutation,
) -> None:
    original = text_of(mutation.file)
    mutated = maker.broken(original, mutation)
    compile(mutated, mutation.file, "exec")
    assert (
        1
        <= sum(a != b for a, b in zip(original.splitlines(), mutated.splitlines(), strict=True))
        <= 2
    )
    for file, name in (test.split("::") for test in mutation.tests):
        assert re.search(rf"^def {name}\(", text_of(f"{maker.SUITE}/{file}"), re.MULTILINE)
