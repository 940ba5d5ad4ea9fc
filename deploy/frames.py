"""Rows of figures as notebooks have them: a pandas DataFrame, a plot of matplotlib, a table of
HTML.
"""

from collections.abc import Sequence
from html import escape
from itertools import chain
from typing import TYPE_CHECKING, Any

from beers_deploy.profiles.errors import OptionError, optional, visible
from beers_deploy.profiles.figures import Figure, Row

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

COLOURS = {"measured": "tab:green", "predicted": "tab:orange", "published": "tab:blue"}
STYLE = "border-bottom: 1px solid; padding: 2px 8px; text-align: left"


def figures_of(rows: Sequence[Row]) -> list[str]:
    """The names of the figures that any row has, in their order."""
    return list(dict.fromkeys(chain.from_iterable(row.figures for row in rows)))


def words_of(rows: Sequence[Row]) -> list[str]:
    """The names of the plain words beside figures."""
    return list(dict.fromkeys(chain.from_iterable(row.text for row in rows)))


def _units(rows: Sequence[Row]) -> dict[str, str]:
    """Return the unit of each figure; where rows differ, that of the last one."""
    figures = chain.from_iterable(row.figures.items() for row in rows)
    return {key: figure.unit for key, figure in figures}


def _index(rows: Sequence[Row]) -> Any:
    pandas = optional("pandas", "to_pandas")
    if len({row.table for row in rows}) > 1:
        return pandas.MultiIndex.from_tuples(
            [(row.table, row.name) for row in rows], names=["table", "name"]
        )
    return pandas.Index([row.name for row in rows], name=rows[0].table if rows else "name")


def wide_frame(rows: Sequence[Row]) -> "pd.DataFrame":
    """One line a row, a column a figure and a column for each word beside them; units in
    `attrs["units"]`.
    """
    pandas = optional("pandas", "to_pandas")
    columns: dict[str, list[object]] = {}
    for key in figures_of(rows):
        columns[key] = [row.figures[key].value if key in row.figures else None for row in rows]
    # As floats, figures that are missing are NaN.
    frame: pd.DataFrame = pandas.DataFrame(columns, index=_index(rows), dtype=float)
    for word in words_of(rows):
        # A word of a figure's name would replace the figure.
        if word not in columns:
            frame[word] = [row.text.get(word, "") for row in rows]
    frame.attrs["units"] = _units(rows)
    return frame


def tidy_frame(rows: Sequence[Row]) -> "pd.DataFrame":
    """One line a figure: its table, row and name, value, unit, mode, interval and source (or why
    there is none).
    """
    pandas = optional("pandas", "to_pandas")
    lines = []
    for row in rows:
        for key, figure in row.figures.items():
            low, high = figure.interval or (None, None)
            line = {
                "table": row.table,
                "name": row.name,
                "figure": key,
                "value": figure.value,
                "unit": figure.unit,
                "mode": figure.mode,
                "low": low,
                "high": high,
                "source": figure.source or figure.reason,
            }
            lines.append(line)
    frame: pd.DataFrame = pandas.DataFrame(lines)
    return frame


def bars(rows: Sequence[Row], figure: str | None, ax: "Axes | None") -> "Axes":
    """Bars of one figure, its interval on each; see `results.Table.plot`."""
    names = figures_of(rows)
    if not names or figure not in (None, *names):
        remedy = "choose one of them"
        raise OptionError(
            "figure",
            expected=f"one of {', '.join(names) or 'none'}",
            got=repr(figure),
            remedy=remedy,
        )
    key = figure or names[0]
    entries = [
        (row.name, row.figures[key])
        for row in rows
        if key in row.figures and row.figures[key].value is not None
    ]
    axes: Any = ax if ax is not None else optional("matplotlib.pyplot", "plot").subplots()[1]
    for place, (_, entry) in enumerate(entries):
        axes.barh(place, entry.value, color=COLOURS[entry.mode])
        if entry.interval:
            axes.plot(entry.interval, [place, place], color="black", lw=1, marker="|")
    axes.set_yticks(range(len(entries)), [name for name, _ in entries])
    axes.invert_yaxis()
    axes.set_xlabel(f"{key} ({entries[0][1].unit})" if entries else key)
    result: Axes = axes
    return result


def html_table(title: str, rows: Sequence[Row]) -> str:
    """One line a row; the mode behind a figure, its source (or why there is
    none) as its tooltip.
    """
    keys = figures_of(rows)
    words = words_of(rows)
    units = _units(rows)
    head = "".join(_cell("th", f"{key} ({units[key]})" if units[key] else key) for key in keys)
    head = _cell("th", title) + head + "".join(_cell("th", word) for word in words)
    lines = [
        _cell("th", row.name)
        + "".join(_figure(row.figures.get(key)) for key in keys)
        + "".join(_cell("td", row.text.get(word, "")) for word in words)
        for row in rows
    ]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _cell(tag: str, text: str, tooltip: str = "") -> str:
    about = f' title="{escape(visible(tooltip))}"' if tooltip else ""
    return f'<{tag} style="{STYLE}"{about}>{escape(visible(text))}</{tag}>'


def _figure(figure: Figure | None) -> str:
    if figure is None:
        return _cell("td", "")
    if figure.value is None:
        return _cell("td", "unavailable", figure.reason)
    return _cell("td", f"{figure} {figure.mode}", figure.source)
