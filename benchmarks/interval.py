"""The interval of `restore --interval`: calibrated for the shipped networks, and judged.

    python -m benchmarks.interval calibrate --images aerial-train/ aerial-train2/ [NAME ...]
    python -m benchmarks.interval judge --images aerial-test/ --plot interval.svg [NAME ...]

`calibrate` writes an interval into each float and INT8 file of `model/weights`, and into nothing
else of it. Each place is acquired by sensors of the trained family: the exponents are fitted on
places that the networks were trained on, the quantiles are taken from the places that their recipe
held out of the training.

`judge` prints tables of coverage by sensor, level and brightness, and draws the first
network's reliability. No named sensor was among those of the calibration.
"""

import argparse
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import onnx
from scipy.stats import spearmanr

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.interval import PixelInterval
from beers_deploy.model.interval_calibration import BORDER_PX, Sample, calibrated
from beers_deploy.model.io.files import sha256
from beers_deploy.model.levels import LEVELS, Level
from beers_deploy.model.raster.images import list_images, site_of
from beers_deploy.model.shipped import INT8, SHIPPED, shipped_names, shipped_weights
from beers_deploy.model.simulator.acquire import (
    acquire_three,
    fitting_oversampling,
    prepare_scene,
    scene_side_px,
)
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import read_scene
from beers_deploy.network import Network
from beers_deploy.profiles.errors import BeersError, ImageError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import load_onnx, metadata, save_onnx
from beers_deploy.quant.sensor_bank.conditioned import WEIGHTS
from beers_deploy.restoration.interval import interval_of
from beers_deploy.studies.evaluation.calibrate import write_with_interval
from benchmarks.self_check import NOMINAL as LIKE
from benchmarks.self_check import REFERENCE, block_means, restorer

FAMILY = SensorFamily(LIKE.nominal(), other_curves=0.3)
RECIPES = SHIPPED.parent / "recipes"

FITTED = 8
HELD_OUT = 20
"""Acquisitions of a place that networks were trained on, and of one that was held out of that."""
DARKEST = 0.05
"""The least radiance that half of the fitted acquisitions are dimmed to, so that the half-widths
follow the light. The held-out ones have full radiance: with dimmed ones among them, the interval
would cover less than 85 % at one of the places.
"""
CROP_PX = 160
"""The side of the window of a scene that is acquired, in pixels of the sensor."""
MIN_SIDE_PX = 2 * BORDER_PX + 64
OVERSAMPLINGS = (4, 2)
BLOCK_PX = 16
JUDGED = {
    "pleiades-degraded": LIKE,
    "pleiades-variable": Sensor.load("pleiades-variable"),
    "sharp and noisy": LIKE.replace(mtf_nyquist=0.12, snr_0=25, snr_1=60),
    "blurred and quiet": LIKE.replace(mtf_nyquist=0.03, snr_0=80, snr_1=180),
    "dior-medium": Sensor.load("dior-medium"),
    "dior-high": Sensor.load("dior-high"),
}
RADIANCES = (1.0, 0.25, 0.05)
BRIGHTNESS = (0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)
"""Limits of the pixels' brightness in the table, as shares of full scale."""


@dataclass(frozen=True)
class Acquired:
    """One acquisition of one place.

    Attributes:
        site: the place.
        sensor: the instrument that acquired it.
        raw: its image, (h, w).
        truth: what the reference sees without noise, (h, w).
    """

    site: str
    sensor: Instrument
    raw: np.ndarray
    truth: np.ndarray


def by_site(folders: Iterable[Path]) -> dict[str, list[Path]]:
    """Return the images of each place."""
    sites = dict[str, list[Path]]()
    for folder in folders:
        for path in list_images(folder):
            sites.setdefault(site_of(path.stem), []).append(path)
    return dict(sorted(sites.items()))


