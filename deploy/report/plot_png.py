"""Draws a plot as PNG, light, for documents: the same places as in the SVG."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageColor, ImageDraw

from deploy.report.labels import Place, font_of
from deploy.report.marks import LIGHT, Mark, scaled
from deploy.report.plot import FONT_PX, LABEL_PX, TITLE_PX, Dot, Plot, State
from model.io.files import whole_file

SCALE, FINER = 2, 2
"""Pixels of the picture for one of the plot; how much finer it is drawn than kept."""

INK, SOFT, LINE, PAGE, REACHED = "#1b1f24", "#5b6470", "#d5dae0", "#ffffff", "#eef4f8"
STRENGTH: dict[State, float] = {"front": 1.0, "even": 1.0, "beaten": 0.6}
BAR, PALE_BAR = 0.75, 0.16
ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}
STROKE = 0.26
"""Width of an outline, for a mark of radius 1."""


def write_png(plot: Plot, path: Path) -> None:
    """Write the picture, whole or not at all."""
    with whole_file(path) as temporary:
        paint(plot).save(temporary, "PNG", optimize=True)


def paint(plot: Plot) -> Image.Image:
    """Drawn finer, then averaged: smooth edges."""
    brush = Brush(plot.size)
    _grid(plot, brush)
    for dot in plot.dots:
        _bars(dot, brush)
    brush.line(plot.front, INK, 1.6)
    for label in plot.labels:
        if label.leader:
            brush.line((label.leader, (label.wish.x, label.wish.y)), SOFT, 1)
    for dot in plot.dots:
        brush.mark(dot.mark, (dot.x, dot.y), dot.radius, faded(LIGHT[dot.mark.colour], STRENGTH[dot.state]))
    _words(plot, brush)
    return brush.image.resize((SCALE * plot.size[0], SCALE * plot.size[1]), Image.Resampling.BOX)


class Brush:
    """Draws in pixels of the plot on a finer image."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._fine = SCALE * FINER
        self.image = Image.new("RGB", (self._fine * size[0], self._fine * size[1]), PAGE)
        self._draw = ImageDraw.Draw(self.image)

    def line(self, places: Sequence[Place], colour: str, width_px: float) -> None:
        """Straight from place to place."""
        if places:
            self._draw.line(self._finer(places), fill=colour, width=round(self._fine * width_px), joint="curve")

    def area(self, places: Sequence[Place], colour: str) -> None:
        """A polygon; nothing where it has no corners."""
        if places:
            self._draw.polygon(self._finer(places), fill=colour)

    def mark(self, mark: Mark, at: Place, radius_px: float, colour: str) -> None:
        """Page colour within an outline, then what is filled."""
        outer, inner = (
            [(at[0] + x, at[1] + y) for x, y in scaled(part, radius_px)] for part in (mark.outer, mark.inner)
        )
        self.area(outer, PAGE)
        self.line([*outer, *outer[:2]], colour, STROKE * radius_px)
        self.area(inner, colour)

    def text(self, at: Place, text: str, anchor: str, colour: str, size_px: int = FONT_PX) -> None:
        """A line of text; `anchor` as Pillow has it: l, m or r, and s for the baseline."""
        font = font_of(self._fine * size_px)
        self._draw.text(self._finer([at])[0], text, fill=colour, font=font, anchor=anchor)

    def label(self, at: Place, text: str, anchor: str) -> None:
        """A line of text with a rim in the page's colour, so that lines behind it do not hide it."""
        font, rim = font_of(self._fine * LABEL_PX), round(1.5 * self._fine)
        at = self._finer([at])[0]
        self._draw.text(at, text, fill=INK, font=font, anchor=anchor, stroke_width=rim, stroke_fill=PAGE)

    def upright(self, at: Place, text: str, colour: str) -> None:
        """A line of text from bottom to top, its middle at a place."""
        font = font_of(self._fine * FONT_PX)
        _, top, right, bottom = map(round, font.getbbox(text))
        strip = Image.new("L", (right, bottom + top))
        ImageDraw.Draw(strip).text((0, 0), text, fill=255, font=font)
        strip = strip.transpose(Image.Transpose.ROTATE_90)
        x, y = self._finer([at])[0]
        self.image.paste(colour, (round(x - strip.width / 2), round(y - strip.height / 2)), strip)

    def _finer(self, places: Sequence[Place]) -> list[Place]:
        return [(self._fine * x, self._fine * y) for x, y in places]


def _grid(plot: Plot, brush: Brush) -> None:
    """The area that is reached, and the lines of the ticks."""
    left, top, right, bottom = plot.frame
    if plot.front:
        brush.area([*plot.front, (right, bottom)], REACHED)
    for x, _ in plot.x_ticks:
        brush.line([(x, top), (x, bottom)], LINE, 1)
    for y, _ in plot.y_ticks:
        brush.line([(left, y), (right, y)], LINE, 1)


def _bars(dot: Dot, brush: Brush) -> None:
    colour = faded(LIGHT[dot.mark.colour], BAR if dot.state == "front" else PALE_BAR)
    for x1, y1, x2, y2 in dot.bars:
        brush.line([(x1, y1), (x2, y2)], colour, 1.4)


def _words(plot: Plot, brush: Brush) -> None:
    """Title, ticks, axes, labels and legend."""
    left, top, right, bottom = plot.frame
    brush.text((12, 21), plot.title, "ls", INK, TITLE_PX)
    brush.text((left + 8, top + 18), plot.better, "ls", SOFT)
    for x, text in plot.x_ticks:
        brush.text((x, bottom + 18), text, "ms", SOFT)
    for y, text in plot.y_ticks:
        brush.text((left - 8, y + 4.5), text, "rs", SOFT)
    brush.text(((left + right) / 2, bottom + 40), plot.x_title, "ms", SOFT)
    brush.upright((14, (top + bottom) / 2), plot.y_title, SOFT)
    for label in plot.labels:
        for y, text in zip(label.baselines, label.wish.lines, strict=True):
            brush.label((label.text_x, y), text, ANCHORS[label.anchor])
    for entry in plot.legend:
        colour = INK if entry.inked else LIGHT[entry.mark.colour]
        brush.mark(entry.mark, (entry.x, entry.y), entry.radius, faded(colour, STRENGTH[entry.state]))
        brush.text((entry.x + 14, entry.y + 4.5), entry.text, "ls", INK)


def faded(colour: str, share: float) -> str:
    """So much of a colour over the page's."""
    parts = zip(ImageColor.getrgb(colour), ImageColor.getrgb(PAGE), strict=True)
    return "#" + "".join(f"{round(share * over + (1 - share) * under):02x}" for over, under in parts)
