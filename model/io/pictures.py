"""Render pictures of 12-bit images, with one stretch for all compared images."""

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from PIL import Image, ImageDraw, ImageFont

GAMMA = 1 / 1.8
LABEL_PX = 22
GAP_PX = 4


@dataclass(frozen=True)
class Stretch:
    """The digital numbers that are shown as black and as white."""

    black: float
    white: float

    def to_bytes(self, dn: np.ndarray) -> np.ndarray:
        """Convert digital numbers (H, W) to 8-bit grey values with a gamma."""
        return np.asarray(np.rint(255 * self._share(dn) ** GAMMA), np.uint8)

    def to_srgb(self, dn: np.ndarray) -> np.ndarray:
        """Convert digital numbers (H, W) to sRGB, (H, W, 3) float32 in [0, 1] with three equal
        bands.
        """
        light = self._share(dn)
        # The two parts of the curve are those of IEC 61966-2-1.
        code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        return np.repeat(code.astype(np.float32)[..., None], 3, axis=2)

    def _share(self, dn: np.ndarray) -> np.ndarray:
        # An image of one value has no range to divide by.
        return np.clip((dn - self.black) / max(self.white - self.black, 1e-6), 0, 1)


def stretch_of(dn: np.ndarray) -> Stretch:
    """Compute the stretch with black at the 0.5th and white at the 99.5th percentile."""
    black, white = np.percentile(dn, (0.5, 99.5))
    return Stretch(float(black), float(white))


def busiest_windows(dn: np.ndarray, side_px: int) -> list[tuple[int, int]]:
    """Find the windows with the strongest gradients in the upper and the lower half of an image.

    Returns:
        The position (top, left) of both windows, or of one if the image is too low for two.
    """
    half = dn.shape[0] // 2
    if half < side_px:
        return [_busiest(dn, side_px)]
    top, left = _busiest(dn[half:], side_px)
    return [_busiest(dn[:half], side_px), (half + top, left)]


def _busiest(dn: np.ndarray, side_px: int) -> tuple[int, int]:
    gradient = np.abs(np.diff(dn, axis=0))[:, :-1] + np.abs(np.diff(dn, axis=1))[:-1]
    # An image one pixel high or wide has no gradient, and one window.
    if not gradient.size:
        return 0, 0
    rows, columns = (
        range(0, max(size - side_px, 0) + 1, max(side_px // 2, 1)) for size in dn.shape
    )
    corners = product(rows, columns)
    return max(
        corners, key=lambda c: float(gradient[c[0] : c[0] + side_px, c[1] : c[1] + side_px].mean())
    )


def picture_url(grey: np.ndarray) -> str:
    """Encode a picture (H, W) or (H, W, 3) uint8 as a data: URL."""
    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def strip(
    images: dict[str, np.ndarray],
    windows: list[tuple[int, int]],
    side_px: int,
    zoom: int,
    stretch: Stretch,
) -> Image.Image:
    """Draw the same crops of several images (H, W) as a grid: one column per image under its name,
    one row per window.

    Args:
        images: the images by name; all have the same shape.
        windows: the position (top, left) of each crop.
        side_px: the side of a crop in pixels.
        zoom: the number of pixels of the picture per pixel of an image, along each side.
        stretch: the stretch of all images.
    """
    rows = [
        strip_row(
            (dn[top : top + side_px, left : left + side_px] for dn in images.values()), stretch
        )
        for top, left in windows
    ]
    return grid(list(images), rows, zoom)


def strip_row(crops: Iterable[np.ndarray], stretch: Stretch) -> list[np.ndarray]:
    """Convert crops of digital numbers to grey."""
    return [stretch.to_bytes(crop) for crop in crops]


def error_row(errors: Iterable[np.ndarray], white_dn: float) -> list[np.ndarray]:
    """Convert absolute errors to grey, linearly from 0 (black) to `white_dn` and above (white)."""
    return [np.rint(255 * np.clip(error / white_dn, 0, 1)).astype(np.uint8) for error in errors]


def grid(names: list[str], rows: list[list[np.ndarray]], zoom: int) -> Image.Image:
    """Draw rows of equally large uint8 cells, with a name above each column.

    Args:
        names: the names of the columns.
        rows: cells (h, w), or all of them (h, w, 3).
        zoom: the number of pixels of the picture per pixel of a cell, along each side.
    """
    height, width = (side * zoom for side in rows[0][0].shape[:2])
    size = len(names) * (width + GAP_PX) - GAP_PX, len(rows) * (height + GAP_PX) + LABEL_PX
    canvas = Image.new("L" if rows[0][0].ndim == 2 else "RGB", size, "white")
    draw = ImageDraw.Draw(canvas)
    for column, name in enumerate(names):
        left = column * (width + GAP_PX)
        # The largest font in which the name fits into its column.
        fonts = (ImageFont.load_default(size=size) for size in range(LABEL_PX - 6, 7, -1))
        fitting = (font for font in fonts if font.getlength(name) <= width - 2)
        font = next(fitting, ImageFont.load_default(size=8))
        draw.text((left + 2, 1), name, fill="black", font=font)
        for number, row in enumerate(rows):
            cell = Image.fromarray(row[column]).resize((width, height), Image.Resampling.NEAREST)
            canvas.paste(cell, (left, LABEL_PX + number * (height + GAP_PX)))
    return canvas
