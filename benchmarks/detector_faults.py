"""Measure how often `restore` reports detector faults that do not exist, and which real ones it
detects.

    python -m benchmarks.detector_faults --images aerial-test/ --images aerial-train/ --faulty 25

Each image is seen by a sensor that networks are trained for. The scenes are photographs, random
textures, drawn towns, and drawn scenes whose edges lie along the columns and rows. The light is
1/20 to twice the nominal, with the sensor's noise or a fifth of it. Then faults are put into
photographs.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.simulator.acquire import fitting_oversampling
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.restoration.detectors.look import BandFaults, look_at_detectors
from benchmarks.acquisitions import (
    LEAST_SIDE_PX,
    LIKE,
    acquired,
    as_source,
    photographs,
    texture,
)

SIDE_PX = 2048
RATIOS = (4, 2)
STACKED = 4
"""The number of photographs that are stacked vertically."""
LIGHTS = (1.0, 1.0, 0.25, 0.05, 2.0)
NOISES = (1.0, 1.0, 0.2)
PIXELS = 10
"""The number of faulty pixels in an image."""


def along_the_axes(generator: np.random.Generator) -> np.ndarray:
    """Draw fields, crops, roofs and streets whose edges lie along columns and rows."""
    canvas = np.full((SIDE_PX, SIDE_PX), 80, np.float32)
    for _ in range(int(generator.integers(2, 7))):
        start, width = (int(generator.integers(most)) for most in (SIDE_PX, 400))
        # Streets run from side to side.
        across = canvas.T if generator.random() < 0.5 else canvas
        across[start : start + width] = generator.uniform(10, 250)
    for _ in range(int(generator.integers(10, 60))):
        top, left = generator.integers(SIDE_PX, size=2)
        height, width = generator.integers(20, 900, size=2)
        part = canvas[top : top + height, left : left + width]
        part[:] = generator.uniform(10, 250)
        # Stripes look like crops or the sheets of a roof.
        striped = part.T if generator.random() < 0.5 else part
        lines = np.arange(len(striped)) % generator.integers(5, 60) < generator.integers(2, 30)
        striped *= 1 + generator.uniform(-0.5, 1.0) * lines[:, None]
    return np.asarray(canvas * (0.9 + texture(generator, SIDE_PX) / 1000), np.float32)


DRAWN: Mapping[str, Callable[[np.random.Generator], np.ndarray]] = {
    "texture": lambda generator: texture(generator, SIDE_PX),
    "drawn town": lambda generator: procedural_scene(SIDE_PX, SIDE_PX, generator).radiance,
    "drawn along the axes": along_the_axes,
}


def look(image: np.ndarray, sensor: Instrument) -> BandFaults:
    """Detect faults in an image (H, W)."""
    return look_at_detectors(as_source(image), sensor.max_dn)[0]


def has_faults(faults: BandFaults) -> bool:
    """Return True if any fault is reported."""
    stripes = (faults.columns, faults.rows)
    lines = any(each.significant or each.off or each.dead for each in stripes)
    return (
        lines or any(pattern.significant for pattern in faults.patterns) or len(faults.pixels) > 0
    )


def false_alarms(scenes: Sequence[Scene], count: int, generator: np.random.Generator) -> None:
    """Print the number of clean images in which a fault is reported."""
    images = Counter[str]()
    alarms = Counter[str]()
    family = SensorFamily(LIKE, other_curves=0.3)
    for number, kind in enumerate(islice(cycle(["photograph", "photograph", *DRAWN]), count)):
        ratio = int(generator.choice(RATIOS))
        if kind in DRAWN:
            radiance = DRAWN[kind](generator)
        else:
            radiance = scenes[int(generator.integers(len(scenes)))].radiance
            ratio = fitting_oversampling(radiance, [ratio], LEAST_SIDE_PX) or min(RATIOS)
        sensor = family.draw(generator)
        noise = generator.choice(NOISES)
        sensor = replace(sensor, alpha=sensor.alpha * noise**2, beta=sensor.beta * noise**2)
        light = np.float32(generator.choice(LIGHTS))
        images[kind] += 1
        alarms[kind] += has_faults(look(acquired(radiance * light, sensor, number, ratio), sensor))
    print("| clean image | images | with a false alarm |\n|---|---|---|")
    for kind, total in images.items():
        print(f"| {kind} | {total} | {alarms[kind]} |", flush=True)


Fault = Callable[[np.ndarray, Instrument, np.random.Generator], float]
"""Put a fault into an image (H, W), and return the share of it that is detected."""


def look_at_stored(image: np.ndarray, sensor: Instrument) -> BandFaults:
    """Detect faults in an image of floats, after rounding it as it would be stored."""
    stored = np.clip(np.rint(image), 0, sensor.max_dn).astype(np.uint16)
    return look(stored, sensor)


def gains(
    rms: float, image: np.ndarray, sensor: Instrument, generator: np.random.Generator
) -> float:
    """Change every column's gain."""
    faulty = image * (1 + rms * generator.standard_normal(image.shape[1]))
    return float(look_at_stored(faulty, sensor).columns.significant)


