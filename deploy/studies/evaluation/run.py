"""`evaluate`: restorations compared on the same pairs, from names, networks and functions to rows and a page.

The page has the tables, and the same crops of every method with their errors beside the reference.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image

from beers_deploy.model.dataset import profiles_for, read_pairs_recipe
from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.images import list_images
from beers_deploy.model.io.pictures import busiest_windows, error_row, grid, picture_url, stretch_of, strip_row
from beers_deploy.model.metrics.bootstrap import too_few
from beers_deploy.model.progress import Log, Progress, no_log, once, reporting
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.pairs import Pair
from beers_deploy.profiles.figures import Row, by_table
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.restoration.engine import Restore, network_method
from beers_deploy.restoration.sensor_check import WINDOW_PX, held_against
from beers_deploy.results import Table
from beers_deploy.studies.evaluation import scores
from beers_deploy.studies.evaluation.methods import DEGRADED, Method, knowledge_of, method_named
from beers_deploy.studies.evaluation.pairs import NamedPair, pairs_of_scenes, read_pairs
from beers_deploy.studies.evaluation.sweep import run_sweep

Methods = Mapping[str, NetworkLike | Restore] | Sequence[str]
"""Names of methods, or what restores by the name that it is listed under."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Evaluation(Table):
    """Methods compared on the same pairs: means, sites, images, and other sensors where they were asked for.

    Attributes:
        sensors: of the degraded and of the reference images.
        methods: as they were run.
        pairs: that they were run on.
    """

    sensors: tuple[Sensor, Sensor]
    methods: Sequence[Method]
    pairs: Sequence[NamedPair]

    @property
    def title(self) -> str:
        """The two sensors, and how many images."""
        degraded, reference = self.sensors
        return f"{degraded.name} -> {reference.name}, {len(self.pairs)} image{'' if len(self.pairs) == 1 else 's'}"

    @property
    def mean(self) -> list[Row]:
        """A row a method, and the paper's."""
        return [row for row in self.rows if row.table == "mean"]

    @property
    def more(self) -> dict[str, list[Row]]:
        """The tables by site and of other sensors; those of single images are for the document alone."""
        return {name: rows for name, rows in by_table(self.rows).items() if name not in ("mean", "images")}

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write report.html and pictures into a folder; returns the page's path."""
        page = Path(folder) / "report.html"
        write_report(evaluation_report(self, pictures(self.pairs, self.methods, page.parent)), page)
        return page


