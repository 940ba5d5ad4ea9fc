"""Put the figures of an evaluation into the pages of docs/results: the tables between their
markers.

    beers-deploy evaluate --images aerial-test/ --sweep ... --json evaluation.json
    python docs/make/results.py evaluation.json 'without steps'=plain.json

A table lies between `<!-- NAME -->` and `<!-- end -->`, NAME being that of the document's table.
The table on the page says what is shown: its heading the document's columns, its rows the names of
the rows (every row if it has none), and a bracket in it that figures have their intervals. What the
document does not hold stays as it is. Tables whose name begins with "mean", such as "mean, radiance
x 0.25", and "targets" have a row for each method. A document given as WORDS=FILE fills the tables
whose name is WORDS, a colon and the document's name of it.
"""

import re
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from beers_deploy.profiles.user_files.json_text import read_json

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
    """Return the rows of a document, by their table."""
    document: Any = read_json(path)
    tables: dict[str, list[Row]] = {}
    for row in document["rows"]:
        tables.setdefault(row["table"], []).append(row)
    return tables


def filled(tables: Mapping[str, list[Row]], match: re.Match[str]) -> str:
    """Return a marked table with the figures of a document, or as it is if no document has it."""
    name = match["name"]
    if name not in tables:
        return match[0]
    lines = match["table"].splitlines()
    columns, _, *old = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    names = {cells[0] for cells in old}
    kind = name.rpartition(": ")[2]
    by_method = kind.startswith("mean") or kind == "targets"
    intervals = "[" in match["table"]
    rows = [row for row in tables[name] if not names or row["name"] in names]
    keys = dict[str, str]()
    for row in rows:
        for key, figure in row["figures"].items():
            title = f"{key} {figure['unit']}".replace(" ratio", "") if by_method else key
            keys.setdefault(title, key)
    titles = [title for title in columns if title in keys]
    first = columns[:2] if "sensor" in columns else columns[:1]
    filled_lines = [[*first, *titles]]
    filled_lines.append(["---"] * len(filled_lines[0]))
    for row in rows:
        cells = [shown(row["figures"].get(keys[title]), keys[title], intervals) for title in titles]
        sensor = [row["text"]["sensor"]] if "sensor" in columns else []
        filled_lines.append([row["name"], *sensor, *cells])
    texts = (
        f"|{'|'.join(line)}|" if "---" in line else f"| {' | '.join(line)} |"
        for line in filled_lines
    )
    return "\n".join([match[1].rstrip("\n"), *texts, match[4]])


def shown(figure: Figure | None, key: str, interval: bool) -> str:
    """Return a figure as the page writes it, with its interval if asked for."""
    if figure is None or figure.get("value") is None:
        return str(figure["source"]) if figure and figure.get("unit") == "" else "-"
    digits = DIGITS.get(figure["unit"], 2)
    if "bias" in key:
        digits = DIGITS_OF_BIAS
    elif figure["unit"] == "ratio" and figure["value"] > 2:
        digits = 0
    numbers = [
        f"{number:.{digits}f}" for number in (figure["value"], *(figure.get("interval") or ()))
    ]
    if interval and len(numbers) > 1:
        return f"{numbers[0]} [{', '.join(numbers[1:])}]"
    return numbers[0]


if __name__ == "__main__":
    main()
