"""Tests that names in the code are not bare participles and not names that were replaced."""

import ast
from collections.abc import Iterator
from itertools import chain

from tests.project_files import ROOT

SOURCE = ("profiles", "model", "quant", "deploy")
PARTICIPLES = {"found", "held", "kept", "looked", "lost", "made", "said", "seen", "told", "wanted"}
"""Such a name leaves out what was found or kept, so that a reader must look for the noun."""
REPLACED = {
    "Chain": "TraditionalPipeline",
    "Ends": "HostPart",
    "PEERS": "BASELINES",
    "Told": "Condition",
    "Veil": "mask",
    "characterise": "characterize",
    "crowding": "contention_exponent",
    "equivalents": "simplify",
    "fit_weights": "adaptive_rounding",
    "host_state": "load of other programs",
    "knowing": "with_sensor",
    "lattice_px": "alignment_px",
    "least_px": "min_side_px",
    "quantise": "quantize",
}
"""Names that were replaced, and their replacements."""


def names_of(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield each name that a module defines, with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield name, node.lineno
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield name, node.lineno


def unwelcome(name: str) -> bool:
    """Return True if a name is a bare participle or was replaced."""
    return name.strip("_") in PARTICIPLES or name in REPLACED


def test_no_name_is_a_bare_participle_or_one_that_was_replaced() -> None:
    files = list(chain.from_iterable((ROOT / folder).rglob("*.py") for folder in SOURCE))
    assert len(files) > 300
    bad = []
    for path in files:
        for name, line in names_of(ast.parse(path.read_text(encoding="utf-8"))):
            if unwelcome(name):
                bad.append(f"{path.relative_to(ROOT)}:{line}: {name}")
    assert bad == []


def test_such_names_are_found_wherever_they_are_defined() -> None:
    text = "def told(kept): found = kept\nclass Ends: pass\nfor seen in (): pass"
    names = {name for name, _ in names_of(ast.parse(text)) if unwelcome(name)}
    assert names == {"told", "kept", "found", "Ends", "seen"}