def evaluate(
    methods: Methods,
    pairs: Iterable[Pair] | str | os.PathLike[str] | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    sensor: SensorLike | None = None,
    reference: SensorLike | None = None,
    lpips: str | os.PathLike[str] | None = None,
    sweep: bool = False,
    strict: bool = False,
    seed: int = 0,
    progress: Progress = None,
    log: Log = no_log,
) -> Evaluation:
    """Compare restorations on the same pairs and targets; the degraded input is always a row.

    Args:
        methods: names such as "traditional" or "convbeers-s-int8"; or a mapping of the name in the table to such a
            name, a network, or a function of an image (H, W) of digital numbers.
        pairs: simulated ones, or a folder with degraded/ and reference/; None simulates them.
        images: folder of scenes to simulate pairs from; drawn ones if None.
        sensor: of the degraded images; of pairs the one that made them, else the default one.
        reference: the sensor that is aimed at.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones, for LPIPS.
        sweep: whether other blurs, noises and gains are looked at too.
        strict: whether pairs are refused whose degraded images contradict the sensor, instead of a note.
        seed: of every random draw.
        progress: a function that is told each step, False for silence, None for a bar or lines on standard error.
        log: is told where a reference is taken in other units than it states.

    Raises:
        OptionError: no such method.
        ImageError: pairs that cannot be read, or differ in size.
        ProfileError: no such sensor.

    Examples:
        >>> pair = bd.simulate(size=96)
        >>> found = bd.evaluate({"mine": lambda image: image, "convbeers-xs": "convbeers-xs"}, [pair])
        >>> [row.name for row in found.mean][:3]
        ['degraded', 'mine', 'convbeers-xs']
    """
    asked = {DEGRADED: DEGRADED, **(methods if isinstance(methods, Mapping) else {name: name for name in methods})}
    folder = Path(pairs) if isinstance(pairs, str | os.PathLike) else None
    made = None if pairs is None or isinstance(pairs, str | os.PathLike) else list(pairs)
    if made and sensor is None:
        sensor, reference = made[0].profiles
    recipe = read_pairs_recipe(folder) if folder else None
    sensors = profiles_for(sensor, reference, recipe, log)
    scenes, weights = (None if path is None else Path(path) for path in (images, lpips))
    told = once(log)
    with reporting(progress):
        ways = [_method(name, each, sensors, told) for name, each in asked.items()]
        instruments = scores.Instruments(scores.perceptual_distances(weights), sensors[0].nominal().max_dn)
        said, seen = list[str](), list[Row]()
        if made is not None:
            loaded = [_named(number, pair) for number, pair in enumerate(made)]
        elif folder is not None:
            loaded = read_pairs(folder, sensors[0].nominal().max_dn, recipe)
            seen = [_seen(loaded, sensors[0], str(folder), strict, said.append)]
        else:
            loaded, said = pairs_of_scenes(scenes, *sensors, seed)
        targets, rows = scores.acquire_targets(sensors[0].nominal(), seed), list[Row]()
        for way in ways:
            mean, *each = scores.score(way, loaded, instruments, seed)
            rows += [replace(mean, figures={**mean.figures, **scores.target_figures(way, targets)}), *each]
        swept = run_sweep(ways, scenes, *sensors, seed).rows if sweep else []
    few = too_few(len({pair.site for pair in loaded}))
    arguments: dict[str, object] = {"images": images, "pairs": folder, "sensor": sensors[0].name, "lpips": lpips}
    arguments |= {"reference": sensors[1].name, "methods": ",".join(asked), "sweep": sweep, "seed": seed}
    tables = by_table([*rows, *scores.paper_rows()])
    return Evaluation(
        "evaluate",
        arguments,
        tuple(_inputs(asked, weights, scenes, folder)),
        (*tables["mean"], *scores.site_rows(tables["images"]), *tables["images"], *seen, *swept),
        notes=tuple([few, *said] if few else said),
        sensors=sensors,
        methods=ways,
        pairs=loaded,
    )


