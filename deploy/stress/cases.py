"""The hard cases: images in digital numbers of 12 bits that an instrument in orbit meets, or a fault makes."""

from dataclasses import dataclass

import numpy as np

from deploy.stress import images
from deploy.stress.images import FULL_DN as FULL_DN
from deploy.stress.images import Draw

SIDE_PX = 96


@dataclass(frozen=True)
class Case:
    """One kind of hard image.

    Attributes:
        name: short, as in the tables.
        draw: makes its images.
        pixels: "sound", or what is wrong with them: "missing" (NaN), "infinite", "beyond" 12 bits.
        flat: every pixel of an image is the same: the mean must be kept, there is nothing to restore.
        mtf_nyquist: of the sensor that acquired it; None for the profile's own.
        large: only what must hold of one run is looked at.
    """

    name: str
    draw: Draw
    pixels: str = "sound"
    flat: bool = False
    mtf_nyquist: float | None = None
    large: bool = False


CASES = (
    Case("black", images.flat(0.0), flat=True),
    Case("full scale", images.flat(1.0), flat=True),
    Case("deciles", images.flat(*(k / 10 for k in range(1, 10))), flat=True),
    Case("steps", images.steps),
    Case("checkerboard", images.checkerboard),
    Case("hot pixel", images.hot_pixel),
    Case("dead column and row", images.dead_lines),
    Case("glint", images.glint),
    Case("snow", images.snow),
    Case("night", images.night),
    Case("ramps", images.ramps),
    Case("Siemens star", images.star),
    Case("SNR 3", images.noisy),
    Case("no noise", images.clean),
    Case("MTF 0.1 %", images.through(0.001), mtf_nyquist=0.001),
    Case("MTF 60 %", images.through(0.6), mtf_nyquist=0.6),
    Case("nodata stripes", images.stripes, pixels="missing"),
    Case("NaN pixels", images.scattered(np.nan), pixels="missing"),
    Case("infinite pixels", images.scattered(np.inf), pixels="infinite"),
    Case("beyond 12 bits", images.scattered(60_000), pixels="beyond"),
    Case("1 x 1", images.sized((1, 1))),
    Case("1 x N", images.sized((1, 97), (97, 1))),
    Case("flat 1 x N", images.narrow, flat=True),
    Case("35 x 35", images.sized((35, 35))),
    Case("641 x 640", images.sized((640, 641)), large=True),
)
