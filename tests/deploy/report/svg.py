"""Functions that measure the text and read the styles in a plot."""

from xml.etree import ElementTree as ET

from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from beers_deploy.report.plots import FONT_PX, look


def text_width(text: str, size_px: float = FONT_PX) -> float:
    """Return the width of a line in pixels in matplotlib's own font.

    It is wider than the fonts that a browser uses instead.
    """
    with look():
        width, _, _ = text_to_path.get_text_width_height_descent(
            text, FontProperties(size=size_px), ismath=False
        )
    return float(width)


def style_of(element: ET.Element) -> dict[str, str]:
    """Return the inline style of an element."""
    parts = (part.split(":", 1) for part in element.get("style", "").split(";") if part)
    return {key.strip(): value.strip() for key, value in parts}
