"""Digital numbers as the picture that a detector of RGB images reads: one stretch for all images of a scene."""

from dataclasses import dataclass

import numpy as np

from model.io.pictures import stretch_of


@dataclass(frozen=True)
class Display:
    """Digital numbers shown as black and as white."""

    black_dn: float
    white_dn: float

    def rgb(self, dn: np.ndarray) -> np.ndarray:
        """(H, W) digital numbers to (H, W, 3) float32 in [0, 1]: linear, then sRGB's curve, in three equal bands."""
        light = np.clip((dn - self.black_dn) / max(self.white_dn - self.black_dn, 1e-6), 0, 1)
        code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
        return np.repeat(code.astype(np.float32)[..., None], 3, axis=2)


def display_of(reference_dn: np.ndarray) -> Display:
    """Black and white at the 0.5th and 99.5th percentile of a reference acquisition (H, W)."""
    stretch = stretch_of(reference_dn)
    return Display(stretch.black, stretch.white)
