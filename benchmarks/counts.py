"""Count what makes code hard to maintain: tokens, density, packed statements, comments, and helpers
with one caller.

    python benchmarks/counts.py [--check]

Tokens are Python's own (names, operators, numbers and strings), without docstrings, comments and
line breaks. Lines are all lines of a file. `--check` exits with 1 if the density exceeds its limit
or a statement is packed. Whoever lowers the density lowers its limit as well.
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
DENSITY_LIMITS = {"source": 5.2, "tests": 8.0}
"""The maximum number of tokens per line."""
PACKED = {
    "paired_assignments": "paired assignments: one a line",
    "nested_conditionals": "nested conditional expressions: write an if statement",
    "double_comprehensions": "comprehensions of two loops: write one loop out",
}
"""Code that no file may contain, by the field of Counts, and the remedy."""


class Counts(NamedTuple):
    """Sums over one part of the project."""

    tokens: int
    lines: int
    comments: int
    paired_assignments: int
    nested_conditionals: int
    double_comprehensions: int
    lone_helpers: int

    @property
    def density(self) -> float:
        """The number of tokens per line."""
        return self.tokens / self.lines


def main() -> None:
    """Print one column for each part, and check the limits."""
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
    sentences = list(over(counts))
    for sentence in sentences:
        print(sentence, file=sys.stderr)
    if arguments.check and sentences:
        sys.exit(1)


def table(counts: dict[str, Counts]) -> dict[str, list[str]]:
    """Return the cells of each row."""
    columns = counts.values()
    return {
        "tokens": [f"{part.tokens:,}" for part in columns],
        "tokens a line": [f"{part.density:.2f}" for part in columns],
        "paired assignments": [f"{part.paired_assignments}" for part in columns],
        "nested conditional expressions": [f"{part.nested_conditionals}" for part in columns],
        "comprehensions of two loops": [f"{part.double_comprehensions}" for part in columns],
        "comments a hundred lines": [f"{100 * part.comments / part.lines:.1f}" for part in columns],
        "private functions with one caller": [f"{part.lone_helpers}" for part in columns],
    }


def over(counts: dict[str, Counts]) -> Iterator[str]:
    """Yield a sentence for each limit that is exceeded."""
    for name, limit in DENSITY_LIMITS.items():
        density = round(counts[name].density, 2)
        if density > limit:
            yield f"{name}: {density} tokens a line, {limit:.2f} at most: write statements out"
    for name, count in counts.items():
        for field, sentence in PACKED.items():
            number = getattr(count, field)
            if number:
                yield f"{name}: {number} {sentence}"


def counted(folders: tuple[str, ...]) -> Counts:
    """Count all Python files below the given folders of the project."""
    nodes = list[ast.AST]()
    totals = Counter[str]()
    for folder in folders:
        for path in (ROOT / folder).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            tree = ast.parse(text)
            nodes += ast.walk(tree)
            totals += measured(text, tree)
    return Counts(
        **totals,
        paired_assignments=sum(map(is_paired, nodes)),
        nested_conditionals=sum(map(is_nested_conditional, nodes)),
        double_comprehensions=sum(len(getattr(node, "generators", ())) > 1 for node in nodes),
        lone_helpers=lone_helpers(nodes),
    )


def measured(text: str, tree: ast.AST) -> Counter[str]:
    """Return tokens, lines and comments of a file."""
    strings = docstring_places(tree)
    totals = Counter(lines=text.count("\n"), comments=0, tokens=0)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        totals["comments"] += token.type == tokenize.COMMENT
        totals["tokens"] += token.type not in LAYOUT and token.start not in strings
    return totals


def docstring_places(tree: ast.AST) -> set[tuple[int, int]]:
    """Return the line and column of each string that is a statement by itself."""
    statements = (node for node in ast.walk(tree) if isinstance(node, ast.Expr))
    strings = (node.value for node in statements if isinstance(node.value, ast.Constant))
    return {(node.lineno, node.col_offset) for node in strings if isinstance(node.value, str)}


def is_paired(node: ast.AST) -> bool:
    """Return True if a statement assigns several written-out values to several names."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    return any(isinstance(target, ast.Tuple) for target in node.targets)


def is_nested_conditional(node: ast.AST) -> bool:
    """Return True if a conditional expression contains another one."""
    return isinstance(node, ast.IfExp) and any(
        isinstance(part, ast.IfExp) for part in ast.walk(node) if part is not node
    )


def lone_helpers(nodes: list[ast.AST]) -> int:
    """Return the number of private functions whose name occurs only once outside their
    definition.
    """
    functions = (node.name for node in nodes if isinstance(node, ast.FunctionDef))
    private = Counter(name for name in functions if name.startswith("_") and name[-2:] != "__")
    mentions = Counter(node.id for node in nodes if isinstance(node, ast.Name))
    mentions += Counter(node.attr for node in nodes if isinstance(node, ast.Attribute))
    return sum(mentions[name] == 1 for name, count in private.items() if count == 1)


if __name__ == "__main__":
    main()
