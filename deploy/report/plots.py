"""Plots by matplotlib in one style, as SVG files that follow the reader's light or dark mode.

Figures are drawn in the colours LIGHT and measured in pixels, 72 per inch, so that matplotlib's
points are pixels too. In the SVG each colour becomes a variable that a style sheet sets for light
and for dark screens.
"""

import base64
import io
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np
from markupsafe import Markup

from beers_deploy.profiles.errors import visible
from beers_deploy.profiles.figures import number
from beers_deploy.profiles.instrument import MAX_DN

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

    from beers_deploy.quant.gate import Spread

PX_PER_INCH = 72
FONT_PX = 13
TITLE_PX = 15

LIGHT = {
    "ink": "#1b1f24",
    "soft": "#5b6470",
    "line": "#d5dae0",
    "page": "#ffffff",
    "mark0": "#0072b2",
    "mark1": "#d55e00",
    "mark2": "#008a64",
    "mark3": "#b4558d",
    "mark4": "#a87000",
}
"""Colours by purpose. Those of the marks are Okabe and Ito's, darkened where they would be too
faint on white.
"""

DARK = {
    "ink": "#e7eaee",
    "soft": "#9aa4b0",
    "line": "#39414b",
    "page": "#14171b",
    "mark0": "#56b4e9",
    "mark1": "#e8711a",
    "mark2": "#1fb88a",
    "mark3": "#cc79a7",
    "mark4": "#e69f00",
}
SERIES = ("mark0", "mark1", "mark2", "mark3", "mark4", "ink")
"""The colours assigned to series of points, in turn."""

LOOK = {
    "svg.fonttype": "none",
    # Ids are derived from the content, so that the same figure gives the same bytes.
    "svg.hashsalt": "beers-deploy",
    "text.parse_math": False,  # a dollar in a file's name is a dollar
    "font.size": FONT_PX,
    "text.color": LIGHT["ink"],
    "figure.facecolor": LIGHT["page"],
    "axes.facecolor": "none",
    "axes.labelcolor": LIGHT["soft"],
    "axes.titlelocation": "left",
    "axes.titlesize": TITLE_PX,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": LIGHT["line"],
    "grid.linewidth": 1,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **{f"{axis}.labelcolor": LIGHT["soft"] for axis in ("xtick", "ytick")},
    **{f"xtick.{side}": False for side in ("bottom", "top")},
    **{f"ytick.{side}": False for side in ("left", "right")},
    "legend.frameon": False,
    "legend.borderpad": 0,
    "legend.borderaxespad": 0,
    "legend.handletextpad": 0.4,
    "legend.columnspacing": 1.4,
}


@contextmanager
def look() -> Iterator[None]:
    """Use the style of this package's plots for all that matplotlib draws and saves within the
    `with` block, whatever style the user has set.
    """
    from matplotlib import style

    # The user's own style must not change our plots.
    with warnings.catch_warnings(), style.context(["default", LOOK]):
        # A letter that the font lacks is a box in a PNG. For an SVG the browser uses its own font.
        warnings.filterwarnings("ignore", "(?s)Glyph .* missing", UserWarning)
        yield


