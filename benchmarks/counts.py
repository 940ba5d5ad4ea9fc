"""What makes code hard to own, counted: tokens, density, packed statements, comments, helpers with
one caller, and how often an option is described.

    python benchmarks/counts.py [--check]

Tokens are Python's own: names, operators, numbers and strings, without docstrings, comments and
line breaks; lines are all of a file's. `--check` ends with 1 where density or paired assignments
have risen above the limits below; whoever lowers them lowers the limits as well.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from itertools import chain
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
DENSITY_LIMITS = {"source": 6.11, "tests": 8.41}
"""Tokens a line that may land."""
PAIRED_LIMITS = {"source": 1, "tests": 1}
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
    print(f"\ndescriptions of an option, in the mean: {descriptions_an_option():.1f}")
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
    paths = list[Path]()
    for folder in folders:
        paths += sorted((ROOT / folder).rglob("*.py"))
    texts = [path.read_text(encoding="utf-8") for path in paths]
    trees = [ast.parse(text) for text in texts]
    tokens, lines, comments = map(
        sum, zip(*(measured(*pair) for pair in zip(texts, trees, strict=True)), strict=True)
    )
    nodes = list(chain.from_iterable(map(ast.walk, trees)))
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
    mentions = Counter(node.id for node in nodes if isinstance(node, ast.Name))
    mentions += Counter(node.attr for node in nodes if isinstance(node, ast.Attribute))
    return sum(mentions[name] == 1 for name, count in Counter(private).items() if count == 1)


def descriptions_an_option() -> float:
    """Return how often a parameter of a verb is described, in the mean.

    Counted are the lines of `Args:` in the docstrings of verbs, and of other functions that have
    their names.
    """
    functions = functions_of(nodes_below(ROOT / "deploy"))
    options = {function.name: options_of(function) for function in functions if is_verb(function)}
    descriptions = 0
    for function in functions:
        named = re.findall(r"^ +(\w+): ", ast.get_docstring(function) or "", re.MULTILINE)
        descriptions += len(set(named) & options.get(function.name, set()))
    return descriptions / sum(map(len, options.values()))


def is_verb(function: ast.FunctionDef) -> bool:
    """Return True if a function is decorated as a verb."""
    return "verb" in map(ast.unparse, function.decorator_list)


def options_of(verb: ast.FunctionDef) -> set[str]:
    """Return the names of the parameters of a verb."""
    return {each.arg for each in (*verb.args.args, *verb.args.kwonlyargs)}


def nodes_below(folder: Path) -> list[ast.AST]:
    """Return every node of the Python files below a folder."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in sorted(folder.rglob("*.py"))]
    return list(chain.from_iterable(map(ast.walk, trees)))


def functions_of(nodes: list[ast.AST]) -> list[ast.FunctionDef]:
    """Return the functions among some nodes."""
    return [node for node in nodes if isinstance(node, ast.FunctionDef)]


if __name__ == "__main__":
    main()
