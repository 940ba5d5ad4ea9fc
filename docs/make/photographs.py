"""Make the pictures of README and of the gallery: crops of photographs, raw and restored.

    python docs/make/photographs.py aerial-test/

Prints the PSNR of the whole images for the captions. No network was trained on these photographs;
docs/results/gallery.md states where they are from.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

import beers_deploy as bd
from beers_deploy.model.io.pictures import stretch_of, strip
from beers_deploy.pairs import Pair

ASSETS = Path(__file__).parents[1] / "assets"
SENSOR = "pleiades-degraded"
ZOOM = 3


@dataclass(frozen=True)
class View:
    """A picture of parts of a photograph.

    Attributes:
        file: the file name of the photograph.
        picture: the file name in the assets.
        oversampling: pixels of the photograph for each pixel of the sensor.
        windows: (row, column) of the crops, in pixels of the sensor.
        side_px: the side of a crop.
    """

    file: str
    picture: str
    oversampling: int
    windows: tuple[tuple[int, int], ...]
    side_px: int = 110


VIEWS = (
    View("brighton_forest_lakeshore_0034.jpg", "photograph.png", 4, ((40, 270), (90, 20))),
    View("agung1_tropical_slope.jpg", "gallery-slope.png", 3, ((80, 190),)),
    View("kitais_munich_street_b_74.png", "gallery-street.png", 1, ((20, 20), (20, 180))),
    View("zoo_urban_park_mosaic_50cm.png", "gallery-park.png", 1, ((100, 100),)),
)


def main() -> None:
    """Simulate, restore, and write the crops."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photographs", type=Path, help="folder of the test photographs")
    folder = parser.parse_args().photographs
    for view in VIEWS:
        try:
            print(f"{view.picture}: {draw(folder / view.file, view)}")
        except bd.BeersError as error:
            parser.error(str(error))


def draw(photograph: Path, view: View) -> str:
    """Write the picture, and return the PSNR of its columns for the caption."""
    # Without `out` it is a pair.
    pair = cast(Pair, bd.simulate(images=[photograph], oversampling=view.oversampling))
    images = {
        "raw": pair.degraded,
        "traditional, tuned": bd.restore(pair.degraded, method="traditional", sensor=SENSOR),
        "convbeers-s, INT8": bd.restore(pair.degraded, network="convbeers-s-int8", sensor=SENSOR),
    }
    figures = [f"{name} {pair.psnr(image):.1f} dB" for name, image in images.items()]
    images["reference"] = pair.reference
    side_px = view.side_px
    crops = [pair.reference[y : y + side_px, x : x + side_px] for y, x in view.windows]
    picture = strip(images, list(view.windows), side_px, ZOOM, stretch_of(np.stack(crops)))
    picture.save(ASSETS / view.picture, optimize=True)
    return ", ".join(figures)


if __name__ == "__main__":
    main()