def new_figure(width_px: float, height_px: float) -> "Figure":
    """Return an empty matplotlib figure of a size in pixels. Call it within `look`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_px / PX_PER_INCH, height_px / PX_PER_INCH), dpi=PX_PER_INCH)


SUBDIVISIONS = ((1.0, 1.5, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0, 3.0), (1.0,))
LEAST_TICKS = 3


def set_ticks(axis: "Axis", most: int) -> None:
    """Replace the ticks of an axis by at most `most` labelled ones at round values.

    Args:
        axis: the x or y axis of a matplotlib plot, after its limits and scale are set.
        most: the largest number of ticks.
    """
    low, high = sorted(axis.get_view_interval())
    values = round_values(low, high, most, logarithmic=axis.get_scale() == "log")
    axis.set_ticks(values, labels=[number(value, 12) for value in values])
    axis.set_ticks([], minor=True)


def round_values(low: float, high: float, most: int, *, logarithmic: bool) -> list[float]:
    """Choose round values for the ticks of an axis.

    Args:
        low: the lower limit of the axis.
        high: the upper limit of the axis.
        most: the largest number of values.
        logarithmic: True for a logarithmic axis. If its limits are too close for round values of a
            logarithmic scale, the values are evenly spaced.
    """
    from matplotlib.ticker import LogLocator, MaxNLocator

    logs = (
        [LogLocator(subs=subs, numticks=most + 2) for subs in SUBDIVISIONS] if logarithmic else []
    )
    evens = [
        MaxNLocator(count, steps=[1, 2, 5, 10], min_n_ticks=1) for count in range(most + 1, 0, -1)
    ]
    for locator in (*logs, *evens):
        values = [
            float(f"{value:.12g}")
            for value in locator.tick_values(low, high)
            if low <= value <= high
        ]
        # A logarithmic locator may find no round value between close limits: then ticks are evenly
        # spaced.
        if (LEAST_TICKS if locator in logs else 1) <= len(values) <= most:
            break
    return values


SVG = "http://www.w3.org/2000/svg"
XLINK = "http://www.w3.org/1999/xlink"


def svg_of(figure: "Figure", name: str) -> Markup:
    """Convert a matplotlib figure to SVG text that follows the reader's light or dark mode.

    Args:
        figure: the figure, drawn within `look` in colours of LIGHT.
        name: the label of the picture for screen readers.
    """
    stream = io.BytesIO()
    with look():
        figure.savefig(
            stream, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    ET.register_namespace("", SVG)
    ET.register_namespace("xlink", XLINK)
    text = re.sub(r' transform="rotate\(-0 [^"]*"', "", visible(stream.getvalue().decode()))
    for key, colour in LIGHT.items():
        text = text.replace(colour, f"var(--{key})")
    root = ET.fromstring(text)  # noqa: S314 - our own
    width, height = root.get("viewBox", "").split()[2:]
    root.attrib |= {
        "width": width,
        "height": height,
        "role": "group",
        "aria-label": visible(name),
    }
    style = ET.Element(f"{{{SVG}}}style")
    # The variables of the colours, for light and for dark screens.
    light, dark = (
        " ".join(f"--{name}: {colour};" for name, colour in colours.items())
        for colours in (LIGHT, DARK)
    )
    style.text = (
        f":root {{ {light} }}\n@media screen and (prefers-color-scheme: dark) {{ :root {{ "
        f"{dark} }} }}\n"
    )
    root.insert(0, style)
    for group in root.iter(f"{{{SVG}}}g"):
        # A group id that `Artist.set_gid` set becomes a class. Those of matplotlib contain "_".
        kind = group.attrib.pop("id", "_")
        if "_" not in kind:
            group.set("class", kind)
    return Markup(ET.tostring(root, encoding="unicode"))  # noqa: S704 - ElementTree escapes


def data_url(svg: str) -> str:
    """Return SVG text as a data: address, which an HTML page can show without another file."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


@dataclass(frozen=True)
class Curve:
    """A line through points in a plot of `curves_svg`.

    Curves of one name must have one colour and style, because they share an entry of the legend.

    Attributes:
        name: the name in the legend.
        colour: the position of the colour in SERIES.
        dashed: True for a dashed line.
        points: the points (x, y) in order, with x above 0.
    """

    name: str
    colour: int
    dashed: bool
    points: tuple[tuple[float, float], ...]


CURVES_PX = (960, 370)
CURVES_FRAME = {"left": 0.065, "right": 0.985, "wspace": 0.12}
ABOVE_PX = 40
BELOW_PX = 81
X_TITLE_PX = 37
LEGEND_PX = 6
"""Layout in pixels: the space above and below the panels, and the height of the axis' title and of
the legend above the lower edge.
"""
LEGEND_NAMES = 4
LEGEND_ROW_PX = 22
"""The maximum number of names in a row of the legend, and the height of a row."""


