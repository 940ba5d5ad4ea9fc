"""What all outputs of a table share: its columns, their units and modes, and missing figures."""

from collections.abc import Sequence
from itertools import chain

from beers_deploy.profiles.figures import Figure, Row

LEGEND = "measured here, predicted by a model [interval], published in a document"


def figures_of(rows: Sequence[Row]) -> list[str]:
    """Return the names of the figures that any row has, in their order."""
    return list(dict.fromkeys(chain.from_iterable(row.figures for row in rows)))


def words_of(rows: Sequence[Row]) -> list[str]:
    """Return the names of the words that any row has, in their order."""
    return list(dict.fromkeys(chain.from_iterable(row.text for row in rows)))


def unit_of(key: str, rows: Sequence[Row]) -> str:
    """Return the unit of a column, or nothing if its figures have different units."""
    units = {row.figures[key].unit for row in rows if key in row.figures}
    return units.pop() if len(units) == 1 else ""


def common_mode(key: str, rows: Sequence[Row]) -> str:
    """Return the mode of the figures of a column, or nothing if they differ or none is there."""
    figures = [row.figures[key] for row in rows if key in row.figures]
    modes = {figure.mode for figure in figures if figure.value is not None}
    return modes.pop() if len(modes) == 1 else ""


def heading_of(key: str, rows: Sequence[Row]) -> str:
    """Return the unit and the mode that a column's heading states, separated by a comma."""
    return ", ".join(filter(None, (unit_of(key, rows), common_mode(key, rows))))


def cell_text(figure: Figure | None, *, unit: bool, mode: bool) -> str:
    """Return a figure as text.

    Args:
        figure: None is an empty cell, a missing value a dash.
        unit: whether the unit follows, because the heading does not state it.
        mode: whether the mode follows.
    """
    if figure is None:
        return ""
    if figure.value is None:
        return "-"
    words = [str(figure)]
    if unit:
        words.append(figure.unit)
    if mode:
        words.append(figure.mode)
    return " ".join(words)


def missing(rows: Sequence[Row]) -> list[str]:
    """Return a line for each reason why figures are missing: which ones, of which rows."""
    keys_of: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for key, figure in row.figures.items():
            if figure.value is None:
                keys_of.setdefault((figure.reason, row.name), []).append(key)
    rows_of: dict[tuple[str, str], list[str]] = {}
    for (reason, name), keys in keys_of.items():
        rows_of.setdefault((reason, ", ".join(keys)), []).append(name)
    lines = []
    for (reason, keys_text), names in rows_of.items():
        # Where most rows lack a figure, their names say nothing.
        of_rows = f" of {', '.join(names)}" if len(names) < len(rows) / 2 else ""
        lines.append(f"{keys_text}{of_rows}: {reason}")
    return lines
