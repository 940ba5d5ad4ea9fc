"""What tests ask of the text in a plot."""

from xml.etree import ElementTree as ET

from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from beers_deploy.report.plots import FONT_PX, look


def text_width(text: str, size_px: float = FONT_PX) -> float:
    """Width of a line in pixels, in matplotlib's own font: wider than those that a browser takes in
    its place.
    """
    with look():
        width, _, _ = text_to_path.get_text_width_height_descent(
            text, FontProperties(size=size_px), ismath=False
        )
    return float(width)


def style_of(element: ET.Element) -> dict[str, str]:
    """The inline style of an element."""
    parts = (part.split(":", 1) for part in element.get("style", "").split(";") if part)
    return {key.strip(): value.strip() for key, value in parts}
