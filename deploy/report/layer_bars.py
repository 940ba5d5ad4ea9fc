"""The time of each layer of a network as bars, in the network's order."""

from collections.abc import Sequence
from dataclasses import dataclass

from profiles.figures import Row, number

WIDTH, HEIGHT = 1000, 100
FILLED = 0.82
"""Share of a bar's place that it fills."""


@dataclass(frozen=True)
class Bar:
    """One layer, in units of the picture."""

    x: float
    y: float
    width: float
    height: float
    bound: str
    title: str


@dataclass(frozen=True)
class LayerBars:
    """The bars, what bounds them in the order of first appearance, and a sentence about them."""

    bars: tuple[Bar, ...]
    bounds: tuple[str, ...]
    caption: str


def layer_bars(rows: Sequence[Row]) -> LayerBars:
    """Bars of the rows that have a time and say what bounds it: a row with the sum says nothing."""
    shown = [row for row in rows if "bound" in row.text and _time(row) is not None]
    highest = max((_time(row) or 0.0 for row in shown), default=0.0) or 1.0
    step = WIDTH / max(len(shown), 1)
    bars = []
    for k, row in enumerate(shown):
        height = round(HEIGHT * (_time(row) or 0.0) / highest, 2)
        title = f"{row.name}: {_words(row)}, bound by {row.text['bound']}"
        x, width = round(step * (k + (1 - FILLED) / 2), 2), round(step * FILLED, 2)
        bars.append(Bar(x, round(HEIGHT - height, 2), width, height, row.text["bound"], title))
    return LayerBars(tuple(bars), tuple(dict.fromkeys(bar.bound for bar in bars)), _caption(shown))


def _caption(rows: Sequence[Row]) -> str:
    """The longest layer, and what bounds most of the time."""
    total = sum(_time(row) or 0.0 for row in rows)
    if not total:
        return "No layer has a time."
    longest = max(rows, key=lambda row: _time(row) or 0.0)
    shares: dict[str, float] = {}
    for row in rows:
        shares[row.text["bound"]] = shares.get(row.text["bound"], 0.0) + (_time(row) or 0.0) / total
    said = ", ".join(f"{bound} {share:.0%}" for bound, share in sorted(shares.items(), key=lambda each: -each[1]))
    unit = longest.figures["time"].unit
    return (
        f"{number(total, 3)} {unit} in all; the highest bar is {longest.name}, {_words(longest)}. "
        f"What bounds the time: {said}."
    )


def _time(row: Row) -> float | None:
    return row.figures["time"].value if "time" in row.figures else None


def _words(row: Row) -> str:
    figure = row.figures["time"]
    return f"{figure} {figure.unit}"
