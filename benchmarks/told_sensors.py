"""Networks told their sensor, beside blind ones and the traditional chain told the same, sensor by sensor.

    python benchmarks/told_sensors.py --images aerial-test/ convbeers-s-told.safetensors convbeers-s.safetensors

PSNR in dB over 4095 DN, the mean over one whole image of each site (the first by name). `--wrong` tells the networks
and the chain another sensor than the one that acquired the images.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from deploy.export import network_for
from model.conditioning import fold, tell
from model.convbeers import ConvBEERS
from model.evaluation.pairs import NamedPair, simulate_pairs
from model.evaluation.scores import fidelity_db
from model.evaluation.sweep import Fixed, conditions
from model.io.images import list_images, site_of
from model.io.weights import is_told, load_told
from model.simulator.sampling import Scene, read_scene
from model.traditional.pipeline import Chain, restore_traditional
from profiles import load_sensor
from profiles.sensor import Sensor, noise_from_snr

PROFILE, REFERENCE = load_sensor("pleiades-degraded"), load_sensor("pleiades-reference").nominal()
NOMINAL = PROFILE.nominal()
TABLE = ("nominal", "MTF 10%", "MTF 5%", "MTF 3%", "MTF 2%", "SNR 15 / 50", "SNR 90 / 190", "MTF 3%, SNR 15 / 50")

Restore = Callable[[np.ndarray, Sensor], np.ndarray]
"""Digital numbers (H, W) and the sensor that is told, to digital numbers of the reference."""


@dataclass(frozen=True)
class Case:
    """A sensor that acquires the images, and the one that is told."""

    name: str
    truth: Sensor
    told: Sensor


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="*", type=Path)
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--traditional", action="store_true", help="the chain too; slow")
    parser.add_argument("--wrong", action="store_true", help="told another sensor than the true one")
    arguments = parser.parse_args()
    methods = {path.stem: network(path) for path in arguments.weights}
    if arguments.traditional:
        methods["traditional"] = traditional
    scenes = one_of_each_site(arguments.images)
    columns = [f"mean over {len(simulated(scenes, NOMINAL))} images", "degraded", *methods]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for case in wrong_cases() if arguments.wrong else right_cases():
        scores = measure(case, list(methods.values()), scenes)
        print(f"| {case.name} | {' | '.join(f'{score:.2f}' for score in scores)} |", flush=True)


def right_cases() -> list[Case]:
    """Sensors of which the truth is told: those of the sweep, and one of two axes."""
    found = {each.name: each.sensor for each in conditions(NOMINAL, PROFILE)}
    uneven = replace(NOMINAL, mtf_nyquist=0.12, mtf_nyquist_along=0.05)
    chosen = {name: found[name] for name in TABLE} | {"MTF 12% across, 5% along": uneven}
    return [Case(name, sensor, sensor) for name, sensor in chosen.items()]


def wrong_cases() -> list[Case]:
    """The MTF, then the noise, told wrong."""
    mtf = {value: replace(NOMINAL, mtf_nyquist=value) for value in (0.03, 0.05, 0.07, 0.10)}
    alpha, beta = noise_from_snr(25, 30, 100, 80)
    noisy = replace(NOMINAL, alpha=alpha, beta=beta)
    pairs = [(0.07, 0.05), (0.07, 0.10), (0.05, 0.07), (0.03, 0.07)]
    found = [Case(f"MTF {truth:.0%}, told {told:.0%}", mtf[truth], mtf[told]) for truth, told in pairs]
    return [*found, Case("SNR 30 / 80, told 50 / 110", noisy, NOMINAL)]


def one_of_each_site(folder: Path) -> list[Scene]:
    """The first image of each site."""
    first: dict[str, Path] = {}
    for path in list_images(folder):
        first.setdefault(site_of(path.name), path)
    return [read_scene(path, REFERENCE) for path in first.values()]


def measure(case: Case, methods: Sequence[Restore], scenes: Sequence[Scene]) -> list[float]:
    """Mean PSNR of the degraded images, then of each method."""
    pairs = simulated(scenes, case.truth)
    ways: list[Restore] = [lambda dn, _: dn, *methods]
    return [float(np.mean([psnr(restore, pair, case.told) for pair in pairs])) for restore in ways]


def simulated(scenes: Sequence[Scene], sensor: Sensor) -> list[NamedPair]:
    """The pairs of a sensor; scenes too small for one are left out."""
    return simulate_pairs(list(scenes), Fixed(sensor), Fixed(REFERENCE.in_units_of(sensor)), 0)[0]


def psnr(restore: Restore, pair: NamedPair, told: Sensor) -> float:
    """Of one image, without the pixels that clipped."""
    return fidelity_db(restore(pair.degraded, told), pair.reference, pair.degraded)


def network(path: Path) -> Restore:
    """A network from its weights: told ones are folded for the sensor, plain ones hear nothing of it."""
    if is_told(path):
        weights = load_told(path)[0]
        return lambda dn, sensor: run(fold(weights, tell(sensor).vector), dn, sensor.max_dn)
    plain = network_for(path, None)[0]
    return lambda dn, sensor: run(plain, dn, sensor.max_dn)


def run(plain: ConvBEERS, dn: np.ndarray, max_dn: int) -> np.ndarray:
    """Through the network in float32, to whole digital numbers."""
    image: Tensor = torch.from_numpy(dn.astype(np.float32) / max_dn)[None, None]
    with torch.inference_mode():
        return np.asarray((plain(image)[0, 0] * max_dn).round().clamp(0, max_dn))


def traditional(dn: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The chain told the sensor."""
    return np.asarray(restore_traditional(torch.from_numpy(dn.astype(np.float32)), Chain(sensor, REFERENCE)))


if __name__ == "__main__":
    main()
