"""What the two steps around a network change: tables from evaluations with both, one and none of
them.

    beers-deploy evaluate --images aerial-test/ --brightness .25,.05 --methods ... --json both.json
    beers-deploy evaluate ... --no-exposure --json consistency.json
    beers-deploy evaluate ... --no-consistency --json exposure.json
    beers-deploy evaluate ... --no-consistency --no-exposure --json neither.json
    python benchmarks/steps.py neither.json consistency.json exposure.json both.json

The figures are those of the documents; nothing is measured here.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from beers_deploy.profiles.toml import read_json

SCORES = {
    "inner PSNR, reference without noise": (
        "PSNR of inner pixels against the reference without noise, dB"
    ),
    "bias of the mean": "Bias of the mean (largest of a site), %",
}
FLUX = "flux of points of "
SNR = "SNR at "
LARGEST = "largest bias of the mean"
COLUMNS = ("neither", "consistency", "exposure", "both")

Figures = Mapping[str, Mapping[str, Any]]


def main() -> None:
    """Print a table for each score, and one for each kind of target."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "documents", nargs=len(COLUMNS), type=Path, metavar="JSON", help=", ".join(COLUMNS)
    )
    documents = [figures_of(path) for path in parser.parse_args().documents]
    tables = [name for name in documents[-1] if name.startswith("mean")]
    for key, title in SCORES.items():
        lines = list[list[str]]()
        for table in tables:
            lines += score_lines(documents, table, key)
        show(title, ["network, radiance", *COLUMNS], lines)
    for start, table in ((FLUX, "targets"), (SNR, "mean")):
        names = [key for key in first(documents[-1], table) if key.startswith(start)]
        for name in names:
            lines = [
                [method, *cells(documents, table, method, name)]
                for method in common(documents, table)
            ]
            show(name, ["network", *COLUMNS], lines)


def figures_of(path: Path) -> dict[str, dict[str, Figures]]:
    """The figures of a document by table and method."""
    document: Any = read_json(path)
    tables: dict[str, dict[str, Figures]] = {}
    for row in document["rows"]:
        tables.setdefault(row["table"], {})[row["name"]] = row["figures"]
    return tables


def first(document: Mapping[str, Mapping[str, Figures]], table: str) -> Figures:
    """The figures of a table's first method."""
    return next(iter(document[table].values()))


def common(documents: Sequence[Mapping[str, Mapping[str, Figures]]], table: str) -> list[str]:
    """The networks that all documents have."""
    networks = (name for name in documents[0][table] if name.startswith("convbeers"))
    return [name for name in networks if all(name in document[table] for document in documents)]


def score_lines(
    documents: Sequence[Mapping[str, Mapping[str, Figures]]], table: str, key: str
) -> list[list[str]]:
    """A line a network: the score of each document."""
    radiance = table.partition("radiance x ")[2] or "1"
    return [
        [f"{name}, {radiance}", *cells(documents, table, name, key)]
        for name in common(documents, table)
    ]


def cells(
    documents: Sequence[Mapping[str, Mapping[str, Figures]]], table: str, method: str, key: str
) -> list[str]:
    """One figure of a method in each document."""
    return [cell(document[table][method], key) for document in documents]


def cell(figures: Figures, key: str) -> str:
    """A figure as text, a bias with the largest one of a site."""
    value = figures[key]["value"]
    if value is None:
        return "-"
    digits = 0 if key.startswith((FLUX, SNR)) else 2
    largest = f" ({figures[LARGEST]['value']:.2f})" if key.startswith("bias") else ""
    return f"{value:.{digits}f}{largest}"


def show(title: str, head: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    print(f"\n{title}\n")
    print(f"| {' | '.join(head)} |")
    print(f"|{'---|' * len(head)}")
    for line in lines:
        print(f"| {' | '.join(line)} |")


if __name__ == "__main__":
    main()
