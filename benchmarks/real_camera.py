"""Real frames before and after restoration: noise on flat ground, width of an edge, and crops side
by side.

    python benchmarks/real_camera.py --frames frames/ --restored restored/ --picture real-camera.png

`frames` holds the frames of docs/tutorials/real-camera.md, and `restored` a folder for each method
with images of the same names, as the tutorial makes them.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from PIL import Image

from beers_deploy.model.metrics.edge_search import edge_in
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.uneven_edge import EdgeLine

SHARE_LOW = 0.1
SHARE_HIGH = 0.9
BINS_PER_PX = 4
HALF_PX = 6
PERCENTILES = (0.5, 99.5)
ZOOM = 2
GAP_PX = 6


class Box(NamedTuple):
    """Part of a frame, in pixels."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """Return the part of an image (H, W), as float."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        return np.asarray(part, np.float64)


class Place(NamedTuple):
    """A crop to show of a frame, flat ground in it, and a box that an edge crosses from top to
    bottom, if any.
    """

    frame: str
    crop: Box
    flat: Box
    edge: Box | None


PLACES = (
    Place("126_GRE", Box(780, 560, 220, 200), Box(890, 665, 100, 16), Box(820, 713, 20, 17)),
    Place("12_NIR", Box(900, 180, 220, 200), Box(905, 190, 20, 30), None),
)


def main() -> None:
    """Print a row for each frame and method, and write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=Path, required=True)
    parser.add_argument("--restored", type=Path, required=True)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    methods = sorted(path for path in arguments.restored.iterdir() if path.is_dir())
    print(
        "| frame | image | noise on flat ground, % of its level | width of an edge, 10 to 90 %, "
        "px |"
    )
    print("|---|---|---|---|")
    rows = []
    for place in PLACES:
        (raw,) = (path for path in arguments.frames.iterdir() if place.frame in path.stem)
        images = {"raw": tifffile.imread(raw)}
        images |= {folder.name: tifffile.imread(folder / raw.name) for folder in methods}
        line = edge_line(place.edge.of(images["raw"])) if place.edge else None
        for name, image in images.items():
            flat = place.flat.of(np.squeeze(image))
            width = (
                f"{edge_width_px(place.edge.of(np.squeeze(image)), line):.2f}"
                if place.edge and line
                else ""
            )
            print(f"| {place.frame} | {name} | {100 * roughness(flat):.2f} | {width} |")
        rows.append(side_by_side([place.crop.of(np.squeeze(image)) for image in images.values()]))
    if arguments.picture is not None:
        Image.fromarray(np.concatenate(rows)).save(arguments.picture, optimize=True)


def roughness(flat: np.ndarray) -> float:
    """Return the standard deviation of flat ground (H, W) less its slow part, over its mean."""
    steps = flat[:, 1:] - flat[:, :-1]
    return float(steps.std() / np.sqrt(2) / flat.mean())


def edge_line(region: np.ndarray) -> EdgeLine:
    """Return where the edge of a region (H, W) runs."""
    edge = edge_in(
        region, lambda values: np.full(values.shape, (0.02 * region.mean()) ** 2), "edge"
    )
    if isinstance(edge, Refusal):
        raise SystemExit(edge.reason)
    return edge[1]


def edge_width_px(region: np.ndarray, line: EdgeLine) -> float:
    """Return how far an edge of (H, W) takes from 10 to 90 % of its step, along its normal, of its
    rows together.
    """
    height, width = region.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    y -= (height - 1) / 2
    x -= (width - 1) / 2
    across = x - line.place_px - line.slope * y - line.bow_px * (2 * y / height) ** 2
    place = np.rint(across / np.hypot(1, line.slope) * BINS_PER_PX).astype(int)
    half = HALF_PX * BINS_PER_PX
    near = np.abs(place) <= half
    places = np.arange(2 * half + 1)
    counts = np.bincount(place[near] + half, minlength=places.size)
    sums = np.bincount(place[near] + half, region[near], places.size)
    filled = counts > 0
    profile = np.interp(places, places[filled], sums[filled] / counts[filled])
    ends = np.mean(profile[: 2 * BINS_PER_PX]), np.mean(profile[-2 * BINS_PER_PX :])
    share = np.maximum.accumulate((profile - ends[0]) / (ends[1] - ends[0]))
    low, high = np.interp([SHARE_LOW, SHARE_HIGH], share, places)
    return float(high - low) / BINS_PER_PX


def side_by_side(crops: list[np.ndarray]) -> np.ndarray:
    """Return the crops (H, W) beside each other, enlarged, with the contrast of the first."""
    dark, bright = np.percentile(crops[0], PERCENTILES)
    panels = []
    for crop in crops:
        pixels = (np.clip((crop - dark) / (bright - dark), 0, 1) * 255).astype(np.uint8)
        large = np.kron(pixels, np.ones((ZOOM, ZOOM), np.uint8))
        panels.append(np.pad(large, ((0, GAP_PX), (0, GAP_PX)), constant_values=255))
    return np.concatenate(panels, axis=1)


if __name__ == "__main__":
    main()
