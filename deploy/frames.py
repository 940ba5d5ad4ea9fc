"""Rows of figures as notebooks have them: a pandas DataFrame, a plot of matplotlib, a table of
HTML.
"""

from collections.abc import Sequence
from html import escape
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
    return list(dict.fromkeys(key for row in rows for key in row.figures))


def words_of(rows: Sequence[Row]) -> list[str]:
    """The names of the plain words beside figures."""
    return list(dict.fromkeys(word for row in rows for word in row.text))


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
    frame: pd.DataFrame = pandas.DataFrame(columns, index=_index(rows), dtype=float)
    for word in (each for each in words_of(rows) if each not in columns):
        frame[word] = [row.text.get(word, "") for row in rows]
    frame.attrs["units"] = {key: figure.unit for row in rows for key, figure in row.figures.items()}
    return frame


def tidy_frame(rows: Sequence[Row]) -> "pd.DataFrame":
    """One line a figure: its table, row and name, value, unit, mode, interval and source (or why
    there is none).
    """
    pandas = optional("pandas", "to_pandas")
    lines = [
        {
            "table": row.table,
            "name": row.name,
            "figure": key,
            "value": figure.value,
            "unit": figure.unit,
            "mode": figure.mode,
            "low": figure.interval[0] if figure.interval else None,
            "high": figure.interval[1] if figure.interval else None,
            "source": figure.source or figure.reason,
        }
        for row in rows
        for key, figure in row.figures.items()
    ]
    found: pd.DataFrame = pandas.DataFrame(lines)
    return found


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
    shown = [
        (row.name, row.figures[key])
        for row in rows
        if key in row.figures and row.figures[key].value is not None
    ]
    axes: Any = ax if ax is not None else optional("matplotlib.pyplot", "plot").subplots()[1]
    for place, (_, each) in enumerate(shown):
        axes.barh(place, each.value, color=COLOURS[each.mode])
        if each.interval:
            axes.plot(each.interval, [place, place], color="black", lw=1, marker="|")
    axes.set_yticks(range(len(shown)), [name for name, _ in shown])
    axes.invert_yaxis()
    axes.set_xlabel(f"{key} ({shown[0][1].unit})" if shown else key)
    found: Axes = axes
    return found


def html_table(title: str, rows: Sequence[Row]) -> str:
    """One line a row; the mode behind a figure, its source (or why there is
    none) as its tooltip.
    """
    keys = figures_of(rows)
    words = words_of(rows)
    units = {key: figure.unit for row in rows for key, figure in row.figures.items()}
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
