"""Measure how often `restore --sensor` warns correctly that an image is from another sensor, and
how often wrongly.

    python -m benchmarks.sensor_check --images aerial-test/ [--acquisitions 40]

Each acquisition draws a sensor and a photograph, a texture without edges, and a town. The image is
compared with the right profile and with wrong ones, and changed images are compared with the right
one.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, shift

import beers_deploy as bd
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.sensor_check.check import check_source
from beers_deploy.studies.evaluation.methods import profile_of
from benchmarks.acquisitions import acquired, as_source, draw_sensor, photographs, texture

BASE = Sensor.load("pleiades-degraded")
THIRD = 4 / 3
SIDE_PX = 2048


def profile(
    sensor: Instrument, mtf: float = 1, noise: float = 1, gain: float = 1, bits: int = 12
) -> Sensor:
    """Return the profile of a sensor with another bit depth, and with MTF, noise and gain off by a
    factor.
    """
    changed = replace(
        sensor,
        mtf_nyquist=sensor.mtf_nyquist * mtf,
        mtf_nyquist_along=sensor.mtf_axes[1] * mtf,
        alpha=sensor.alpha * noise**2,
        beta=sensor.beta * noise**2,
        gain_dn_per_radiance=sensor.gain_dn_per_radiance * gain,
        bits=bits,
    )
    return profile_of(changed, BASE)


PROFILES: Mapping[str, Callable[[Instrument], Sensor]] = {
    "the right sensor": profile,
    "MTF a third less": lambda sensor: profile(sensor, mtf=1 / THIRD),
    "MTF a third more": lambda sensor: profile(sensor, mtf=THIRD),
    "SNR a third less": lambda sensor: profile(sensor, noise=THIRD),
    "SNR a third more": lambda sensor: profile(sensor, noise=1 / THIRD),
    "gain halved": lambda sensor: profile(sensor, gain=2),
    "14 bits": lambda sensor: profile(sensor, bits=14, gain=4),
}


def changed(image: np.ndarray, sensor: Instrument) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the image (H, W) restored, resampled by half a pixel, and smoothed."""
    network = "convbeers-xs-int8"
    yield "restored", bd.restore(image, network=network, sensor=profile(sensor), progress=False)
    floats = image.astype(np.float64)
    yield "resampled", shift(floats, 0.5, order=1, mode="nearest")
    yield "smoothed", gaussian_filter(floats, 0.6)


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--acquisitions", type=int, default=40)
    parser.add_argument("--seed", type=int, default=2)
    arguments = parser.parse_args()
    scenes = photographs([arguments.images])
    generator = np.random.default_rng(arguments.seed)
    warnings = Counter[str]()
    for number in range(arguments.acquisitions):
        sensor = draw_sensor(generator)
        radiances = {
            "photograph": scenes[int(generator.integers(len(scenes)))].radiance,
            "texture": texture(generator),
            "drawn town": procedural_scene(SIDE_PX, SIDE_PX, generator).radiance,
        }
        for kind, radiance in radiances.items():
            image = acquired(radiance, sensor, number)
            for name, make in PROFILES.items():
                other = make(sensor)
                check = check_source(as_source(image), [other], other.nominal().max_dn)
                warnings[f"{kind} | {name}"] += bool(check.warnings)
            for name, pixels in changed(image, sensor):
                other_image = np.rint(pixels).astype(np.uint16)
                check = check_source(as_source(other_image), [profile(sensor)], sensor.max_dn)
                warnings[f"{kind} | {name}"] += bool(check.warnings)
    print(f"| image | stated or done | warnings in {arguments.acquisitions} |\n|---|---|---|")
    for name, count in warnings.items():
        print(f"| {name} | {count} |")


if __name__ == "__main__":
    main()
