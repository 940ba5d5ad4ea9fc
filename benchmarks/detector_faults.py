"""How often the look for faults of detectors raises a false alarm, and what it detects.

    python benchmarks/detector_faults.py --images aerial-test/ --images aerial-train/ [--count 400]

Each image is seen by a sensor of the family that networks are trained for
(`model.family.SensorFamily`): photographs of the folders, random textures, drawn towns, and drawn
scenes whose edges, crops and roofs lie along the columns and rows; at 1/20 to twice the light, with
the sensor's noise or a fifth of it. Then faults are put into the photographs.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path

import numpy as np
from sensor_check import texture

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.model.simulator.acquire import acquire_padded, fitting_oversampling
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import Scene, crop_divisible, read_scene
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.detectors.look import BandFaults, look_at_detectors

LIKE = Sensor.load("pleiades-degraded").nominal()
LEAST_SIDE_PX = 140
SIDE_PX = 2048
RATIOS = (4, 2)
STACKED = 4
LIGHTS = (1.0, 1.0, 0.25, 0.05, 2.0)
NOISES = (1.0, 1.0, 0.2)
Image = np.ndarray


def main() -> None:
    """Print tables in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True, action="append")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--faulty", type=int, default=40)
    parser.add_argument("--seed", type=int, default=64)
    arguments = parser.parse_args()
    paths = chain.from_iterable(map(list_images, arguments.images))
    scenes = [read_scene(path, LIKE) for path in paths]
    scenes = [
        scene for scene in scenes if fitting_oversampling(scene.radiance, RATIOS, LEAST_SIDE_PX)
    ]
    clean = Counter[str]()
    alarms = Counter[tuple[str, str]]()
    worst = Counter[str]()
    for kind, image, sensor, words in acquisitions(scenes, arguments.count, arguments.seed):
        kinds = kinds_of(look(image, sensor))
        clean[kind] += 1
        worst[kind] += bool(kinds)
        alarms.update((kind, name) for name in kinds)
        if kinds:
            print(f"false alarm, {kind}, {words}: {kinds}", flush=True)
    print("| clean image | images | with a false alarm | of which |\n|---|---|---|---|")
    for kind, count in clean.items():
        words = ", ".join(f"{name} {n}" for (its, name), n in alarms.items() if its == kind)
        print(f"| {kind} | {count} | {worst[kind]} | {words or 'none'} |")
    print(f"| all | {clean.total()} | {worst.total()} | |\n", flush=True)
    detections(scenes, arguments.faulty, arguments.seed + 1)


def detections(scenes: Sequence[Scene], count: int, seed: int) -> None:
    """Print how many of the faults in photographs are detected: in single ones, and in strips of
    several.
    """
    generator = np.random.default_rng(seed)
    kinds = {"one photograph": 1, f"{STACKED} below one another": STACKED}
    counts = Counter[tuple[str, str]]()
    total = Counter[tuple[str, str]]()
    rows_px = dict[str, list[int]]()
    for number, kind in product(range(count), kinds):
        sensor = SensorFamily(LIKE).draw(generator)
        image = acquired(stacked(scenes, kinds[kind], generator), sensor, number, RATIOS[1])
        rows_px.setdefault(kind, []).append(len(image))
        for name, put in FAULTS.items():
            faulty, detected = put(image.astype(np.float64), sensor, generator)
            stored = np.clip(np.rint(faulty), 0, sensor.max_dn).astype(np.uint16)
            hits, of = detected(look(stored, sensor))
            counts[name, kind] += hits
            total[name, kind] += of
    heads = [f"{kind}, {np.median(rows_px[kind]):.0f} rows" for kind in kinds]
    print(f"| fault | put in, of each | {' | '.join(heads)} |\n|---|---|---|---|")
    for name in FAULTS:
        shares = [f"{counts[name, kind] / total[name, kind]:.0%}" for kind in kinds]
        print(f"| {name} | {total[name, next(iter(kinds))]} | {' | '.join(shares)} |")


