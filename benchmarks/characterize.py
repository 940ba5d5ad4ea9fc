"""What `characterize` finds on simulated images of known sensors: errors, and how often the
intervals hold the truth.

    python benchmarks/characterize.py --images aerial-test/ --weights convbeers-s.safetensors

Each sensor sees twelve of the folder's photographs; then with a checkerboard laid into one of them
(60 m a side at 0.5 m, two by two fields, as calibration sites have), searched for and pointed at.
MTF 2 to 12 %, along the track down to 0.4 of that across, every other sensor with another curve
than the formula's (`model.curves`); noise as networks are trained for
(`model.family.SensorFamily`). With weights, a network told the profile that was written restores
one of the photographs, beside the same network told the truth.
"""

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tifffile
import torch

from beers_deploy.model.curves import draw_table
from beers_deploy.model.family import LEAST_ALONG, SensorFamily
from beers_deploy.model.metrics.fidelity import fidelity_db
from beers_deploy.model.metrics.instrument import AXES
from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.simulator.acquire import acquire, fitting_oversampling
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.mtf import mtf
from beers_deploy.model.simulator.sampling import Scene, crop_divisible, read_scene, scene_spectrum
from beers_deploy.parity import torch_network
from beers_deploy.profiles.errors import ImageError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.characterize import Measurement, Stated, measure, profile_toml
from beers_deploy.studies.characterize.profile import SHOWN_CPX
from beers_deploy.studies.evaluation.pairs import simulate_pairs

LIKE, REFERENCE = (
    Sensor.load(name).nominal() for name in ("pleiades-degraded", "pleiades-reference")
)
MTF_RANGE = (0.02, 0.12)
RATIO = 4
SCENES = 12
LEAST_SIDE_PX = 140
TARGET_PX = 120
LEAN_DEG = 7.0
DARK = 30.0
BRIGHT = 160.0


def main() -> None:
    """Print tables in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--sensors", type=int, default=20)
    parser.add_argument("--seed", type=int, default=22)
    parser.add_argument("--weights", type=Path, help="of a conditioned network")
    arguments = parser.parse_args()
    scenes = [read_scene(path, LIKE) for path in list_images(arguments.images)]
    scenes = [
        scene for scene in scenes if fitting_oversampling(scene.radiance, [RATIO], LEAST_SIDE_PX)
    ]
    ways = {
        name: Findings()
        for name in ("photographs alone", "one with a checkerboard", "two boxes on it")
    }
    losses_db = list[float]()
    generator = np.random.default_rng(arguments.seed)
    for number in range(arguments.sensors):
        sensor = draw(generator, shaped=number % 2 == 1)
        subset = [scenes[i] for i in generator.permutation(len(scenes))[:SCENES]]
        with tempfile.TemporaryDirectory() as folder:
            estimate = look(ways, sensor, subset, number, Path(folder))
            if arguments.weights is not None and estimate is not None:
                profile = Path(folder) / "found.toml"
                profile.write_text(profile_toml(estimate), encoding="utf-8")
                losses_db.append(
                    psnr_lost(
                        arguments.weights, subset[0], sensor, Sensor.load(str(profile)).nominal()
                    )
                )
    print("| figure | images | found | error, median | mean, signed | worst | in the interval |")
    print("|---|---|---|---|---|---|---|")
    for name, findings in ways.items():
        for line in findings.lines(name):
            print(line)
    if losses_db:
        print(
            f"\nPSNR lost, dB: mean {np.mean(losses_db):.3f}, median {np.median(losses_db):.3f}, "
            f"worst {max(losses_db):.3f}"
        )


def look(
    ways: dict[str, "Findings"],
    sensor: Instrument,
    scenes: Sequence[Scene],
    number: int,
    folder: Path,
) -> Measurement | None:
    """Characterise one sensor in each way; what was found where the checkerboard had to be searched
    for.
    """
    alone, searched, pointed = ways.values()
    alone.look(sensor, written(scenes, sensor, number, folder, None))
    target = max(range(len(scenes)), key=lambda i: min(scenes[i].radiance.shape))
    paths = written(scenes, sensor, number, folder, target)
    pointed.look(sensor, paths, boxes_on_target(paths[target]))
    return searched.look(sensor, paths)


def boxes_on_target(path: Path) -> tuple[str, str]:
    """The upper half of the upright edge, and the right half of the lying one."""
    height, width = tifffile.imread(path).shape
    upright = f"{path}:{width // 2 - 10},{height // 2 - 50},28,34"
    return upright, f"{path}:{width // 2 + 16},{height // 2 - 10},34,28"


def psnr_lost(weights: Path, scene: Scene, sensor: Instrument, estimate: Instrument) -> float:
    """By a network that knows the sensor that was found, beside the same that knows the true one,
    in dB.
    """
    (pair,), _ = simulate_pairs([scene], sensor, REFERENCE.in_units_of(sensor), 0)
    image = torch.from_numpy(pair.degraded.astype(np.float32) / sensor.max_dn)[None, None]
    scores = []
    for profile in (sensor, estimate):
        with torch.inference_mode():
            restored = torch_network(weights, profile)(image)[0, 0] * sensor.max_dn
        scores.append(
            fidelity_db(
                restored.round().clamp(0, sensor.max_dn).numpy(), pair.reference, pair.degraded
            )
        )
    return scores[0] - scores[1]


def draw(generator: np.random.Generator, shaped: bool) -> Instrument:
    """A sensor with the family's noise and an MTF of 2 to 12 %, its curve the
    formula's or another.
    """
    contrast = math.exp(generator.uniform(*np.log(MTF_RANGE)))
    along = max(contrast * LEAST_ALONG ** float(generator.uniform() ** 2), MTF_RANGE[0])
    sensor = replace(
        SensorFamily(LIKE).draw(generator), mtf_nyquist=contrast, mtf_nyquist_along=along
    )
    if not shaped:
        return sensor
    table = draw_table(contrast, along, generator)
    across, along = table.at_nyquist
    return replace(sensor, response=table, mtf_nyquist=across, mtf_nyquist_along=along)


def true_contrast(sensor: Instrument, axis: str, frequency: float) -> float:
    """The sensor's MTF at a frequency along one axis."""
    none = np.zeros((1, 1))
    place = np.full((1, 1), frequency)
    x, y = (place, none) if axis == "across" else (none, place)
    if sensor.response is not None:
        return float(abs(sensor.response.at(x, y)[0, 0]))
    return float(mtf(x, y, sensor.mtf_axes)[0, 0])