def acquired(
    path: Path,
    draw_sensor: Callable[[np.random.Generator], Instrument],
    seed: Sequence[int],
    crop_px: int | None = None,
    radiance: float = 1.0,
) -> Acquired | None:
    """Acquire a scene; None if it is too small.

    Args:
        path: of the photograph.
        draw_sensor: returns the sensor.
        seed: of sensor, crop and noise.
        crop_px: side of a window of the scene in pixels of the sensor; all of it if None.
        radiance: factor of the scene's.
    """
    generator = np.random.default_rng(seed)
    sensor = draw_sensor(generator)
    scene = read_scene(path, REFERENCE).radiance * np.float32(radiance)
    ratio = fitting_oversampling(scene, OVERSAMPLINGS, MIN_SIDE_PX)
    if ratio is None:
        return None
    if crop_px is not None:
        side = scene_side_px(crop_px, ratio)
        top, left = (int(generator.integers(max(size - side, 0) + 1)) for size in scene.shape)
        scene = scene[top : top + side, left : left + side]
    aim = REFERENCE.in_units_of(sensor)
    raw, _, truth = acquire_three(
        prepare_scene(scene, ratio), sensor, aim, Draw(int(generator.integers(1 << 30)))
    )
    return Acquired(site_of(path.stem), sensor, raw, truth)


def restored(name: str, image: Acquired) -> np.ndarray:
    """Restore an acquisition by a shipped network that knows its sensor."""
    return restorer(name, image.sensor)(image.raw)


