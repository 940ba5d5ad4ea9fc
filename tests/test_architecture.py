"""What docs/explanation/architecture.md says of the packages, held against the code."""

import ast
from graphlib import TopologicalSorter
from itertools import chain
from pathlib import Path

from docs.make.architecture import PACKAGES, imports_of, modules
from docs.make.architecture import page as drawn

ROOT = Path(__file__).resolve().parents[1]
INSIDE: list[Path] = []
for folder in PACKAGES:
    INSIDE += sorted((ROOT / folder).rglob("__init__.py"))
"""What says what a package holds."""
MOST_MODULES = 18


def test_no_module_imports_itself_by_a_detour() -> None:
    """Imports inside functions and for types alone count too."""
    paths = modules()
    order = TopologicalSorter({name: imports_of(path, paths) for name, path in paths.items()})
    # A cycle raises CycleError, which names its modules.
    assert len(list(order.static_order())) == len(paths)


def test_packages_stay_small_enough_to_look_through_and_say_what_is_inside() -> None:
    for path in INSIDE:
        neighbours = [file for file in path.parent.glob("*.py") if file != path]
        assert len(neighbours) <= MOST_MODULES, path.parent
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


def test_the_page_names_files_that_are_there() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    mentions = {
        word
        for word in page.split("`")
        if word.startswith(tuple(f"{package}/" for package in PACKAGES))
    }
    assert len(mentions) > 40
    assert not [word for word in mentions if not (ROOT / word).exists()]


def test_the_picture_is_drawn_from_the_imports_of_today() -> None:
    """Else run python docs/make/architecture.py."""
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    assert drawn(page) == page


def listed(docstring: str) -> set[str]:
    """The modules that a list in a package's docstring is about: those before a colon, or the first
    of a clause.
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


def test_a_package_says_what_is_inside_by_names_that_are_there() -> None:
    for path in INSIDE:
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        here = {entry.stem for entry in path.parent.iterdir()}
        assert listed(docstring) <= here, (path, listed(docstring) - here)