def written(
    scenes: Sequence[Scene], sensor: Instrument, number: int, folder: Path, target: int | None
) -> tuple[Path, ...]:
    """Acquisitions of the scenes as TIFF files, the checkerboard in the middle of one of them."""
    paths = []
    for index, scene in enumerate(scenes):
        radiance = crop_divisible(scene.radiance, RATIO)
        radiance = with_target(radiance) if index == target else radiance
        spectrum = scene_spectrum(radiance)
        seed = 100 * number + index
        dn = acquire(spectrum, radiance.shape[-1], sensor, RATIO, Draw(seed), "degraded")
        paths.append(folder / f"{index}.tif")
        tifffile.imwrite(paths[-1], to_uint16(dn))
    return tuple(paths)


def with_target(radiance: np.ndarray) -> np.ndarray:
    """The scene (H, W) with the checkerboard in its middle."""
    upright = slanted_edge(TARGET_PX, RATIO, LEAN_DEG, (-1.0, 1.0))
    board = (DARK + BRIGHT) / 2 + (BRIGHT - DARK) / 2 * upright * slanted_edge(
        TARGET_PX, RATIO, -LEAN_DEG, (-1, 1)
    ).T
    top, left = ((size - board.shape[0]) // 2 for size in radiance.shape)
    laid = radiance.copy()
    laid[top : top + board.shape[0], left : left + board.shape[1]] = board
    return laid


@dataclass
class Findings:
    """Relative error, and whether the interval held the truth, of each figure that was found."""

    contrasts: dict[str, list[tuple[float, bool]]] = field(
        default_factory=lambda: {words: [] for words in SHOWN_CPX}
    )
    snr: list[tuple[float, bool]] = field(default_factory=list)
    asked: int = 0

    def look(
        self, sensor: Instrument, paths: tuple[Path, ...], boxes: tuple[str, ...] = ()
    ) -> Measurement | None:
        """Characterise one sensor."""
        self.asked += 2
        try:
            estimate = measure(paths, boxes, Stated(sensor.bits, sensor.gain_dn_per_radiance))
        except ImageError as error:
            print(f"- {error}")
            return None
        for axis in AXES:
            curve = estimate.curves.get(axis)
            if curve is None:
                continue
            for words, frequency in SHOWN_CPX.items():
                value, interval = curve.at(frequency)
                self.contrasts[words].append(
                    judged(value, interval, true_contrast(sensor, axis, frequency))
                )
        for snr in estimate.snrs:
            self.snr.append(
                judged(snr.value, snr.interval, snr.radiance / sensor.noise_sigma(snr.radiance))
            )
        return estimate if estimate.curves else None

    def lines(self, name: str) -> Iterator[str]:
        """Rows of the table."""
        figures = {f"MTF {words}": pairs for words, pairs in self.contrasts.items()}
        for figure, pairs in {**figures, "SNR": self.snr}.items():
            if not pairs:
                yield f"| {figure} | {name} | 0 of {self.asked}, refused | | | | |"
                continue
            errors = np.array([error for error, _ in pairs])
            inside_count = sum(inside for _, inside in pairs)
            sizes = np.abs(errors)
            cells = (
                f"{np.median(sizes):.1%} | {errors.mean():+.1%} | {sizes.max():.1%} | "
                f"{inside_count} of {len(pairs)}"
            )
            yield f"| {figure} | {name} | {len(pairs)} of {self.asked} | {cells} |"


def judged(value: float, interval: tuple[float, float], true: float) -> tuple[float, bool]:
    """The relative error, with its sign, and whether the interval holds the truth."""
    return value / true - 1, interval[0] <= true <= interval[1]


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
