"""The points of a study as CSV, complete: value, interval, unit, mode and source of every figure."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from deploy.report.provenance import figure_keys
from deploy.results import Figure, Row
from deploy.tables import unit_of, words_of
from model.files import write_text

PARTS = ("low", "high", "mode", "source")
"""Columns after that of the value; the source of an unavailable figure is the reason."""


def write_points(rows: Sequence[Row], path: Path) -> None:
    """Write a line a point: its name, its words, and five columns a figure."""
    keys, words = figure_keys(rows), words_of(list(rows))
    header = ["point", *words]
    for key in keys:
        header += [f"{key} ({unit_of(key, list(rows))})", *(f"{key} {part}" for part in PARTS)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        figures = [part for key in keys for part in _parts(row.figures.get(key))]
        writer.writerow([row.name, *(row.text.get(word, "") for word in words), *figures])
    write_text(path, text.getvalue())


def _parts(figure: Figure | None) -> list[str]:
    if figure is None:
        return [""] * (1 + len(PARTS))
    if figure.value is None:
        return ["", "", "", figure.mode, figure.reason]
    low, high = (repr(end) for end in figure.interval) if figure.interval else ("", "")
    return [repr(figure.value), low, high, figure.mode, figure.source]
