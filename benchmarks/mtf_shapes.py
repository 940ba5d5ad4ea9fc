"""Compare networks and the traditional pipeline under sensors with one contrast at Nyquist and
different MTF curves.

    python benchmarks/mtf_shapes.py --images aerial-test/ [--methods traditional,convbeers-s-int8]

Each curve is given as a table up to Nyquist, where it is 7 % or --contrast, and all methods receive
it. The script prints the PSNR of inner pixels against the reference without noise.
"""

import argparse
from pathlib import Path

import numpy as np

import beers_deploy as bd
from beers_deploy.model.curves import FREQUENCIES, Curve, pupil_contrast
from beers_deploy.profiles.constant import Stated
from beers_deploy.profiles.response import NYQUIST, MtfTable, Response
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import axes_of

FIGURE = "inner PSNR, reference without noise"
MIDDLE_CPX = 0.22
WIDTH_CPX = 0.12
DEPTH = 0.10
"""The sag and the bulge: middle and width in cycles per pixel, and the change of contrast."""


def curves(at_nyquist: float) -> dict[str, Curve]:
    """Return the contrasts of each curve at FREQUENCIES."""
    detector = np.sinc(FREQUENCIES)
    contrast = at_nyquist / detector[-1]
    formula = contrast ** (FREQUENCIES / NYQUIST) * detector
    hill = DEPTH * np.exp(-(((FREQUENCIES - MIDDLE_CPX) / WIDTH_CPX) ** 2))
    return {
        "of training": formula,
        "Gaussian": at_nyquist ** ((FREQUENCIES / NYQUIST) ** 2),
        "sagging": formula * (1 - hill),
        "bulging": formula * (1 + hill),
        "circular pupil": pupil_contrast(contrast, 0.0) * detector,
        "obscured pupil": pupil_contrast(contrast, 0.3) * detector,
    }


def main() -> None:
    """Evaluate the methods under each curve."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--methods", default="traditional,convbeers-s-int8,convbeers-s-curves-int8")
    parser.add_argument("--contrast", type=float, default=0.07)
    arguments = parser.parse_args()
    sensor = Sensor.load("pleiades-degraded")
    for name, contrasts in curves(arguments.contrast).items():
        values = tuple(contrasts.tolist())
        response: Response = MtfTable(tuple(FREQUENCIES.tolist()), values, values)
        about = Stated(response, "stated", name)
        try:
            table = bd.evaluate(
                methods=arguments.methods,
                images=arguments.images,
                sensor=sensor.with_fields(response=response, **axes_of(response, about, about)),
            )
        except bd.BeersError as error:
            parser.error(str(error))
        for row in table.rows:
            # The published rows of the paper lack this figure.
            if row.table == "mean" and FIGURE in row.figures:
                print(name, row.name, row.figures[FIGURE], sep=": ")


if __name__ == "__main__":
    main()