def stacked(scenes: Sequence[Scene], count: int, generator: np.random.Generator) -> np.ndarray:
    """Return the radiance of photographs below one another, as wide as the narrowest of them."""
    radiances = [
        scenes[int(number)].radiance for number in generator.integers(len(scenes), size=count)
    ]
    width_px = min(radiance.shape[1] for radiance in radiances)
    return np.concatenate([radiance[:, :width_px] for radiance in radiances])


Detected = Callable[[BandFaults], tuple[int, int]]
Fault = Callable[[Image, Instrument, np.random.Generator], tuple[Image, Detected]]


def spread(rms: float) -> Fault:
    """Every column's gain off, by so much in the mean square."""

    def put(image: Image, _: Instrument, generator: np.random.Generator) -> tuple[Image, Detected]:
        gains = 1 + rms * generator.standard_normal(image.shape[1])
        return image * gains, lambda faults: (int(faults.columns.seen), 1)

    return put


def column(gain: float) -> Fault:
    """One column's gain off."""

    def put(image: Image, _: Instrument, generator: np.random.Generator) -> tuple[Image, Detected]:
        place = int(generator.integers(3, image.shape[1] - 3))
        faulty = image.copy()
        faulty[:, place] *= 1 + gain
        return faulty, lambda faults: (int(place in {line.index for line in faults.columns.off}), 1)

    return put


def dead_column(value: float) -> Fault:
    """One column of one value."""

    def put(
        image: Image, sensor: Instrument, generator: np.random.Generator
    ) -> tuple[Image, Detected]:
        place = int(generator.integers(3, image.shape[1] - 3))
        faulty = image.copy()
        faulty[:, place] = value * sensor.max_dn
        return faulty, lambda faults: (int(place in faults.columns.dead), 1)

    return put


def pixels(sigmas: float) -> Fault:
    """Ten pixels off by so many standard deviations of the noise; 0 is dead."""

    def put(
        image: Image, sensor: Instrument, generator: np.random.Generator
    ) -> tuple[Image, Detected]:
        faulty = image.copy()
        places = {tuple(generator.integers(3, side - 3) for side in image.shape) for _ in range(10)}
        for place in places:
            noise = (
                sensor.noise_sigma(image[place] / sensor.gain_dn_per_radiance)
                * sensor.gain_dn_per_radiance
            )
            faulty[place] = image[place] + sigmas * noise if sigmas else 0
        expected = {tuple(map(int, place)) for place in places}
        return faulty, lambda faults: (
            len(expected & set(map(tuple, faults.pixels.tolist()))),
            len(expected),
        )

    return put


FAULTS: Mapping[str, Fault] = {
    "gains of all columns, 0.5 % rms": spread(0.005),
    "gains of all columns, 1 % rms": spread(0.01),
    "gain of one column, 0.5 %": column(0.005),
    "gain of one column, 1 %": column(0.01),
    "gain of one column, 2 %": column(0.02),
    "dead column, 0": dead_column(0),
    "dead column, 1 % of full scale": dead_column(0.01),
    "dead column, full scale": dead_column(1),
    "dead pixels": pixels(0),
    "hot pixels, 5 sigma": pixels(5),
    "hot pixels, 10 sigma": pixels(10),
    "hot pixels, 20 sigma": pixels(20),
    "hot pixels, 50 sigma": pixels(50),
}