def _seen(pairs: Sequence[NamedPair], sensor: Sensor, name: str, strict: bool, log: Log) -> Row:
    """The degraded images held against the sensor that they are said to be from."""
    chosen = pairs[:: -(-len(pairs) // HELD)]
    windows = [pair.degraded[:WINDOW_PX, :WINDOW_PX] for pair in chosen]
    check = held_against(windows, sensor, sensor.nominal().max_dn).settled(name, sensor.name, strict, log)
    return Row("sensor of the degraded images", sensor.name, check.figures, check.text)


def _inputs(asked: Iterable[str], weights: Path | None, scenes: Path | None, pairs: Path | None) -> Iterator[Path]:
    """The files that the figures rest on: networks, weights of LPIPS, scenes or pairs."""
    yield from (path for path in (*map(Path, asked), *([weights] if weights else [])) if path.is_file())
    folders = [scenes] if scenes else [pairs / role for role in ("degraded", "reference")] if pairs else []
    yield from (path for folder in folders for path in list_images(folder))


def _named(number: int, pair: Pair) -> NamedPair:
    seen, meant = (image.astype(np.float32) for image in pair)
    return NamedPair(f"pair{number}", seen, meant, noise_free=pair.clean)


def _method(name: str, given: NetworkLike | Restore, sensors: tuple[Sensor, Sensor], log: Log) -> Method:
    if isinstance(given, str):
        return replace(method_named(given, *sensors, log), name=name)
    if callable(given) and not isinstance(given, Network) and not hasattr(given, "state_dict"):
        return Method(name, given, "what the function knows")
    network = Network.load(cast("NetworkLike", given), sensor=sensors[0])
    known = knowledge_of(network.model, sensors[0].name)
    return Method(name, network_method(network.model, sensors[0].nominal().max_dn), known)


SITES, CROP_PX, ZOOM = 4, 96, 2
HELD = 16
"""Images at most that are held against the sensor."""


def chosen_pairs(pairs: Sequence[NamedPair]) -> list[NamedPair]:
    """The first pair of each of the first few sites."""
    first = dict[str, NamedPair]()
    for pair in pairs:
        first.setdefault(pair.site, pair)
    return list(first.values())[:SITES]


def strip_of(pair: NamedPair, methods: Sequence[Method]) -> tuple[np.ndarray, float]:
    """Crops of every method and the reference, and below them the size of the errors.

    Returns:
        The picture (h, w) uint8, and the error in DN that is shown white.
    """
    images = {method.name: method.restore(pair.degraded) for method in methods}
    side = min(CROP_PX, *pair.degraded.shape)
    top, left = busiest_windows(pair.reference, side)[0]
    whole = {**images, "reference": pair.reference}
    crops = {name: image[top : top + side, left : left + side] for name, image in whole.items()}
    errors = {name: np.abs(crop - crops["reference"]) for name, crop in crops.items()}
    white = max(float(np.percentile(errors[methods[0].name], 99)), 1.0)
    rows = [strip_row(crops.values(), stretch_of(crops["reference"])), error_row(errors.values(), white)]
    return np.asarray(grid(list(crops), rows, ZOOM)), white


def pictures(pairs: Sequence[NamedPair], methods: Sequence[Method], out: Path) -> list[Picture]:
    """A strip for each of a few sites, also written to OUT/SITE.png."""
    made = []
    for pair in chosen_pairs(pairs):
        strip, white = strip_of(pair, methods)
        with whole_file(out / f"{pair.site}.png") as temporary:
            Image.fromarray(strip).save(temporary, "PNG", optimize=True)
        caption = (
            f"{CROP_PX} pixels a side, enlarged {ZOOM} times, one grey scale for all. Below: size of the error "
            f"against the reference, black none, white {white:.0f} DN and more."
        )
        made.append(Picture(pair.site, picture_url(strip), caption))
    return made


def evaluation_report(found: Evaluation, strips: Sequence[Picture]) -> Report:
    """The page: pictures, means, sites, and the sweep where there was one."""
    tables = [Section("Means over all pairs", found.mean, MEAN_CAPTION)]
    for name, rows in found.more.items():
        caption = SWEEP_CAPTION if name.startswith("sweep") else SITES_CAPTION
        tables.append(Section(f"{name[0].upper()}{name[1:]}", rows, caption))
    return Report(found.title, headline(found.mean), tables, strips, (*NOTES, *found.notes))


MEAN_CAPTION = (
    "Intervals: 95 % bootstrap over sites for image figures, none below five sites; 90 % for the MTF. What a "
    "method knows of the sensor stands beside it: one that knows it has an advantage that it may not have in orbit."
)
SITES_CAPTION = "Over full scale; from PSNR, pixels that clipped in the input or the reference are left out."
SWEEP_CAPTION = (
    "One image of each site. The chain and every network that can know a sensor know that of the row, unless it says "
    "that another one is supposed. Of gains and losses the interval is that of differences on the same images."
)
NOTES = (
    "MTF at Nyquist is measured on restored slanted edges.",
    "SNR is measured in restored flat fields, where nothing is to be seen: a denoiser may reach any SNR there.",
    "The paper's rows were printed for another test set; its LPIPS network is not stated. They do not compare.",
    "LPIPS-squeeze treats the panchromatic image as grey, values over full scale.",
)


def headline(mean: Sequence[Row]) -> str:
    """The best method by mean PSNR, in one sentence."""
    ours = [row for row in mean if row.figures["PSNR"].mode == "measured"]
    best = max(ours, key=lambda row: row.figures["PSNR"].value or 0.0)
    degraded = ours[0].figures["PSNR"]
    return f"Best by PSNR: {best.name}, {best.figures['PSNR']} dB; the degraded input has {degraded} dB (measured)."
