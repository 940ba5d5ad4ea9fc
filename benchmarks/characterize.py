"""Measure the errors of `characterize` on simulated images of known sensors, and how often its
intervals contain the truth.

    python -m benchmarks.characterize --images aerial-train/ --seed 7 --sensors 10

Each sensor sees twelve photographs, and then the same ones with a checkerboard placed in one of
them (60 m a side at 0.5 m, two by two fields, as calibration sites have). Every other sensor has an
MTF curve that differs from the formula's.
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import beers_deploy as bd
from beers_deploy.model.curves import draw_table
from beers_deploy.model.family import LEAST_ALONG, SensorFamily
from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.simulator.acquire import acquire_padded, fitting_oversampling
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.model.simulator.sampling import crop_divisible, read_scene
from beers_deploy.profiles.errors import BeersError, ImageError
from beers_deploy.profiles.figures import Figure
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.characterize.profile import SHOWN_CPX

LIKE = Sensor.load("pleiades-degraded").nominal()
RATIO = 4
"""Scene pixels per sensor pixel along each axis."""
MIN_SIDE_PX = 140
MTF_RANGE = (0.02, 0.12)
SCENES = 12
TARGET_PX = 120
LEAN_DEG = 7.0
DARK = 30.0
BRIGHT = 160.0


def draw_sensor(generator: np.random.Generator, other_curve: bool) -> Instrument:
    """Draw a sensor with the noise that networks are trained for and an MTF of 2 to 12 %."""
    across = math.exp(generator.uniform(*np.log(MTF_RANGE)))
    along = max(across * LEAST_ALONG ** float(generator.uniform() ** 2), MTF_RANGE[0])
    sensor = SensorFamily(LIKE).draw(generator)
    response = None
    if other_curve:
        response = draw_table(across, along, generator)
        across, along = response.at_nyquist
    return replace(sensor, response=response, mtf_nyquist=across, mtf_nyquist_along=along)


def acquired(radiance: np.ndarray, sensor: Instrument, number: int) -> np.ndarray:
    """Return the digital numbers (h, w) of an acquisition of a scene (H, W) by a sensor."""
    scene = np.ascontiguousarray(crop_divisible(radiance, RATIO), np.float32)
    return to_uint16(acquire_padded(scene, sensor, RATIO, Draw(number), "degraded"))


def with_checkerboard(radiance: np.ndarray) -> np.ndarray:
    """Return the scene (H, W) with the checkerboard in its middle."""
    upright = slanted_edge(TARGET_PX, RATIO, LEAN_DEG, (-1.0, 1.0))
    lying = slanted_edge(TARGET_PX, RATIO, -LEAN_DEG, (-1.0, 1.0)).T
    board = (DARK + BRIGHT) / 2 + (BRIGHT - DARK) / 2 * upright * lying
    top, left = ((size - board.shape[0]) // 2 for size in radiance.shape)
    laid = radiance.copy()
    laid[top : top + board.shape[0], left : left + board.shape[1]] = board
    return laid


def judged(
    figures: Mapping[str, Figure], sensor: Instrument
) -> Iterator[tuple[str, float, tuple[float, float], float]]:
    """Yield the name, value, interval and truth of each measured figure. Contrasts are in
    percent.
    """
    truths = dict[str, float]()
    for words, frequency in SHOWN_CPX.items():
        across = sensor_mtf([[frequency]], [[0.0]], sensor)
        along = sensor_mtf([[0.0]], [[frequency]], sensor)
        truths[f"MTF across {words}"] = 100 * float(abs(across[0, 0]))
        truths[f"MTF along {words}"] = 100 * float(abs(along[0, 0]))
    for name, figure in figures.items():
        if name.startswith("SNR at "):
            radiance = float(name.split()[2])
            truths[name] = radiance / sensor.noise_sigma(radiance)
        if name in truths and figure.value is not None and figure.interval is not None:
            # Both axes count as one row, and so do both radiances.
            row = "SNR" if name.startswith("SNR") else f"MTF {name.split(maxsplit=2)[2]}"
            yield row, figure.value, figure.interval, truths[name]


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--sensors", type=int, default=20)
    parser.add_argument("--seed", type=int, default=22)
    arguments = parser.parse_args()
    try:
        photographs = [read_scene(path, LIKE).radiance for path in list_images(arguments.images)]
    except BeersError as error:
        parser.error(str(error))
    scenes = [each for each in photographs if fitting_oversampling(each, (RATIO,), MIN_SIDE_PX)]
    if not scenes:
        parser.error(f"every image in {arguments.images} is too small. Give larger images.")
    generator = np.random.default_rng(arguments.seed)
    errors = defaultdict[str, list[float]](list)
    inside = defaultdict[str, list[bool]](list)
    for number in range(arguments.sensors):
        sensor = draw_sensor(generator, other_curve=number % 2 == 1)
        radiances = [scenes[k] for k in generator.permutation(len(scenes))[:SCENES]]
        images = [acquired(scene, sensor, 100 * number + k) for k, scene in enumerate(radiances)]
        largest = max(range(len(images)), key=lambda k: min(radiances[k].shape))
        board = with_checkerboard(radiances[largest])
        with_board = [*images]
        with_board[largest] = acquired(board, sensor, 100 * number + largest)
        ways = {"photographs alone": images, "one with a checkerboard": with_board}
        for way, frames in ways.items():
            try:
                profile = bd.characterize(
                    frames, bits=sensor.bits, gain=sensor.gain_dn_per_radiance, progress=False
                )
            except ImageError as error:
                print(f"- {error}")
                continue
            assert profile.table is not None  # noqa: S101 - a measured sensor has one
            figures = profile.table.rows[0].figures
            for name, value, (low, high), truth in judged(figures, sensor):
                errors[f"{name} | {way}"].append(value / truth - 1)
                inside[f"{name} | {way}"].append(low <= truth <= high)
    print("| figure | images | found | error, median | mean, signed | worst | in the interval |")
    print("|---|---|---|---|---|---|---|")
    for row, values in errors.items():
        sizes = np.abs(values)
        print(
            f"| {row} | {len(values)} of {2 * arguments.sensors} | {np.median(sizes):.1%} | "
            f"{np.mean(values):+.1%} | {sizes.max():.1%} | {sum(inside[row])} of {len(values)} |"
        )


if __name__ == "__main__":
    main()
