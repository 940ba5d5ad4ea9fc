"""How often an image is told apart from the sensor that it is wrongly said to be from, and how
often a right one is.

    python benchmarks/sensor_check.py --images aerial-test/ [--raw pleiades/] [--acquisitions 40]

Each acquisition draws a sensor and a photograph; the image is compared with the right profile, and
each way to be wrong with the profile that a user would name for it. Textures without edges, and
towns, are drawn. Times are of 27 Mpx.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from characterize import LEAST_SIDE_PX, LIKE, RATIO, draw
from scipy.ndimage import gaussian_filter, shift

from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.model.simulator.acquire import acquire_padded, fitting_oversampling
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import crop_divisible, read_scene
from beers_deploy.network import Network
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.sensor_check.check import SensorCheck, check_source
from beers_deploy.studies.evaluation.methods import profile_of

BASE = Sensor.load("pleiades-degraded")
THIRD = 4 / 3
SIDE_PX = 2048
Image = np.ndarray


def stated(
    sensor: Instrument, mtf: float = 1.0, noise: float = 1.0, gain: float = 1.0, bits: int = 0
) -> Sensor:
    """The profile of a sensor, its MTF, noise, gain or bits off by a factor, or so many bits."""
    changed = replace(
        sensor,
        mtf_nyquist=sensor.mtf_nyquist * mtf,
        mtf_nyquist_along=sensor.mtf_axes[1] * mtf,
        alpha=sensor.alpha * noise**2,
        beta=sensor.beta * noise**2,
        gain_dn_per_radiance=sensor.gain_dn_per_radiance * gain,
        bits=bits or sensor.bits,
    )
    return profile_of(changed, BASE)


def restored(image: Image, sensor: Instrument) -> Image:
    """By the shipped network, conditioned on the sensor."""
    network = Network.load("convbeers-xs-int8", sensor=stated(sensor))
    output = network(image[None, None].astype(np.float32) / sensor.max_dn)[0, 0]
    return np.asarray(np.clip(np.rint(output * sensor.max_dn), 0, sensor.max_dn))


def resampled(image: Image, _: Instrument) -> Image:
    """Half a pixel aside, bilinear, rounded: as an orthorectification does."""
    return np.asarray(np.rint(shift(image.astype(np.float64), 0.5, order=1, mode="nearest")))


def smoothed(image: Image, _: Instrument) -> Image:
    """By a slight Gaussian filter."""
    return np.asarray(np.rint(gaussian_filter(image.astype(np.float64), 0.6)))


WRONG: Mapping[str, Callable[[Instrument], Sensor]] = {
    "MTF a third less": lambda s: stated(s, mtf=1 / THIRD),
    "MTF a third more": lambda s: stated(s, mtf=THIRD),
    "SNR a third less": lambda s: stated(s, noise=THIRD),
    "SNR a third more": lambda s: stated(s, noise=1 / THIRD),
    "gain halved": lambda s: stated(s, gain=2.0),
    "bits wrong, 14": lambda s: stated(s, bits=14, gain=4.0),
}
CHANGED: Mapping[str, Callable[[Image, Instrument], Image]] = {
    "restored": restored,
    "resampled": resampled,
    "smoothed": smoothed,
}


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--raw", type=Path, help="a folder of images, checked as Pleiades'")
    parser.add_argument("--acquisitions", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    counts: dict[str, list[bool]] = {}
    for sensor, image, kind in acquisitions(
        arguments.images, arguments.acquisitions, arguments.seed
    ):
        for name, check in checks_of(image, sensor):
            counts.setdefault(f"{kind}: {name}", []).append(bool(check.warnings))
            if name == "right" and check.warnings:
                print(f"false alarm, {kind}, MTF {sensor.mtf_axes}: {check.warnings}")
    print("| image and stated sensor | contradicted | of |\n|---|---|---|")
    for name, flags in sorted(counts.items()):
        print(f"| {name} | {sum(flags)} | {len(flags)} |")
    for path in list_images(arguments.raw) if arguments.raw else ():
        with open_raster(path) as source:
            print(f"{path.name}: {check_source(source, [BASE], LIKE.max_dn)}")
    timed(image)


def checks_of(image: Image, sensor: Instrument) -> Iterator[tuple[str, SensorCheck]]:
    """The checks of one image against what is right, and what is wrong."""
    yield "right", check(image, stated(sensor))
    for name, profile in WRONG.items():
        wrong = profile(sensor)
        yield name, check(image, wrong, wrong.nominal().max_dn)
    for name, change in CHANGED.items():
        yield name, check(change(image, sensor).astype(np.uint16), stated(sensor))


def check(image: Image, sensor: Sensor, full_scale: float = LIKE.max_dn) -> SensorCheck:
    """Of an array (H, W)."""
    height_px, width_px = image.shape
    raster = Raster(1, height_px, width_px, image.dtype)
    return check_source(ArraySource(image[None], raster), [sensor], full_scale)


def acquisitions(folder: Path, count: int, seed: int) -> Iterator[tuple[Instrument, Image, str]]:
    """A sensor, an image of it, and what it shows: photographs, and as many textures and drawn
    towns.
    """
    generator = np.random.default_rng(seed)
    scenes = [read_scene(path, LIKE) for path in list_images(folder)]
    scenes = [
        scene for scene in scenes if fitting_oversampling(scene.radiance, [RATIO], LEAST_SIDE_PX)
    ]
    for number in range(count):
        sensor = draw(generator)
        scene = scenes[int(generator.integers(len(scenes)))]
        radiance = crop_divisible(scene.radiance, RATIO)
        yield sensor, seen(radiance, sensor, number), "photograph"
        yield sensor, seen(texture(generator), sensor, number), "texture"
        yield (
            sensor,
            seen(procedural_scene(SIDE_PX, SIDE_PX, generator).radiance, sensor, number),
            "drawn town",
        )


def seen(radiance: np.ndarray, sensor: Instrument, number: int) -> Image:
    """What a sensor sees of a scene (H, W)."""
    return to_uint16(acquire_padded(radiance, sensor, RATIO, Draw(number), "degraded"))


def texture(generator: np.random.Generator, side_px: int = 1024) -> Image:
    """Radiance of a rough surface: Gaussian, its spectrum falling as 1 / f^p
    with p from 0.8 to 2.
    """
    f = np.hypot(np.fft.fftfreq(side_px)[:, None], np.fft.rfftfreq(side_px)[None])
    f[0, 0] = np.inf
    waves = generator.normal(size=(side_px, side_px // 2 + 1)) * np.exp(
        2j * math.pi * generator.random(f.shape)
    )
    field = np.fft.irfft2(waves / f ** generator.uniform(0.8, 2.0), (side_px, side_px))
    spread = generator.uniform(0.05, 0.3)
    return np.asarray(np.maximum(100 * (1 + spread * field / field.std()), 5), np.float32)


def timed(image: Image) -> None:
    """The time of a check of 27 Mpx."""
    tiled = np.tile(image, [-(-5196 // side) for side in image.shape])[:5196, :5196]
    started = time.perf_counter()
    check(tiled, BASE)
    print(f"27 Mpx: {time.perf_counter() - started:.2f} s")


if __name__ == "__main__":
    main()