def curves_svg(
    panels: Sequence[tuple[str, Sequence[Curve]]],
    x_title: str,
    y_title: str,
) -> str:
    """Draw panels side by side that share the y axis. Each has a logarithmic x axis of its own.

    Args:
        panels: the title and the curves of each panel.
        x_title: the title of the x axis.
        y_title: the title of the y axis.

    Returns:
        An SVG file that follows the reader's light or dark mode.
    """
    # Curves of one name share an entry of the legend.
    names = {curve.name for curve in chain.from_iterable(curves for _, curves in panels)}
    rows = math.ceil(len(names) / LEGEND_NAMES)
    width_px = CURVES_PX[0]
    more_px = (rows - 1) * LEGEND_ROW_PX
    height_px = CURVES_PX[1] + more_px
    frame = CURVES_FRAME | {
        "top": 1 - ABOVE_PX / height_px,
        "bottom": (BELOW_PX + more_px) / height_px,
    }
    with look():
        figure = new_figure(width_px, height_px)
        all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False, gridspec_kw=frame)[0]
        handles = {}
        for axes, (title, curves) in zip(all_axes, panels, strict=True):
            axes.set(xscale="log", title=title)
            axes.margins(0.06)
            for curve in curves:
                style = {"color": LIGHT[SERIES[curve.colour]], "ls": "--" if curve.dashed else "-"}
                xs_and_ys = zip(*curve.points, strict=True)
                lines = axes.plot(*xs_and_ys, **style, marker="o", ms=5, lw=2, gid="curve")
                handles[curve.name] = lines[0]
            set_ticks(axes.xaxis, 5)
        set_ticks(all_axes[0].yaxis, 8)
        figure.supxlabel(
            x_title, size=FONT_PX, color=LIGHT["soft"], y=(X_TITLE_PX + more_px) / height_px
        )
        figure.supylabel(y_title, size=FONT_PX, color=LIGHT["soft"])
        columns = math.ceil(len(handles) / rows)
        at = (0.5, LEGEND_PX / height_px)
        figure.legend(
            handles.values(), handles, ncols=columns, loc="lower center", bbox_to_anchor=at
        )
        return svg_of(figure, f"{y_title} against {x_title}")


HISTOGRAM_PX = (358, 240)
"""The width fits the screen of a telephone, which would scale down a wider picture."""
HISTOGRAM_FRAME = (0.225, 0.2, 0.72, 0.77)
LABELS = 5
MOST_BARS = 81


def histogram_url(spread: "Spread") -> str:
    """Draw a histogram of the INT8 error over all pixels, on a logarithmic scale.

    A line shows a Gaussian of the same standard deviation: errors by rounding follow it, clipping
    leaves bars outside it.

    Args:
        spread: the number of pixels by the difference of INT8 from float in DN.

    Returns:
        The picture as a data: address.
    """
    centres, shares, wide = bins(spread)
    # A share of one pixel is the least that a bar can have.
    decades = math.ceil(math.log10(spread.counts.sum()))
    # The deviation is 0 where INT8 equals float everywhere, and the Gaussian divides by it.
    std_dn = max(spread.std_dn, 1e-9)
    gauss = wide * np.exp(-((centres / std_dn) ** 2) / 2) / (std_dn * math.sqrt(2 * math.pi))
    least = 10.0**-decades
    with look():
        figure = new_figure(*HISTOGRAM_PX)
        axes = figure.add_axes(HISTOGRAM_FRAME)
        axes.set(yscale="log", ylim=(least, 1), xlabel="INT8 - float, DN")
        axes.bar(centres, np.maximum(shares - least, 0), 0.8 * wide, least, color=LIGHT["mark2"])
        inside = gauss > least
        axes.plot(centres[inside], np.minimum(gauss[inside], 1), color=LIGHT["mark1"], lw=2)
        set_ticks(axes.xaxis, LABELS)
        rows = range(1, decades)
        axes.yaxis.set_ticks(
            [10.0**-d for d in rows], labels=[f"{100 * 10.0**-d:.{max(d - 2, 0)}f} %" for d in rows]
        )
        axes.yaxis.set_ticks([], minor=True)
        axes.grid(visible=False, axis="x")
        return data_url(svg_of(figure, "Share of the pixels by the difference of INT8 from float"))


def bins(spread: "Spread") -> tuple[np.ndarray, np.ndarray, int]:
    """Group the differences of INT8 from float into at most MOST_BARS bins for a histogram.

    Args:
        spread: the number of pixels by the difference in DN.

    Returns:
        The centres of the bins in DN, (n,); the shares of all pixels in [0, 1], (n,); and the width
        of a bin in DN, which is odd, so that zero is in the middle of a bin.
    """
    farthest = int(np.abs(np.flatnonzero(spread.counts) - MAX_DN).max())
    # The width is odd, so that zero lies in the middle of a bin.
    wide = math.ceil((2 * farthest + 1) / MOST_BARS) | 1
    reach = -(-max(farthest - wide // 2, 0) // wide)
    half = reach * wide + wide // 2
    middle = MAX_DN + wide
    padded = np.pad(spread.counts, wide)
    counts = padded[middle - half : middle + half + 1].reshape(-1, wide).sum(1)
    shares = counts / spread.counts.sum()
    return np.arange(-reach, reach + 1) * wide, shares, wide
