"""Measure the gain of restoration for the small detector, on synthetic scenes
(docs/results/detection.md).

    python -m benchmarks.detector.demonstration [--out detection/] [--json detection.json]

The script prints the tables and writes their page into the folder. It takes three minutes on two
cores.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.detection.detector import open_detector
from beers_deploy.studies.detection.page import write_page
from beers_deploy.studies.detection.study import LabelledScene, run_study
from beers_deploy.studies.detection.tables import detection_table
from beers_deploy.studies.evaluation.methods import DEGRADED
from benchmarks.detector.network import DETECTOR
from benchmarks.detector.scenes import synthetic_scene

SIDE_PX = 768
"""Side of a synthetic scene. A sensor makes one pixel of three, which gives 256 pixels a side, the
input of the small detector."""
SEED = 0


def synthetic_labelled(number: int) -> LabelledScene:
    """Draw the synthetic scene with this number. Each scene is a site of its own, and no two
    numbers share a generator.
    """
    radiance, truth = synthetic_scene(np.random.default_rng([SEED, number]), SIDE_PX, SIDE_PX)
    name = f"synthetic {number}"
    return LabelledScene(name, name, truth, None, lambda _: radiance)


def main() -> None:
    """Draw scenes, run the detector on them, and show the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sensor", default="dior-medium,dior-high")
    parser.add_argument("--methods", default="traditional,convbeers-s,convbeers-s-int8")
    parser.add_argument("--drawn", type=int, default=24, help="number of scenes")
    parser.add_argument("--out", type=Path, help="folder for report.html")
    parser.add_argument("--json", type=Path, help="file for the results")
    arguments = parser.parse_args()
    # The small detector has the classes of the scenes, in their order.
    detector = open_detector(DETECTOR)
    scenes = [synthetic_labelled(number) for number in range(arguments.drawn)]
    sensors = [Sensor.load(name) for name in arguments.sensor.split(",")]
    methods = [DEGRADED, *arguments.methods.split(",")]
    compared = run_study(detector, scenes, sensors, methods, seed=SEED)
    notes = [f"The {len(scenes)} scenes are synthetic, each a site of its own: no photographs."]
    table = detection_table(compared, DETECTOR, detector, scenes, notes)
    if arguments.out is not None:
        write_page(compared, table, arguments.out / "report.html")
    table.print()
    if arguments.json is not None:
        replace(table, command="demonstration", arguments=vars(arguments)).save(arguments.json)


if __name__ == "__main__":
    main()
