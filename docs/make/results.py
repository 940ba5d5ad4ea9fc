"""Puts the figures of an evaluation into the pages of docs/results: the tables between their
markers.

    beers-deploy evaluate --images aerial-test/ --sweep ... --json evaluation.json
    python docs/make/results.py evaluation.json 'without steps'=plain.json

A table lies between `<!-- NAME -->` and `<!-- end -->`, NAME being that of the document's table.
The heading of the table on the page says which of the document's columns are shown; what the
document does not hold stays as it is. Tables whose name begins with "mean", such as "mean, radiance
x 0.25", and "targets" have a row for each method. A document given as WORDS=FILE fills the tables
whose name is WORDS, a colon and the document's name of it.
"""

import re
import sys
from collections.abc import Iterable, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from beers_deploy.profiles.toml import read_json

PAGES = Path(__file__).parents[1] / "results"
MARKED = re.compile(r"(<!-- (?P<name>[^>]+?) -->\n)(?P<table>.*?)(<!-- end -->\n)", re.DOTALL)
DIGITS = {"dB": 2, "%": 1, "ratio": 4, "distance": 4, "of the reference": 2}
DIGITS_OF_BIAS = 2

Figure = Mapping[str, Any]
Row = Mapping[str, Any]


def main() -> None:
    """Fill each table that a document given holds, on whichever page it stands; the last document
    counts.
    """
    tables: dict[str, list[Row]] = {}
    for argument in sys.argv[1:]:
        words, _, path = argument.rpartition("=")
        prefix = f"{words}: " if words else ""
        tables |= {f"{prefix}{name}": rows for name, rows in tables_of(Path(path)).items()}
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        page.write_text(MARKED.sub(partial(filled, tables), text), encoding="utf-8", newline="")


def tables_of(path: Path) -> dict[str, list[Row]]:
    """The rows of a document, by their table."""
    document: Any = read_json(path)
    tables: dict[str, list[Row]] = {}
    for row in document["rows"]:
        tables.setdefault(row["table"], []).append(row)
    return tables


def filled(tables: Mapping[str, list[Row]], match: re.Match[str]) -> str:
    """A marked table made anew, or as it stands where the document has none of that name."""
    name = match["name"]
    if name not in tables:
        return match[0]
    columns = [cell.strip() for cell in match["table"].split("\n")[0].strip("| ").split("|")]
    kind = name.rpartition(": ")[2]
    by_method = kind.startswith("mean") or kind == "targets"
    table = mean_table(tables[name], columns) if by_method else plain_table(tables[name], columns)
    return f"{match[1]}{table}{match[4]}"


def mean_table(rows: Iterable[Row], columns: list[str]) -> str:
    """Return a table with a row for each method and the columns that the page wants, without the
    paper's rows.
    """
    ours = [row for row in rows if not row["name"].startswith("paper")]
    names = chain.from_iterable(row["figures"] for row in ours)
    titles = {key: f"{key} {unit(ours, key)}".replace(" ratio", "") for key in names}
    keys = []
    for title in columns:
        keys += [key for key in titles if titles[key] == title]
    head = ["method", "sensor", *(titles[key] for key in keys)]
    lines = []
    for row in ours:
        figures = [
            shown(row["figures"].get(key), digits=DIGITS_OF_BIAS if "bias" in key else None)
            for key in keys
        ]
        lines.append([row["name"], row["text"]["sensor"], *figures])
    return markdown(head, lines)


def plain_table(rows: list[Row], columns: list[str]) -> str:
    """A row a line, a column for each figure that the page wants; intervals of
    differences alone.
    """
    names = dict.fromkeys(chain.from_iterable(row["figures"] for row in rows))
    keys = [key for key in names if key in columns]
    differences = "gain" in rows[0]["table"] or "lost" in rows[0]["table"]
    cells = ([shown(row["figures"].get(key), differences) for key in keys] for row in rows)
    return markdown(
        ["", *keys], [[row["name"], *line] for row, line in zip(rows, cells, strict=True)]
    )


def unit(rows: Iterable[Row], key: str) -> str:
    """The unit of a figure, in the first row that has it."""
    return next((str(row["figures"][key]["unit"]) for row in rows if key in row["figures"]), "")


def shown(figure: Figure | None, interval: bool = True, digits: int | None = None) -> str:
    """A figure as the page writes it, with its interval where there is one."""
    if figure is None or figure.get("value") is None:
        return str(figure["source"]) if figure and figure.get("unit") == "" else "-"
    if digits is None:
        digits = (
            0
            if figure["unit"] == "ratio" and figure["value"] > 2
            else DIGITS.get(figure["unit"], 2)
        )
    text = f"{figure['value']:.{digits}f}"
    ends = figure.get("interval")
    return f"{text} [{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]" if ends and interval else text


def markdown(head: list[str], lines: Iterable[list[str]]) -> str:
    """A table in Markdown."""
    rule = "|".join("---" for _ in head)
    return "".join(
        f"{line}\n"
        for line in (
            f"| {' | '.join(head)} |",
            f"|{rule}|",
            *(f"| {' | '.join(x)} |" for x in lines),
        )
    )


if __name__ == "__main__":
    main()
