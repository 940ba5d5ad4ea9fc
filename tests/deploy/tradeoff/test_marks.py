from itertools import combinations

import numpy as np
import pytest
from PIL import Image, ImageDraw

from deploy.report.plots import DARK, LIGHT, SERIES
from deploy.tradeoff.marks import FILLINGS, MARKERS, Mark, marks_of


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.1)."""
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def painted(mark: Mark) -> np.ndarray:
    """(80, 80) the mark in black and white: nothing of it is left to colour."""
    image = Image.new("L", (80, 80), 255)
    draw = ImageDraw.Draw(image)
    outer, inner = ([(40 + 60 * x, 40 + 60 * y) for x, y in part] for part in (mark.outer, mark.inner))
    draw.polygon(outer, fill=255, outline=0, width=5)
    if inner:
        draw.polygon(inner, fill=0)
    return np.asarray(image) < 128


@pytest.mark.parametrize("colours", [LIGHT, DARK])
def test_every_colour_stands_out_from_its_page(colours: dict[str, str]) -> None:
    assert all(contrast(colours[name], colours["page"]) >= 3 for name in SERIES)
    assert LIGHT.keys() == DARK.keys()


def test_marks_differ_without_colour() -> None:
    marks = [Mark(marker, "ink", filling) for marker in MARKERS for filling in FILLINGS.values()]
    pictures = [painted(mark) for mark in marks]
    for a, b in combinations(pictures, 2):
        assert (a ^ b).sum() > 0.05 * (a | b).sum()


def test_each_method_has_its_own_look() -> None:
    names = [f"method {k}" for k in range(len(MARKERS) * len(SERIES))]
    marks = marks_of(names)
    assert len({mark.marker for mark in list(marks.values())[: len(MARKERS)]}) == len(MARKERS)
    assert len({(mark.marker, mark.colour) for mark in marks.values()}) == len(names)
