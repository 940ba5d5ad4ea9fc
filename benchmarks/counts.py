"""What makes code hard to own, counted: tokens, density, packed statements, comments, helpers with
one caller.

    python benchmarks/counts.py [--check]

Tokens are Python's own: names, operators, numbers and strings, without docstrings, comments and
line breaks; lines are all of a file's. `--check` ends with 1 where density or paired assignments
have risen above the limits below; whoever lowers them lowers the limits as well.
"""

import argparse
import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PARTS = {
    "source": ("profiles", "model", "quant", "deploy"),
    "tests": ("tests",),
    "benchmarks": ("benchmarks", "docs"),
}
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
DENSITY_LIMITS = {"source": 6.21, "tests": 8.46}
"""Tokens a line that may land."""
PAIRED_LIMITS = {"source": 44, "tests": 21}
"""Paired assignments that may land."""


class Counts(NamedTuple):
    """Of one part of the project."""

    tokens: int
    lines: int
    comments: int
    paired_assignments: int
    nested_conditionals: int
    double_comprehensions: int
    lone_helpers: int

    @property
    def density(self) -> float:
        """Tokens a line."""
        return self.tokens / self.lines


def main() -> None:
    """Print a column for each part, and check the limits."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="end with 1 where a limit is passed")
    arguments = parser.parse_args()
    counts = {name: counted(folders) for name, folders in PARTS.items()}
    print(f"| measure | {' | '.join(counts)} |")
    print(f"|---|{'---|' * len(counts)}")
    for measure, values in table(counts).items():
        print(f"| {measure} | {' | '.join(values)} |")
    passed = list(over(counts))
    for sentence in passed:
        print(sentence, file=sys.stderr)
    if arguments.check and passed:
        sys.exit(1)


def table(counts: dict[str, Counts]) -> dict[str, list[str]]:
    """Return the cells of each row."""
    columns = counts.values()
    return {
        "tokens": [f"{each.tokens:,}" for each in columns],
        "tokens a line": [f"{each.density:.2f}" for each in columns],
        "paired assignments": [f"{each.paired_assignments}" for each in columns],
        "nested conditional expressions": [f"{each.nested_conditionals}" for each in columns],
        "comprehensions of two loops": [f"{each.double_comprehensions}" for each in columns],
        "comments a hundred lines": [f"{100 * each.comments / each.lines:.1f}" for each in columns],
        "private functions with one caller": [f"{each.lone_helpers}" for each in columns],
    }


def over(counts: dict[str, Counts]) -> Iterator[str]:
    """Return a sentence for each limit that is passed."""
    for name, limit in DENSITY_LIMITS.items():
        if round(counts[name].density, 2) > limit:
            yield (
                f"{name}: {counts[name].density:.2f} tokens a line, {limit:.2f} at most: "
                "write statements out"
            )
    for name, limit in PAIRED_LIMITS.items():
        if counts[name].paired_assignments > limit:
            yield (
                f"{name}: {counts[name].paired_assignments} paired assignments, {limit} at "
                "most: one a line"
            )


def counted(folders: tuple[str, ...]) -> Counts:
    """Count all Python files below some folders of the project."""
    texts = [
        path.read_text(encoding="utf-8")
        for folder in folders
        for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    trees = [ast.parse(text) for text in texts]
    tokens, lines, comments = map(
        sum, zip(*(measured(*pair) for pair in zip(texts, trees, strict=True)), strict=True)
    )
    nodes = [node for tree in trees for node in ast.walk(tree)]
    return Counts(
        tokens=tokens,
        lines=lines,
        comments=comments,
        paired_assignments=sum(is_paired(node) for node in nodes),
        nested_conditionals=sum(is_nested_conditional(node) for node in nodes),
        double_comprehensions=sum(len(getattr(node, "generators", ())) > 1 for node in nodes),
        lone_helpers=lone_helpers(nodes),
    )


def measured(text: str, tree: ast.AST) -> tuple[int, int, int]:
    """Return tokens, lines and comments of a file."""
    strings = docstring_places(tree)
    tokens = 0
    comments = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        comments += token.type == tokenize.COMMENT
        tokens += token.type not in LAYOUT and token.start not in strings
    return tokens, text.count("\n"), comments


def docstring_places(tree: ast.AST) -> set[tuple[int, int]]:
    """Return line and column where each string begins that is a statement of its own."""
    statements = (node for node in ast.walk(tree) if isinstance(node, ast.Expr))
    strings = (node.value for node in statements if isinstance(node.value, ast.Constant))
    return {(node.lineno, node.col_offset) for node in strings if isinstance(node.value, str)}


def is_paired(node: ast.AST) -> bool:
    """Whether a statement assigns several values that are written out to several names."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    return any(isinstance(target, ast.Tuple) for target in node.targets)


def is_nested_conditional(node: ast.AST) -> bool:
    """Whether an expression with `if` has another one in it."""
    return isinstance(node, ast.IfExp) and any(
        isinstance(part, ast.IfExp) for part in ast.walk(node) if part is not node
    )


def lone_helpers(nodes: list[ast.AST]) -> int:
    """Return how many private functions are named once besides where they are defined."""
    functions = (node for node in nodes if isinstance(node, ast.FunctionDef))
    private = [
        node.name
        for node in functions
        if node.name.startswith("_") and not node.name.endswith("__")
    ]
    named = Counter(node.id for node in nodes if isinstance(node, ast.Name))
    named += Counter(node.attr for node in nodes if isinstance(node, ast.Attribute))
    return sum(named[name] == 1 for name, count in Counter(private).items() if count == 1)


if __name__ == "__main__":
    main()