def acquisitions(
    scenes: Sequence[Scene], count: int, seed: int
) -> Iterator[tuple[str, Image, Instrument, str]]:
    """Clean images: what each shows, the image, its sensor, and words for both."""
    generator = np.random.default_rng(seed)
    kinds = ("photograph", "photograph", "texture", "drawn town", "drawn along the axes")
    for number in range(count):
        kind = kinds[number % len(kinds)]
        ratio = RATIOS[int(generator.integers(len(RATIOS)))]
        if kind == "photograph":
            scene = scenes[int(generator.integers(len(scenes)))]
            radiance = scene.radiance
            name = scene.name
            ratio = ratio if fitting_oversampling(radiance, [ratio], LEAST_SIDE_PX) else RATIOS[1]
        else:
            radiance = DRAWN[kind](generator)
            name = "drawn"
        sensor = SensorFamily(LIKE, other_curves=0.3).draw(generator)
        light, noise = (float(generator.choice(levels)) for levels in (LIGHTS, NOISES))
        quiet = replace(sensor, alpha=sensor.alpha * noise**2, beta=sensor.beta * noise**2)
        words = (
            f"number {number}, {name}, ratio {ratio}, light {light:g}, noise {noise:g}, MTF "
            f"{sensor.mtf_axes}"
        )
        yield kind, acquired(radiance * np.float32(light), quiet, number, ratio), quiet, words


def acquired(radiance: np.ndarray, sensor: Instrument, number: int, ratio: int) -> Image:
    """Return what a sensor sees of a scene (H, W)."""
    scene = np.ascontiguousarray(crop_divisible(radiance, ratio), np.float32)
    return to_uint16(acquire_padded(scene, sensor, ratio, Draw(number), "degraded"))


def along_the_axes(generator: np.random.Generator) -> np.ndarray:
    """Radiance of fields, crops, roofs and streets whose edges lie along columns and rows."""
    canvas = np.full((SIDE_PX, SIDE_PX), 80, np.float32)
    # Edges and streets run from side to side.
    for _ in range(int(generator.integers(2, 7))):
        start = int(generator.integers(SIDE_PX))
        width = int(generator.integers(1, 400))
        strip = (slice(None), slice(start, start + width))
        canvas[strip if generator.random() < 0.5 else strip[::-1]] = generator.uniform(10, 250)
    for _ in range(int(generator.integers(10, 60))):
        top, left = (int(generator.integers(SIDE_PX)) for _ in range(2))
        height, width = (int(generator.integers(20, 900)) for _ in range(2))
        part = canvas[top : top + height, left : left + width]
        part[:] = generator.uniform(10, 250)
        period = int(generator.integers(5, 60))
        share = generator.uniform(0.2, 0.8)
        lines = (np.arange(max(part.shape)) % period < share * period) * generator.uniform(
            -0.5, 1.0
        )
        # Stripes look like crops or the sheets of a roof.
        if generator.random() < 0.6:
            across = generator.random() < 0.5
            part *= 1 + (lines[None, : part.shape[1]] if across else lines[: part.shape[0], None])
    rough = texture(generator, SIDE_PX) / 100
    return np.asarray(canvas * (0.9 + 0.1 * rough), np.float32)


DRAWN: Mapping[str, Callable[[np.random.Generator], np.ndarray]] = {
    "texture": lambda generator: texture(generator, SIDE_PX),
    "drawn town": lambda generator: procedural_scene(SIDE_PX, SIDE_PX, generator).radiance,
    "drawn along the axes": along_the_axes,
}


def look(image: Image, sensor: Instrument) -> BandFaults:
    """Look at an array (H, W)."""
    height_px, width_px = image.shape
    raster = Raster(1, height_px, width_px, image.dtype)
    return look_at_detectors(ArraySource(image[None], raster), sensor.max_dn)[0]


def kinds_of(faults: BandFaults) -> list[str]:
    """Return the kinds of faults that are reported."""
    reported = {
        "columns' gains": faults.columns.seen,
        "rows' gains": faults.rows.seen,
        "single columns": faults.columns.off,
        "single rows": faults.rows.off,
        "dead columns": faults.columns.dead,
        "dead rows": faults.rows.dead,
        "patterns": [pattern for pattern in faults.patterns if pattern.seen],
        "pixels": len(faults.pixels),
    }
    return [kind for kind, any_ in reported.items() if any_]


if __name__ == "__main__":
    main()
