"""Rows of figures as a pandas DataFrame, and as bars of matplotlib."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from beers_deploy.profiles.errors import OptionError, optional, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.tables.columns import columns_of, words_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

COLOURS = {"measured": "tab:green", "predicted": "tab:orange", "published": "tab:blue"}


def wide_frame(rows: Sequence[Row]) -> "pd.DataFrame":
    """Convert rows to a pandas DataFrame with a line for each row; see `results.Table.to_pandas`.

    Args:
        rows: the rows of one or several tables.

    Returns:
        A float column for each figure (NaN if unavailable) and a text column for each text.
        `attrs["units"]` is a dict from the name of a figure to its unit. The index is the name of
        the row, with the name of the table before it if there are several tables.

    Raises:
        MissingExtraError: pandas is not installed.
    """
    pandas = optional("pandas", "to_pandas")
    columns = columns_of(rows)
    values: dict[str, list[object]] = {}
    for column in columns:
        figures = [row.figures.get(column.name) for row in rows]
        values[column.name] = [figure and figure.value for figure in figures]
    index = pandas.Index([row.name for row in rows], name=rows[0].table if rows else "name")
    if len({row.table for row in rows}) > 1:
        pairs = [(row.table, row.name) for row in rows]
        index = pandas.MultiIndex.from_tuples(pairs, names=["table", "name"])
    # As floats, figures that are missing are NaN.
    frame: pd.DataFrame = pandas.DataFrame(values, index=index, dtype=float)
    for word in words_of(rows):
        # A word of a figure's name would replace the figure.
        if word not in values:
            frame[word] = [row.text.get(word, "") for row in rows]
    frame.attrs["units"] = {column.name: column.unit for column in columns}
    return frame


def tidy_frame(rows: Sequence[Row]) -> "pd.DataFrame":
    """Convert rows to a pandas DataFrame with a line for each figure; see
    `results.Table.to_pandas`.

    Returns:
        The columns table, name (of the row), figure, value, unit, mode, low and high (the interval)
        and source, or the reason if the figure is unavailable.

    Raises:
        MissingExtraError: pandas is not installed.
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
    """Draw a bar chart of one figure of the rows that have it; see `results.Table.plot`.

    Args:
        rows: the rows.
        figure: the name of the figure; None for the first one.
        ax: the matplotlib axes to draw on; None for new ones.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OptionError: the rows have no figures, or none of this name.
    """
    names = [column.name for column in columns_of(rows)]
    if not names:
        raise OptionError("The table has no figures, so there is nothing to plot.")
    if figure not in (None, *names):
        raise OptionError(
            f"`figure` must be one of {', '.join(names)}, but it is {printable(repr(figure))}."
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