def column(
    change: Callable[[np.ndarray], np.ndarray | float],
    image: np.ndarray,
    sensor: Instrument,
    generator: np.random.Generator,
) -> float:
    """Replace one column by `change` of it, in units of full scale. Return 1 if it is reported,
    else 0.
    """
    place = int(generator.integers(3, image.shape[1] - 3))
    image[:, place] = change(image[:, place] / sensor.max_dn) * sensor.max_dn
    columns = look_at_stored(image, sensor).columns
    return float(place in {line.index for line in columns.off} | set(columns.dead))


def pixels(
    sigmas: float, image: np.ndarray, sensor: Instrument, generator: np.random.Generator
) -> float:
    """Brighten single pixels by `sigmas` standard deviations of the noise, or make them dead if it
    is 0. Return the share of them that is reported.
    """
    places = generator.integers(3, np.array(image.shape) - 3, (PIXELS, 2))
    for place in map(tuple, places):
        gain = sensor.gain_dn_per_radiance
        brighter = image[place] + sigmas * gain * sensor.noise_sigma(image[place] / gain)
        image[place] = brighter if sigmas else 0
    reported = set(map(tuple, look_at_stored(image, sensor).pixels.tolist()))
    return float(np.mean([tuple(place) in reported for place in places.tolist()]))


FAULTS: Mapping[str, Fault] = {
    "gains of all columns, 0.5 % rms": partial(gains, 0.005),
    "gains of all columns, 1 % rms": partial(gains, 0.01),
    "gain of one column, 0.5 %": partial(column, lambda x: 1.005 * x),
    "gain of one column, 1 %": partial(column, lambda x: 1.01 * x),
    "gain of one column, 2 %": partial(column, lambda x: 1.02 * x),
    "dead column, 0": partial(column, lambda x: 0 * x),
    "dead column, 1 % of full scale": partial(column, lambda _: 0.01),
    "dead column, full scale": partial(column, lambda _: 1),
    "dead pixels": partial(pixels, 0),
    "hot pixels, 5 sigma": partial(pixels, 5),
    "hot pixels, 10 sigma": partial(pixels, 10),
    "hot pixels, 20 sigma": partial(pixels, 20),
    "hot pixels, 50 sigma": partial(pixels, 50),
}


def detections(scenes: Sequence[Scene], count: int, generator: np.random.Generator) -> None:
    """Print the share of the faults that is detected, in one photograph and in several stacked
    vertically.
    """
    print(f"| fault | one photograph | {STACKED} below one another |\n|---|---|---|")
    family = SensorFamily(LIKE)
    images = list[tuple[np.ndarray, ...]]()
    sensors = [family.draw(generator) for _ in range(count)]
    for number, sensor in enumerate(sensors):
        radiances = [scenes[int(k)].radiance for k in generator.integers(len(scenes), size=STACKED)]
        width_px = min(radiance.shape[1] for radiance in radiances)
        stacked = np.concatenate([radiance[:, :width_px] for radiance in radiances])
        both = (radiances[0], stacked)
        images.append(tuple(acquired(each, sensor, number, min(RATIOS)) for each in both))
    for name, put in FAULTS.items():
        shares = [
            [put(image.astype(np.float64), sensor, generator) for image in both]
            for both, sensor in zip(images, sensors, strict=True)
        ]
        alone, below = np.mean(shares, axis=0)
        print(f"| {name} | {alone:.0%} | {below:.0%} |", flush=True)


def main() -> None:
    """Print both tables in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True, action="append")
    parser.add_argument("--count", type=int, default=400, help="clean images")
    parser.add_argument("--faulty", type=int, default=40, help="images of each fault")
    parser.add_argument("--seed", type=int, default=64)
    arguments = parser.parse_args()
    scenes = photographs(arguments.images, *RATIOS)
    generator = np.random.default_rng(arguments.seed)
    false_alarms(scenes, arguments.count, generator)
    detections(scenes, arguments.faulty, generator)


if __name__ == "__main__":
    main()
