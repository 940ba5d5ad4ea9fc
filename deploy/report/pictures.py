"""Pictures of 12-bit images: the same stretch for all that are compared."""

import base64
import io
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

GAMMA = 1 / 1.8
LABEL_PX = 18


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


def busiest_window(dn: np.ndarray, side_px: int) -> tuple[int, int]:
    """Top and left of the window with the strongest gradients, on a coarse grid: where a crop is worth showing."""
    gradient = np.abs(np.diff(dn, axis=0))[:, :-1] + np.abs(np.diff(dn, axis=1))[:-1]
    height, width = dn.shape
    corners = [
        (top, left)
        for top in range(0, max(height - side_px, 0) + 1, max(side_px // 2, 1))
        for left in range(0, max(width - side_px, 0) + 1, max(side_px // 2, 1))
    ]
    return max(corners, key=lambda c: float(gradient[c[0] : c[0] + side_px, c[1] : c[1] + side_px].mean()))


def picture_url(grey: np.ndarray) -> str:
    """An (H, W) or (H, W, 3) uint8 picture as a data: address."""
    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def strip(
    images: dict[str, np.ndarray], window: tuple[int, int], side_px: int, zoom: int, stretch: Stretch
) -> Image.Image:
    """The same crop of several (H, W) images side by side, enlarged without smoothing, each under its name."""
    top, left = window
    size = side_px * zoom
    canvas = Image.new("L", (len(images) * (size + 4) - 4, size + LABEL_PX), 255)
    draw = ImageDraw.Draw(canvas)
    for k, (name, dn) in enumerate(images.items()):
        crop = Image.fromarray(stretch.to_bytes(dn[top : top + side_px, left : left + side_px]))
        crop = crop.resize((crop.width * zoom, crop.height * zoom), Image.Resampling.NEAREST)
        canvas.paste(crop, (k * (size + 4), LABEL_PX))
        draw.text((k * (size + 4) + 2, 2), name, fill=0)
    return canvas
