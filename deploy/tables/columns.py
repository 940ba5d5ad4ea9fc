"""The parts that all outputs of a table share: its columns, their units and modes, and missing
figures.
"""

from collections import defaultdict
from collections.abc import Sequence, Set
from dataclasses import dataclass
from itertools import chain

from beers_deploy.profiles.figures import Figure, Row

LEGEND = "measured here, predicted by a model [interval], published in a document"


@dataclass(frozen=True)
class Column:
    """A column of figures of a shown table, and what its heading can state for all rows.

    Attributes:
        name: the name of the figures, under which each row has one or none.
        unit: the unit of the figures; empty if rows have different units.
        mode: the mode of the figures that have a value, such as "measured"; empty if rows have
            different modes.
    """

    name: str
    unit: str
    mode: str

    @property
    def about(self) -> str:
        """The text for the heading: unit and mode, separated by a comma; empty without both."""
        return ", ".join(filter(None, (self.unit, self.mode)))

    def stated(self, figure: Figure) -> tuple[str, str]:
        """Return the text of a figure and its mode.

        Args:
            figure: one figure of the column.

        Returns:
            The value, with its unit unless the heading states the unit; and the mode (such as
            "measured"), empty if the heading states it.
        """
        unit = "" if self.unit else figure.unit
        return " ".join(filter(None, (str(figure), unit))), "" if self.mode else figure.mode

    def text(self, row: Row) -> str:
        """Return the text of one row's cell in this column.

        It is the value, with unit and mode unless the heading states them; "" if the row has no
        such figure, and "-" if the figure is unavailable.
        """
        figure = row.figures.get(self.name)
        if figure is None or figure.value is None:
            return "" if figure is None else "-"
        return " ".join(filter(None, self.stated(figure)))


def columns_of(rows: Sequence[Row]) -> list[Column]:
    """Return a column for each name of a figure in any row, in the order of first appearance."""
    columns = []
    for name in dict.fromkeys(chain.from_iterable(row.figures for row in rows)):
        figures = [row.figures[name] for row in rows if name in row.figures]
        units = {figure.unit for figure in figures}
        modes = {figure.mode for figure in figures if figure.value is not None}
        columns.append(Column(name, _common(units), _common(modes)))
    return columns


def _common(words: Set[str]) -> str:
    """Return the only word in a set, or "" if there are several."""
    return next(iter(words)) if len(words) == 1 else ""


def words_of(rows: Sequence[Row]) -> list[str]:
    """Return the names of the texts in any row, in the order of first appearance.

    A text is a word or sentence of a row that is no figure.
    """
    return list(dict.fromkeys(chain.from_iterable(row.text for row in rows)))


def missing(rows: Sequence[Row]) -> list[str]:
    """Explain the unavailable figures of a table, below the table.

    Args:
        rows: the rows of the table.

    Returns:
        A line for each reason: the names of the figures, the names of their rows (unless they are
        half of all rows or more), and the reason.
    """
    keys_of = defaultdict[tuple[str, str], list[str]](list)
    for row in rows:
        for key, figure in row.figures.items():
            if figure.value is None:
                keys_of[figure.reason, row.name].append(key)
    rows_of = defaultdict[tuple[str, str], list[str]](list)
    for (reason, name), keys in keys_of.items():
        rows_of[reason, ", ".join(keys)].append(name)
    lines = []
    for (reason, keys_text), names in rows_of.items():
        # If most rows lack a figure, their names are no information.
        of_rows = f" of {', '.join(names)}" if len(names) < len(rows) / 2 else ""
        lines.append(f"{keys_text}{of_rows}: {reason}")
    return lines
