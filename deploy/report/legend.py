"""The legend of a plot: which shape is which method, which filling which precision, which size which state."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from deploy.report.labels import text_width
from deploy.report.marks import FILLINGS, Filling, Mark, filling_of
from deploy.report.plot import FONT_PX, Entry, State
from profiles.figures import Row

ROW_PX, MARK_PX, GAP_PX, EDGE_PX = 22, 14, 18, 16
LETTERS = 40
STATES: dict[State, str] = {
    "front": "on the front",
    "even": "not told apart from it",
    "beaten": "beaten beyond the intervals",
}


def legend_of(rows: Sequence[Row], marks: Mapping[str, Mark], width: int, height: int) -> tuple[list[Entry], int]:
    """Entries in lines at the bottom of a canvas of that size, and the height that they take."""
    methods = dict.fromkeys(row.text.get("method", row.name) for row in rows)
    precisions = dict.fromkeys(row.text.get("precision", "") for row in rows)
    groups = [
        [Entry(0, 0, marks[method], _short(method)) for method in methods],
        [Entry(0, 0, Mark(0, 0, filling), text, inked=True) for filling, text in _fillings(precisions)],
        [Entry(0, 0, Mark(0, 0, "solid"), text, state, inked=True) for state, text in STATES.items()],
    ]
    entries = list(_flow(groups, width))
    high = round(ROW_PX + max((entry.y for entry in entries), default=0.0))
    return [replace(entry, y=entry.y + height - high + ROW_PX / 2) for entry in entries], high


def _flow(groups: Sequence[Sequence[Entry]], width: int) -> Iterator[Entry]:
    """From left to right, each group from a new line on; y from the first line's middle."""
    y = -ROW_PX
    for group in filter(None, groups):
        x, y = EDGE_PX, y + ROW_PX
        for entry in group:
            wide = round(MARK_PX + text_width(entry.text, FONT_PX))
            if x + wide > width - EDGE_PX / 2 and x > EDGE_PX:
                x, y = EDGE_PX, y + ROW_PX
            yield replace(entry, x=x, y=y)
            x += wide + GAP_PX


def _fillings(precisions: Sequence[str] | Mapping[str, None]) -> Iterator[tuple[Filling, str]]:
    """Each filling in use, with the precisions that it stands for."""
    for filling in dict.fromkeys(FILLINGS.values()):
        named = [precision for precision in precisions if precision and filling_of(precision) == filling]
        if named:
            yield filling, ", ".join(named)


def _short(text: str) -> str:
    return text if len(text) <= LETTERS else f"{text[: LETTERS - 1]}\u2026"
