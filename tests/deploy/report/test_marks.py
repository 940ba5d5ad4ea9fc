from itertools import combinations

import numpy as np
import pytest
from PIL import Image, ImageDraw

from deploy.report.marks import DARK, LIGHT, SHAPES, Mark, filling_of, left_half, marks_of

PRECISIONS = ("INT8 legal", "INT8 free", "bf16", "float32")


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
    outer, inner = ([(40 + 28 * x, 40 + 28 * y) for x, y in part] for part in (mark.outer, mark.inner))
    draw.polygon(outer, fill=255, outline=0, width=5)
    if inner:
        draw.polygon(inner, fill=0)
    return np.asarray(image) < 128


@pytest.mark.parametrize(("colours", "page"), [(LIGHT, "#ffffff"), (DARK, "#14171b")])
def test_every_colour_stands_out_from_its_page(colours: tuple[str, ...], page: str) -> None:
    assert all(contrast(colour, page) >= 3 for colour in colours)


def test_marks_differ_without_colour() -> None:
    marks = [Mark(shape, 0, filling_of(precision)) for shape in range(len(SHAPES)) for precision in PRECISIONS]
    pictures = [painted(mark) for mark in marks]
    for a, b in combinations(pictures, 2):
        assert (a ^ b).sum() > 0.05 * (a | b).sum()


def test_each_method_has_its_own_look() -> None:
    names = [f"method {k}" for k in range(len(SHAPES) * len(LIGHT))]
    marks = marks_of(names)
    assert len({mark.shape for mark in list(marks.values())[: len(SHAPES)]}) == len(SHAPES)
    assert len({(mark.shape, mark.colour) for mark in marks.values()}) == len(names)


def test_half_of_a_shape_lies_left() -> None:
    for shape in SHAPES:
        assert all(x <= 1e-12 for x, _ in left_half(shape))
        assert min(x for x, _ in left_half(shape)) == min(x for x, _ in shape)
