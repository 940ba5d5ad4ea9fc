"""The tables of `stress` as Markdown: titles, what each table means, and columns that say unit and mode."""

from collections.abc import Sequence

from profiles.figures import Figure, Row, by_table

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
    """The lines of one table."""
    keys = list(dict.fromkeys(key for row in rows for key in row.figures))
    words = list(dict.fromkeys(word for row in rows for word in row.text))
    lines = [_line(["", *(_head(key, rows) for key in keys), *words]), _line(["---"] * (1 + len(keys) + len(words)))]
    for row in rows:
        figures = [_cell(row.figures.get(key), alike=len(_kinds(key, rows)) == 1) for key in keys]
        lines.append(_line([row.name, *figures, *(row.text.get(word, "") for word in words)]))
    return lines


def _kinds(key: str, rows: Sequence[Row]) -> set[str]:
    """Unit and mode of a column's figures; a bound that is proven says so."""
    return {_kind(row.figures[key]) for row in rows if key in row.figures}


def _kind(figure: Figure) -> str:
    mode = "proven" if figure.source.startswith("proven") else figure.mode
    return f"{figure.unit}, {mode}"


def _head(key: str, rows: Sequence[Row]) -> str:
    kinds = _kinds(key, rows)
    return f"{key} ({kinds.pop()})" if len(kinds) == 1 else key


def _cell(figure: Figure | None, alike: bool) -> str:
    if figure is None:
        return ""
    if figure.value is None:
        return f"unavailable: {figure.reason}"
    size = abs(figure.value)
    digits = f"{figure.value:.3g}" if size >= 1e6 or 0 < size < 1e-3 else str(figure)
    return digits if alike else f"{digits} {_kind(figure)}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
