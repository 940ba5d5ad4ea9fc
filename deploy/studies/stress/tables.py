"""The tables of `stress` as Markdown: titles, what each table means, and columns that say unit and mode."""

from collections.abc import Sequence

from beers_deploy.profiles.figures import Figure, Row, by_table
from beers_deploy.results import common_mode, missing, unit_of, words_of

TITLES = {
    "battery": "Cases and stages",
    "worst": "Worst of each check",
    "limitations": "Known limitations met",
    "integer layers": "Integer layers",
    "bit flips": "Quality against bit flips",
    "guards": "What guards cost on the board",
}
NOTES = {
    "battery": "`ok`: every check holds; `limit`: only what a known limitation explains does not; `-`: not looked "
    "at, for whole numbers know no missing pixels and the others are refused before.",
    "bit flips": "PSNR, mean and range over patches and injections; one kind of memory at a time. `clamped`: ReLU6 "
    "and the limit of the correction. `all guards`: scrubbing and triple modular redundancy too, before the image; "
    "what flips in the weights after that stays for this tile.",
    "guards": "ReLU6 only where calibration stays below 96 units. Three rows are the host's time; the DPU is busy "
    "meanwhile, so nothing is lost while the host has time left.",
    "integer layers": "Intervals of whole numbers through the file's weights: true of every image.",
}


def title(table: str) -> str:
    """The title of a table's section: what is shown for its name in the document."""
    return TITLES.get(table, f"{table[:1].upper()}{table[1:]}")


def markdown(rows: Sequence[Row]) -> str:
    """A section for each table."""
    parts = []
    for table, found in by_table(rows).items():
        parts += [f"## {title(table)}\n", *([NOTES[table], ""] if table in NOTES else []), *table_lines(found), ""]
    return "\n".join(parts)


def table_lines(rows: Sequence[Row]) -> list[str]:
    """The lines of one table; unit and mode stand in its head where they are those of a whole column."""
    found = list(rows)
    keys, words = list(dict.fromkeys(key for row in found for key in row.figures)), words_of(found)
    common = {key: (unit_of(key, found), common_mode(key, found)) for key in keys}
    abouts = {key: ", ".join(filter(None, both)) for key, both in common.items()}
    lines = [_line(["", *(f"{key} ({about})" if about else key for key, about in abouts.items()), *words])]
    lines.append(_line(["---"] * (1 + len(keys) + len(words))))
    for row in found:
        figures = [_cell(row.figures.get(key), *common[key]) for key in keys]
        lines.append(_line([row.name, *figures, *(row.text.get(word, "") for word in words)]))
    reasons = missing(found)
    return [*lines, *(["", *reasons] if reasons else [])]


def _cell(figure: Figure | None, unit: str, mode: str) -> str:
    if figure is None or figure.value is None:
        return "" if figure is None else "-"
    return " ".join([str(figure), *([] if unit else [figure.unit]), *([] if mode else [figure.mode])])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
