"""Pictures of 12-bit images: the same stretch for all that are compared."""

import base64
import io
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

GAMMA = 1 / 1.8
LABEL_PX, GAP_PX = 22, 4


@dataclass(frozen=True)
class Stretch:
    """Digital numbers shown as black and as white."""

    black: float
    white: float

    def to_bytes(self, dn: np.ndarray) -> np.ndarray:
        """(H, W) digital numbers to 8-bit grey, with a gamma for the eye."""
        share = np.clip((dn - self.black) / max(self.white - self.black, 1e-6), 0, 1)
        return np.asarray(np.rint(255 * share**GAMMA), np.uint8)


def stretch_of(dn: np.ndarray) -> Stretch:
    """Black and white at the 0.5th and 99.5th percentile."""
    black, white = np.percentile(dn, (0.5, 99.5))
    return Stretch(float(black), float(white))


def busiest_windows(dn: np.ndarray, side_px: int) -> list[tuple[int, int]]:
    """(top, left) of the window with the strongest gradients in the upper and in the lower half of an image.

    Only one where the image is too low for two.
    """
    half = dn.shape[0] // 2
    if half < side_px:
        return [_busiest(dn, side_px)]
    top, left = _busiest(dn[half:], side_px)
    return [_busiest(dn[:half], side_px), (half + top, left)]


def _busiest(dn: np.ndarray, side_px: int) -> tuple[int, int]:
    gradient = np.abs(np.diff(dn, axis=0))[:, :-1] + np.abs(np.diff(dn, axis=1))[:-1]
    rows, columns = (range(0, max(size - side_px, 0) + 1, max(side_px // 2, 1)) for size in dn.shape)
    corners = [(top, left) for top in rows for left in columns]
    return max(corners, key=lambda c: float(gradient[c[0] : c[0] + side_px, c[1] : c[1] + side_px].mean()))


def picture_url(grey: np.ndarray) -> str:
    """An (H, W) or (H, W, 3) uint8 picture as a data: address."""
    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def strip(
    images: dict[str, np.ndarray], windows: list[tuple[int, int]], side_px: int, zoom: int, stretch: Stretch
) -> Image.Image:
    """The same crops of several (H, W) images: a column an image under its name, a row a window, no smoothing."""
    size = side_px * zoom
    canvas = Image.new("L", (len(images) * (size + GAP_PX) - GAP_PX, len(windows) * (size + GAP_PX) + LABEL_PX), 255)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(size=LABEL_PX - 6)
    for column, (name, dn) in enumerate(images.items()):
        left = column * (size + GAP_PX)
        draw.text((left + 2, 1), name, fill=0, font=font)
        for row, (y, x) in enumerate(windows):
            crop = Image.fromarray(stretch.to_bytes(dn[y : y + side_px, x : x + side_px]))
            crop = crop.resize((crop.width * zoom, crop.height * zoom), Image.Resampling.NEAREST)
            canvas.paste(crop, (left, LABEL_PX + row * (size + GAP_PX)))
    return canvas
