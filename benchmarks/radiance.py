"""How far restoration moves the mean of an image, in %: photographs as a sensor sees them, and real
crops twice.

    python benchmarks/radiance.py --photographs aerial-test/ --crops pleiades/ \
        [--networks convbeers-s,convbeers-xs]

One photograph of each site is acquired and restored with the sensor's profile, and its mean
compared with the reference's. The crops, which were restored on the ground, are degraded as scenes
and restored, and restored once more as they are. Inner pixels count, as in `evaluate`.
"""

import argparse
from itertools import product
from pathlib import Path

import numpy as np

from beers_deploy.model.raster.images import read_pixels, site_of
from beers_deploy.model.shipped import INT8, SENSOR, shipped_names
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.model.simulator.sampling import Scene, scene_of
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.evaluation.pairs import NamedPair, oversamplings_of, simulate_pairs
from beers_deploy.studies.evaluation.scores import bias_percent

CROP_PX = 700
SEED = 0
DEGRADED = Sensor.load(SENSOR)
REFERENCE = Sensor.load("pleiades-reference")


def main() -> None:
    """Print a row a network."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--crops", type=Path, required=True)
    names = map("".join, product(shipped_names(), ("", INT8)))
    parser.add_argument("--networks", default=",".join(names))
    arguments = parser.parse_args()
    aim = REFERENCE.nominal()
    scenes = {
        site_of(scene.name): scene
        for scene in reversed(load_scenes(arguments.photographs, aim, SEED))
    }
    pairs = acquired(list(scenes.values()))
    crops = [
        read_pixels(path)[:CROP_PX, :CROP_PX] for path in sorted(arguments.crops.glob("*.tif"))
    ]
    degraded = acquired([scene_of(str(number), crop, aim) for number, crop in enumerate(crops)])
    print(
        "| network | photographs | without noise | crops as scenes | crops as they are "
        "|\n|---|---|---|---|---|"
    )
    for name in arguments.networks.split(","):
        restore = method_named(name, DEGRADED, REFERENCE).restore
        restored = [restore(pair.degraded) for pair in pairs]
        columns = (
            [change(image, pair.reference) for image, pair in zip(restored, pairs, strict=True)],
            [change(image, pair.noise_free) for image, pair in zip(restored, pairs, strict=True)],
            [change(restore(pair.degraded), pair.reference) for pair in degraded],
            [change(restore(crop.astype(np.float32)), crop) for crop in crops],
        )
        cells = [
            f"{np.mean(column):.2f} ({min(column):.2f} to {max(column):.2f})" for column in columns
        ]
        print(f"| {name} |", " | ".join(cells), "|", flush=True)


def acquired(scenes: list[Scene]) -> list[NamedPair]:
    """Each scene as both sensors see it."""
    return simulate_pairs(scenes, DEGRADED, REFERENCE, SEED, oversamplings_of(DEGRADED))[0]


def change(restored: np.ndarray, reference: np.ndarray | None) -> float:
    """Return the change of the mean of the inner pixels in %, clipped pixels among them."""
    assert reference is not None  # noqa: S101 - pairs simulated here have it
    return bias_percent(restored, reference)


if __name__ == "__main__":
    main()
