"""Draws a plot as SVG: part of a page, or a picture of its own; light or dark as its reader's screen is."""

from markupsafe import Markup

from deploy.report.marks import DARK, LIGHT
from deploy.report.page import templates
from deploy.report.plot import Plot


def plot_style() -> Markup:
    """The style sheet of plots."""
    return Markup(templates().get_template("plot.css").render(light=LIGHT, dark=DARK))  # noqa: S704 - no foreign words


def plot_svg(plot: Plot, *, alone: bool = False) -> Markup:
    """The plot; `alone` as a file with its own style, else for a page that has it and rows to lead to."""
    style = plot_style() if alone else ""
    text = templates().get_template("plot.svg").render(plot=plot, alone=alone, style=style)
    return Markup(text)  # noqa: S704 - the template escapes
