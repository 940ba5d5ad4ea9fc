"""Tests that the examples in the library's docstrings and the cell of the README run."""

import doctest
import re

import numpy as np
import pytest

import beers_deploy as bd
from tests.deploy.studies.tradeoff.small import small_studies
from tests.project_files import text_of

pytestmark = pytest.mark.slow

WITHOUT_EXAMPLE = {"demo", "export", "golden", "stress", "train"}
"""Verbs that write folders or run for minutes. Their commands in the pages are run instead."""


@pytest.mark.parametrize("name", vars(bd)["__all__"])
@pytest.mark.usefixtures("working_folder")
def test_the_example_prints_what_it_shows(name: str) -> None:
    parser = doctest.DocTestParser()
    text = getattr(bd, name).__doc__
    example = parser.get_doctest(text, {"bd": bd, "np": np}, name, None, None)
    assert bool(example.examples) == (name not in WITHOUT_EXAMPLE)
    with small_studies():
        assert doctest.DocTestRunner().run(example).failed == 0


def test_the_cell_of_the_readme_runs() -> None:
    (cell,) = re.findall(r"```python\n(.*?)```", text_of("README.md"), re.DOTALL)
    exec(cell, {})  # noqa: S102 - our own page
