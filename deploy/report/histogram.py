"""The histogram of INT8's errors as an SVG picture, light or dark as the reader's page is."""

import base64
import math

import numpy as np

from deploy.report.page import templates
from quant.graph import MAX_DN
from quant.sensitivity import Spread

WIDTH, HEIGHT, LEFT, BOTTOM, FONT_PX = 338, 240, 80, 46, 13
"""In pixels of the page, on the narrowest one too: a wider picture would be scaled down there, its labels with it."""
LABELS = 6
MOST_BARS = 81


def histogram_url(spread: Spread) -> str:
    """Shares of pixels by error, on a logarithmic scale, and a Gaussian of the same deviation, as a data: address."""
    svg = templates().get_template("histogram.svg").render(_layout(spread))
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


def bins(spread: Spread) -> tuple[np.ndarray, np.ndarray, int]:
    """Centres in DN, shares of the pixels, and the width in DN of at most MOST_BARS bins that hold every error."""
    farthest = int(np.abs(np.flatnonzero(spread.counts) - MAX_DN).max())
    wide = 1
    while 2 * _reach(farthest, wide) + 1 > MOST_BARS:
        wide += 2  # odd, so that zero lies in the middle of a bin
    reach = _reach(farthest, wide)
    half = reach * wide + wide // 2
    padded = np.pad(spread.counts, wide)
    middle = MAX_DN + wide
    shares = padded[middle - half : middle + half + 1].reshape(-1, wide).sum(1) / spread.counts.sum()
    return np.arange(-reach, reach + 1) * wide, shares, wide


def _reach(farthest: int, wide: int) -> int:
    """Bins on each side of the middle one."""
    return -(-max(farthest - wide // 2, 0) // wide)


def _layout(spread: Spread) -> dict[str, object]:
    """Where everything stands, in pixels of the picture."""
    centres, shares, wide = bins(spread)
    decades = math.ceil(math.log10(spread.counts.sum()))
    slot, high = (WIDTH - LEFT) / len(centres), HEIGHT - BOTTOM
    std = max(spread.std_dn, 1e-9)
    gauss = wide * np.exp(-((centres / std) ** 2) / 2) / (std * math.sqrt(2 * math.pi))

    def y_of(share: float) -> float:
        return round(high * min(-math.log10(max(share, 10.0**-decades)) / decades, 1), 1)

    xs = [round(LEFT + slot * (k + 0.5), 1) for k in range(len(centres))]
    every = max(len(centres) // LABELS, 1)
    ticks = [k for k in range(len(centres)) if (k - len(centres) // 2) % every == 0]
    return {
        "width": WIDTH,
        "height": HEIGHT,
        "font": FONT_PX,
        "left": LEFT,
        "rows": [(f"{100 * 10.0**-d:.{max(d - 2, 0)}f} %", y_of(10.0**-d)) for d in range(1, decades)],
        "bars": [
            (round(x - 0.4 * slot, 1), y_of(share), round(0.8 * slot, 1), round(high - y_of(share), 1))
            for x, share in zip(xs, shares, strict=True)
        ],
        "curve": " ".join(f"{x},{y_of(float(g))}" for x, g in zip(xs, gauss, strict=True) if g > 10.0**-decades),
        "columns": [(int(centres[k]), xs[k]) for k in ticks],
    }
