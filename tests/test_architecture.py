"""Tests that docs/explanation/architecture.md and the packages' docstrings agree with the code."""

import ast
from graphlib import TopologicalSorter
from itertools import chain
from pathlib import Path

from docs.make.architecture import PACKAGES, imports_of, modules
from docs.make.architecture import page as drawn
from tests.project_files import ROOT, text_of

INSIDE: list[Path] = []
for folder in PACKAGES:
    INSIDE += sorted((ROOT / folder).rglob("__init__.py"))
"""The modules whose docstrings say what a package contains."""
MOST_MODULES = 18


def test_imports_between_modules_have_no_cycle() -> None:
    """Imports inside functions and imports for types count too."""
    paths = modules()
    order = TopologicalSorter({name: imports_of(path, paths) for name, path in paths.items()})
    # A cycle raises CycleError, which names its modules.
    assert len(list(order.static_order())) == len(paths)


def test_packages_are_small_and_have_a_docstring() -> None:
    for path in INSIDE:
        neighbours = [file for file in path.parent.glob("*.py") if file != path]
        assert len(neighbours) <= MOST_MODULES, path.parent
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


def test_files_that_the_page_names_exist() -> None:
    page = text_of("docs/explanation/architecture.md")
    mentions = {
        word
        for word in page.split("`")
        if word.startswith(tuple(f"{package}/" for package in PACKAGES))
    }
    assert len(mentions) > 40
    assert not [word for word in mentions if not (ROOT / word).exists()]


def test_the_drawing_agrees_with_the_imports() -> None:
    """If this fails, run python docs/make/architecture.py."""
    page = text_of("docs/explanation/architecture.md")
    assert drawn(page) == page


def listed(docstring: str) -> set[str]:
    """Return the modules that the list in a package's docstring describes.

    They are the names before a colon, or the first name of a clause.
    """
    clauses = list[str]()
    for line in docstring.splitlines():
        if line.startswith("- "):
            clauses += line[2:].split("; ")
    quoted = [clause.split(": ")[0].split("`")[1::2] for clause in clauses]
    about = [
        words if ": " in clause else words[:1]
        for clause, words in zip(clauses, quoted, strict=True)
    ]
    return {word for word in chain.from_iterable(about) if word.isidentifier()}


def test_modules_that_a_package_docstring_lists_exist() -> None:
    for path in INSIDE:
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        here = {entry.stem for entry in path.parent.iterdir()}
        assert listed(docstring) <= here, (path, listed(docstring) - here)