def training_images(folders: Iterable[Path]) -> tuple[list[Acquired], list[Acquired]]:
    """Acquire places that networks were trained on, and places that were held out of that."""
    recipe = tomllib.loads((RECIPES / "convbeers-s.toml").read_text(encoding="utf-8"))
    parts: tuple[list[Acquired], list[Acquired]] = ([], [])
    for number, (site, paths) in enumerate(by_site(folders).items()):
        is_held_out = site in recipe["held_out"]
        count = HELD_OUT if is_held_out else FITTED
        for k in range(count):
            path = paths[k * len(paths) // count]
            dimmed = k % 2 == 1 and not is_held_out
            radiance = DARKEST ** np.random.default_rng((number, k)).random() if dimmed else 1.0
            image = acquired(path, FAMILY.draw, (number, k), CROP_PX, radiance)
            if image is not None:
                parts[is_held_out].append(image)
    return parts


def calibrate(names: Iterable[str], folders: Iterable[Path]) -> None:
    """Write the intervals of shipped networks, in float32 and INT8."""
    fitted, held_out = training_images(folders)
    print(f"{len(fitted)} acquisitions fitted, {len(held_out)} held out", flush=True)
    for name in names:
        intervals = {}
        for each in (name, f"{name}{INT8}"):
            samples = (
                [Sample.of(i.raw, restored(each, i), i.truth, i.sensor) for i in part]
                for part in (fitted, held_out)
            )
            intervals[each] = calibrated(*samples)
            print(each, intervals[each].to_json(), flush=True)
        weights = shipped_weights(name)
        write_with_interval(weights, intervals[name], weights)
        int8 = SHIPPED / f"{name}{INT8}.onnx"
        write_with_interval(int8, intervals[int8.stem], int8)
        # The INT8 file states the digest of the weights, which have an interval now.
        model = load_onnx(int8)
        onnx.helper.set_model_props(model, {**metadata(model), WEIGHTS: sha256(weights)})
        save_onnx(model, int8)


@dataclass(frozen=True)
class Judgement:
    """The errors and intervals of one acquisition, without its border and saturated pixels.

    Attributes:
        site: the place.
        scores: |error| over the half-width of each level, (levels, n).
        brightness: of the pixels, over full scale, (n,).
        blocks: mean half-width at 90 % and mean |error| of blocks, (2, blocks).
    """

    site: str
    scores: np.ndarray
    brightness: np.ndarray
    blocks: np.ndarray

    def coverage(self, level: Level) -> float:
        """Return the share of pixels within the interval."""
        return float((self.scores[LEVELS.index(level)] <= 1).mean())


def judgement(name: str, image: Acquired, interval: PixelInterval) -> Judgement:
    """Judge the interval of a network on one acquisition."""
    result = restored(name, image)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    error = np.abs(result.astype(np.float64) - image.truth)[inner]
    mask = np.ones(result.shape, bool)
    scale = image.sensor.max_dn
    widths = [
        interval.for_sensor(image.sensor, scale, level).of(result, mask)[inner] for level in LEVELS
    ]
    counts = (image.raw < scale)[inner]
    scores = np.stack([error[counts] / width[counts] for width in widths])
    blocks = [block_means(each, BLOCK_PX).ravel() for each in (widths[LEVELS.index(90)], error)]
    return Judgement(image.site, scores, image.truth[inner][counts] / scale, np.stack(blocks))


def judgements(
    name: str, folders: Iterable[Path], sensor: Sensor, radiance: float = 1.0
) -> list[Judgement]:
    """Judge a network on all images of some folders, each acquired by a draw of a profile."""
    interval = interval_of(Network.load(name, sensor=LIKE))
    results = []
    for number, path in enumerate(chain.from_iterable(by_site(folders).values())):
        image = acquired(path, sensor.draw, (number,), radiance=radiance)
        if image is not None and (image.raw < image.sensor.max_dn).any():
            results.append(judgement(name, image, interval))
    if not results:
        raise ImageError("Every image is too small or saturated. Give other images.")
    return results


def place_coverage(images: Sequence[Judgement], level: Level = 90) -> dict[str, float]:
    """Return the mean coverage of the images of each place."""
    sites = dict[str, list[float]]()
    for each in images:
        sites.setdefault(each.site, []).append(each.coverage(level))
    return {site: float(np.mean(values)) for site, values in sites.items()}


def line(name: str, images: Sequence[Judgement]) -> str:
    """Return the row of a table: coverage over places, and the rank correlation of blocks."""
    places = list(place_coverage(images).values())
    blocks = np.concatenate([each.blocks for each in images], axis=1)
    rank = spearmanr(*blocks).statistic
    width = np.mean([each.blocks[0].mean() for each in images])
    return (
        f"| {name} | {np.mean(places):.1%} | {min(places):.1%} | {max(places):.1%} | {rank:.3f} "
        f"| {width:.1f} |"
    )


def tables(name: str, folders: Sequence[Path], plot: Path | None) -> Iterator[str]:
    """Yield the lines of the tables of one network; draw its reliability."""
    by_sensor = {each: judgements(name, folders, sensor) for each, sensor in JUDGED.items()}
    yield "| sensor | mean of places | lowest | highest | rank correlation | half-width, DN |"
    yield from (line(each, judged) for each, judged in by_sensor.items())
    yield "| level | " + " | ".join(by_sensor) + " |"
    for level in LEVELS:
        means = [np.mean(list(place_coverage(j, level).values())) for j in by_sensor.values()]
        yield f"| {level} % | " + " | ".join(f"{mean:.1%}" for mean in means) + " |"
    nominal = by_sensor["pleiades-degraded"]
    yield "| brightness | pixels | coverage |"
    brightness = np.concatenate([each.brightness for each in nominal])
    within = np.concatenate([each.scores[LEVELS.index(90)] <= 1 for each in nominal])
    for low, high in pairwise(BRIGHTNESS):
        inside = (brightness >= low) & (brightness < high)
        if inside.any():
            yield f"| {low:g} to {high:g} | {inside.mean():.1%} | {within[inside].mean():.1%} |"
    for radiance in RADIANCES[1:]:
        dimmed = judgements(name, folders, LIKE, radiance)
        yield line(f"pleiades-degraded, radiance x {radiance:g}", dimmed)
    if plot is not None:
        draw(by_sensor, plot)


def draw(by_sensor: dict[str, list[Judgement]], plot: Path) -> None:
    """Draw coverage over level for each sensor: the mean of places, and the range of them."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(9, 6), sharex=True, sharey=True)
    for axis, (name, judged) in zip(axes.flat, by_sensor.items(), strict=True):
        places = np.array([list(place_coverage(judged, level).values()) for level in LEVELS])
        axis.plot([45, 100], [45, 100], color="0.6", linewidth=1)
        axis.fill_between(
            LEVELS, *(100 * end(places, axis=1) for end in (np.min, np.max)), alpha=0.25
        )
        axis.plot(LEVELS, 100 * places.mean(axis=1), marker="o", markersize=4)
        axis.set(title=name, xlim=(45, 101), ylim=(45, 101), aspect="equal")
        axis.grid(color="0.9")
    figure.supxlabel("level of the interval, %")
    figure.supylabel("pixels within it, %")
    figure.tight_layout()
    plt.rcParams["svg.hashsalt"] = "interval"
    figure.savefig(plot, metadata={"Date": None})


def main() -> None:
    """Calibrate or judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=("calibrate", "judge"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--images", type=Path, nargs="+", required=True)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    try:
        if arguments.task == "calibrate":
            calibrate(arguments.names or shipped_names(), arguments.images)
            return
        first, *others = arguments.names or [f"{shipped_names()[0]}{INT8}"]
        for text in tables(first, arguments.images, arguments.plot):
            print(text, flush=True)
        for name in others:
            print(line(name, judgements(name, arguments.images, LIKE)), flush=True)
    except BeersError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
