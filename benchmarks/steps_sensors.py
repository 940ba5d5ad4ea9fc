"""What the two steps around a network change under sixteen sensors, in bright and dark scenes.

    python benchmarks/steps_sensors.py --images aerial-test/ --json steps.json \
        [--networks ...] [--part 0/2]
    python benchmarks/steps_sensors.py --table steps.json [...]

One photograph of each site, or of every n-th with --every. PSNR of inner pixels against the
reference without noise, less that of the same network without steps. --part runs every n-th sensor,
and --table puts the parts together.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from beers_deploy.model.metrics.fidelity import fidelity_db
from beers_deploy.model.raster.images import site_of
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.steps import Around
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.evaluation.pairs import NamedPair, simulate_pairs
from beers_deploy.studies.evaluation.sweep import NOMINAL, conditions

NETWORKS = "convbeers-half-xs,convbeers-xs,convbeers-half,convbeers-s"
BRIGHTNESSES = (1, 0.25, 0.05)
FULL_SCALE = 4095
SEED = 0
BORDER_PX = 57
OVERSAMPLINGS = (4, 2)
AROUND = {
    "neither": Around(consistency=False, exposure=False),
    "consistency": Around(consistency=True, exposure=False),
    "exposure": Around(consistency=False, exposure=True),
    "both": Around(consistency=True, exposure=True),
}
DEGRADED = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference")

Scores = dict[str, dict[str, dict[str, float]]]
"""Mean PSNR in dB by brightness and sensor, by network, and by what is around it."""


def main() -> None:
    """Measure and write, or print the tables of what was measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--networks", default=",".join(f"{n},{n}-int8" for n in NETWORKS.split(","))
    )
    parser.add_argument("--part", default="0/1")
    parser.add_argument(
        "--every", type=int, default=1, help="use every n-th site: large networks take hours"
    )
    parser.add_argument("--table", nargs="+", type=Path, default=[])
    arguments = parser.parse_args()
    if arguments.table:
        show([json.loads(path.read_text()) for path in arguments.table])
        return
    scenes = load_scenes(arguments.images, REFERENCE.nominal(), SEED)
    of_sites = {site_of(scene.name): scene for scene in reversed(scenes)}
    part, parts = map(int, arguments.part.split("/"))
    sites = list(of_sites.values())[:: arguments.every]
    measure(sites, arguments.networks.split(","), arguments.json, slice(part, None, parts))


def measure(scenes: Sequence[Scene], networks: Sequence[str], out: Path, part: slice) -> None:
    """Write the scores after each sensor, so that a run that is stopped keeps what it has."""
    methods = {
        (network, around): method_named(network, DEGRADED, REFERENCE, around=AROUND[around])
        for network, around in product(networks, AROUND)
    }
    scores: Scores = {}
    nominal = DEGRADED.nominal()
    aim = REFERENCE.nominal()
    for name, sensor in list(conditions(nominal, DEGRADED).items())[part]:
        # The nominal sensor is also the condition with an MTF of 7 %.
        if name == NOMINAL:
            continue
        for brightness in BRIGHTNESSES:
            brightened = [
                Scene(scene.name, scene.radiance * np.float32(brightness)) for scene in scenes
            ]
            pairs, _ = simulate_pairs(
                brightened, sensor, aim.in_units_of(sensor), SEED, OVERSAMPLINGS
            )
            by_network: dict[str, dict[str, float]] = {network: {} for network in networks}
            for (network, around), method in methods.items():
                assert method.specialise is not None  # noqa: S101 - shipped networks take any sensor
                restore = method.specialise(sensor)
                by_network[network][around] = float(
                    np.mean([inner_psnr_db(restore(p.degraded), p) for p in pairs])
                )
            scores[f"{brightness:g}, {name}"] = by_network
        out.write_text(json.dumps(scores, indent=1))
        print(name, flush=True)


def inner_psnr_db(restored: np.ndarray, pair: NamedPair) -> float:
    """PSNR of inner pixels against the reference without noise."""
    assert pair.noise_free is not None  # noqa: S101 - pairs simulated here have it
    border_px = min(BORDER_PX, min(restored.shape) // 4)
    inner = (slice(border_px, -border_px), slice(border_px, -border_px))
    return fidelity_db(restored[inner], pair.noise_free[inner], pair.degraded[inner], FULL_SCALE)


def show(parts: Sequence[Scores]) -> None:
    """Print a table a brightness: mean gain over the sensors, and in parentheses the least and its
    sensor.
    """
    scores: Scores = {}
    for part in parts:
        scores |= part
    for brightness in BRIGHTNESSES:
        start = f"{brightness:g}, "
        sensors = {
            name.removeprefix(start): figures
            for name, figures in scores.items()
            if name.startswith(start)
        }
        print(
            f"\nRadiance {brightness:g}, {len(sensors)} sensors\n\n| network | consistency | "
            "exposure | both |"
        )
        print("|---|---|---|---|")
        for network in next(iter(sensors.values())):
            cells = [
                gain(sensors, network, around) for around in ("consistency", "exposure", "both")
            ]
            print(f"| {network} |", " | ".join(cells), "|")


def gain(
    sensors: Mapping[str, Mapping[str, Mapping[str, float]]], network: str, around: str
) -> str:
    """Mean over the sensors in dB, the least and its sensor."""
    gains = {
        name: figures[network][around] - figures[network]["neither"]
        for name, figures in sensors.items()
    }
    least = min(gains, key=lambda name: gains[name])
    return f"{np.mean(list(gains.values())):+.2f} ({gains[least]:+.2f}, {least})"


if __name__ == "__main__":
    main()
