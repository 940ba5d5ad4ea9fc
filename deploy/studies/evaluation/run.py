"""`evaluate`: compare restorations on the same pairs, from names, networks and functions to rows
and a page.

The page has the tables, and the same crops of every method with their errors next to the reference.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image

from beers_deploy.conditioned_file import to_run_on
from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.pictures import (
    busiest_windows,
    error_row,
    grid,
    picture_url,
    stretch_of,
    strip_row,
)
from beers_deploy.model.metrics.statistics import too_few
from beers_deploy.model.pairs_recipe import read_pairs_recipe
from beers_deploy.model.raster.images import list_images
from beers_deploy.network import Network, NetworkLike
from beers_deploy.pairs import Pair
from beers_deploy.profiles.errors import ImageError, counted
from beers_deploy.profiles.figures import Row, by_table
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.untrusted import times
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.restoration.method import Restore
from beers_deploy.restoration.sensor_check.check import WINDOW_PX, check_windows
from beers_deploy.restoration.steps import Around
from beers_deploy.results import Input, Table
from beers_deploy.studies.evaluation import compression, scores, target_scenes, targets
from beers_deploy.studies.evaluation.methods import (
    Method,
    method_named,
    method_of,
    network_and_sensor,
)
from beers_deploy.studies.evaluation.pairs import (
    NamedPair,
    numbered_pairs,
    pairs_of_scenes,
    read_pairs,
    table_at,
)
from beers_deploy.studies.evaluation.sweep import run_sweep


@dataclass(frozen=True, repr=False, kw_only=True)
class Evaluation(Table):
    """The table of results of `evaluate`: scores of methods on the same pairs, as means, by site
    and by image, and under other sensors if requested.

    Attributes:
        sensors: the sensors of the degraded and of the reference images.
        methods: the compared methods, of which the first is the degraded input itself.
        pairs: the pairs of a degraded and a reference image that the methods restored.
    """

    sensors: tuple[Sensor, Sensor]
    methods: Sequence[Method]
    pairs: Sequence[NamedPair]

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write report.html and its pictures into a folder, and return the path of the page."""
        page = Path(folder) / "report.html"
        tables = []
        for name, rows in by_table(self.rows).items():
            # Tables of single images are only in the JSON document.
            if not name.startswith("images"):
                heading = HEADINGS.get(name, name)
                title = f"{heading[0].upper()}{heading[1:]}"
                captions = (text for start, text in CAPTIONS.items() if name.startswith(start))
                tables.append(Section(title, rows, next(captions)))
        strips = pictures(self.pairs, self.methods, page.parent)
        notes = (*NOTES, *self.notes)
        write_report(Report(self.title, headline(self.rows), tables, strips, notes), page)
        return page


def run_evaluation(
    *,
    methods: Mapping[str, NetworkLike | Restore],
    sensors: tuple[Sensor, Sensor],
    scenes: Path | None,
    pairs: Path | Sequence[Pair] | None,
    lpips: Path | None,
    factors: Sequence[float],
    rates: Sequence[float],
    sweep: bool,
    strict: bool,
    around: Around,
    seed: int,
) -> Evaluation:
    """Compare methods on the same pairs, and on targets whose truth is known.

    Args:
        methods: the compared methods by the name of their row: a name, a network, or a function
            from degraded to restored digital numbers (H, W).
        sensors: the sensors of the degraded and of the reference images.
        scenes: the folder of scenes to simulate pairs from; None for drawn scenes.
        pairs: the folder of stored pairs, or pairs in memory; None to simulate them.
        lpips: the file or folder of weights for LPIPS; None for the path in the environment.
        factors: the factors by which the radiance of scenes is multiplied; the first is 1.
        rates: the bits per pixel to which images are compressed before or after restoration.
        sweep: True to compare the methods also under sensors of other blur, noise and gain.
        strict: True to refuse stored pairs that contradict the sensor.
        around: the steps around networks that are used: exposures and the consistency step.
        seed: the seed of every random draw.

    Raises:
        BeersError: a method, an image or weights cannot be loaded, or stored pairs contradict the
            sensor and the option `strict` is set.
    """
    compared = [_method(name, source, sensors, around) for name, source in methods.items()]
    nominal = sensors[0].nominal()
    distances = scores.perceptual_distances(lpips)
    instruments = scores.Instruments(distances, nominal.max_dn, nominal.offset_dn)
    remarks = list[str]()
    sensor_rows = list[Row]()
    if pairs is None:
        loaded, remarks = pairs_of_scenes(scenes, *sensors, seed)
    elif isinstance(pairs, Path):
        loaded = read_pairs(pairs, nominal.max_dn, read_pairs_recipe(pairs))
        sensor_rows = [_sensor_row(loaded, sensors[0], str(pairs), strict)]
    else:
        loaded = numbered_pairs(pairs)
    rows = _compared(compared, loaded, sensors, instruments, seed)
    for factor in factors[1:]:
        dimmed, _ = pairs_of_scenes(scenes, *sensors, seed, factor)
        for method in compared:
            scored = scores.score(method, dimmed, instruments, seed)
            rows += [replace(row, table=table_at(factor, row.table)) for row in scored]
    compressed = compression.run_compression(compared, loaded, nominal, rates, seed)
    swept = list[Row]()
    for factor in factors if sweep else ():
        swept += run_sweep(compared, scenes, *sensors, seed, factor).rows
    # Images of one site resemble one another: sites are counted, not images.
    few = too_few(len({pair.site for pair in loaded}))
    notes = [note for note in (few, scores.inner_note(loaded), *remarks) if note]
    names = f"{sensors[0].name} -> {sensors[1].name}"
    every = (*_in_order([*rows, *scores.paper_rows()]), *sensor_rows, *compressed, *swept)
    return Evaluation(
        title=f"{names}, {counted(len(loaded), 'image')}",
        arguments={
            "sensor": sensors[0].name,
            "reference": sensors[1].name,
            "methods": ",".join(methods),
            "brightness": ",".join(f"{factor:g}" for factor in factors),
        },
        inputs=tuple(_inputs(methods, lpips, scenes, pairs)),
        rows=every,
        notes=tuple(notes),
        headings=HEADINGS,
        # Single images are for the document alone.
        details=frozenset({row.table for row in every if row.table.startswith("images")} | WORDY),
        sensors=sensors,
        methods=compared,
        pairs=loaded,
    )


HEADINGS = {"mean": "means over all pairs"}
WORDY = frozenset({"sensor"})
"""Words that are shown in detail only."""


def _compared(
    methods: Sequence[Method],
    pairs: Sequence[NamedPair],
    sensors: tuple[Sensor, Sensor],
    instruments: scores.Instruments,
    seed: int,
) -> list[Row]:
    """Return the rows of each method: mean, targets and images."""
    acquired = target_scenes.acquire_targets(sensors[0].nominal(), sensors[1].nominal(), seed)
    rows = list[Row]()
    for method in methods:
        mean, *images = scores.score(method, pairs, instruments, seed)
        figures = {**mean.figures, **targets.mean_figures(method, acquired)}
        rows += [replace(mean, figures=figures), targets.target_row(method, acquired), *images]
    return rows


def _in_order(rows: Iterable[Row]) -> list[Row]:
    """Sort rows by table: means, targets, sites, images. The rows of sites are computed here."""
    tables = by_table(rows)
    means = [table for name, table in tables.items() if name.startswith("mean")]
    images = [table for name, table in tables.items() if name.startswith("images")]
    sites = scores.site_rows(tables["images"])
    return [*chain(*means, tables[targets.TARGETS], sites, *images)]


def _sensor_row(pairs: Sequence[NamedPair], sensor: Sensor, name: str, strict: bool) -> Row:
    """Return the row that compares the degraded images with the sensor named for them."""
    # Every n-th pair, n rounded up, so that at most CHECKED_IMAGES of them are checked.
    sample = pairs[:: -(-len(pairs) // CHECKED_IMAGES)]
    windows = [pair.degraded[:WINDOW_PX, :WINDOW_PX] for pair in sample]
    check = check_windows(windows, sensor, sensor.nominal().max_dn)
    check.report(name, sensor.name, strict)
    return Row("sensor of the degraded images", sensor.name, check.figures, check.text)


def _inputs(
    methods: Mapping[str, NetworkLike | Restore],
    lpips: Path | None,
    scenes: Path | None,
    pairs: Path | Sequence[Pair] | None,
) -> Iterator[Path | Input]:
    """Yield the inputs of the figures: networks, weights of LPIPS, scenes or pairs."""
    for source in methods.values():
        if isinstance(source, Network):
            yield source.input
        elif isinstance(source, str | os.PathLike):
            # A shipped name is no file.
            file = Path(network_and_sensor(os.fspath(source))[0])
            if file.is_file():
                yield file
    if lpips is not None and lpips.is_file():
        yield lpips
    folders = [scenes] if scenes else []
    if isinstance(pairs, Path):
        folders = [pairs / "degraded", pairs / "reference"]
    yield from chain.from_iterable(map(list_images, folders))


def _method(
    name: str,
    source: NetworkLike | Restore,
    sensors: tuple[Sensor, Sensor],
    around: Around,
) -> Method:
    if isinstance(source, str):
        return replace(method_named(source, *sensors, around), name=name)
    # A module of torch is callable too, but it is a network and no function.
    if callable(source) and not isinstance(source, Network) and not hasattr(source, "state_dict"):

        def restore(image: np.ndarray) -> np.ndarray:
            restored = np.asarray(source(image))
            finite = restored.dtype.kind in "uif" and np.isfinite(restored).all()
            if restored.shape != image.shape or not finite:
                raise ImageError(
                    f"The function {name} must return an image of {times(image.shape)}, got "
                    f"{times(restored.shape) or 'no array'} of {restored.dtype}. Return one "
                    "finite real number for each pixel."
                )
            return restored

        return Method(name, restore, "what the function knows")
    network = Network.load(cast("NetworkLike", source), sensor=sensors[0])
    network = to_run_on(network, sensors[0])
    return method_of(name, network, *sensors, around)


SITES = 4
CROP_PX = 96
ZOOM = 2
CHECKED_IMAGES = 16
"""The largest number of images that are compared with the sensor."""


def strip_of(pair: NamedPair, methods: Sequence[Method]) -> tuple[np.ndarray, float]:
    """Draw the same crop of one pair as every method restores it and of the reference, with the
    absolute errors against the reference below.

    Returns:
        The picture (h, w) uint8, and the error in digital numbers that is shown white.
    """
    images = {method.name: method.restore(pair.degraded) for method in methods}
    images["reference"] = pair.reference
    side = min(CROP_PX, *pair.degraded.shape)
    top, left = busiest_windows(pair.reference, side)[0]
    crops = {name: image[top : top + side, left : left + side] for name, image in images.items()}
    errors = {name: np.abs(crop - crops["reference"]) for name, crop in crops.items()}
    # The degraded input sets the scale of the errors, so that all methods share it.
    white = max(float(np.percentile(errors[methods[0].name], 99)), 1.0)
    rows = [
        strip_row(crops.values(), stretch_of(crops["reference"])),
        error_row(errors.values(), white),
    ]
    return np.asarray(grid(list(crops), rows, ZOOM)), white


def pictures(pairs: Sequence[NamedPair], methods: Sequence[Method], out: Path) -> list[Picture]:
    """Draw a picture of crops, as `strip_of` does, of one pair of each of the first few sites, and
    write it to OUT/SITE.png.
    """
    by_site: dict[str, NamedPair] = {}
    for pair in pairs:
        by_site.setdefault(pair.site, pair)
    strips = []
    for pair in list(by_site.values())[:SITES]:
        strip, white = strip_of(pair, methods)
        with whole_file(out / f"{pair.site}.png") as temporary:
            Image.fromarray(strip).save(temporary, "PNG", optimize=True)
        caption = (
            f"{CROP_PX} pixels a side, enlarged {ZOOM} times, one grey scale for all. Below: size "
            f"of the error against the reference, black none, white {white:.0f} DN and more."
        )
        strips.append(Picture(pair.site, picture_url(strip), caption))
    return strips


MEAN_CAPTION = (
    "Intervals: 95 % bootstrap over sites for image figures, none below five sites; 90 % for the "
    "MTF. Each row states what its method knows of the sensor: one that knows it has an advantage "
    "that it may not have in orbit. Inner PSNR leaves out a border on every side. The bias of the "
    "mean is the mean of the restored inner pixels over that of the reference (without noise, "
    "where there is one) minus 1; the largest bias is that of one image."
)
DIMMED_CAPTION = (
    "The radiance of the scenes was multiplied by this factor before the sensors acquired them. "
    "MTF, SNR and targets do not depend on it."
)
TARGETS_CAPTION = (
    "Faint things whose truth is known, restored and compared with what the reference sensor would "
    "acquire without noise; 90 % intervals. Flux: the light that a point adds to the restored "
    f"image in a square of {targets.APERTURE_PX} pixels a side, over what it adds to the "
    "reference; 100 % is right. 'Points of 12 on 20' raise the mean radiance of one pixel by 12 "
    "W/m2/sr/um on a background of 20. Bars and zone plates, on a background of "
    f"{target_scenes.PATTERN_BACKGROUND:g} W/m2/sr/um: the contrast that is left, as a share of "
    "the reference's; 1 is as the reference, 0 is nothing, below 0 is reversed. Their name has the "
    "contrast of the scene (amplitude over background). Zone plates are measured from "
    f"{target_scenes.ZONE_BAND[0]} to {target_scenes.ZONE_BAND[1]} cycles per pixel."
)
GAIN_CAPTION = (
    "Inner PSNR against the reference, without its noise where that is known. On board: restored, "
    "then compressed by JPEG 2000. On the ground: compressed to the same rate, then restored with "
    "a sensor profile that has more noise: a share of the mean squared error of compression is "
    "added to the variance. The share is the one that is best on the other sites."
)
LOSSLESS_CAPTION = "Bits per pixel of lossless JPEG 2000, of the raw and of the restored images."
SITES_CAPTION = (
    "PSNR is over full scale and leaves out pixels that clipped in the input or the reference. The "
    "bias of the mean is that of inner pixels against the reference."
)
SWEEP_CAPTION = (
    "One image of each site. The pipeline and every network that can know a sensor have the row's "
    "profile, unless the row states that another one is supposed. Intervals of gains and losses "
    "are those of the differences on the same images."
)
CAPTIONS = {
    "mean,": DIMMED_CAPTION,
    "mean": MEAN_CAPTION,
    targets.TARGETS: TARGETS_CAPTION,
    compression.GAIN: GAIN_CAPTION,
    compression.LOSSLESS: LOSSLESS_CAPTION,
    "sweep": SWEEP_CAPTION,
    "": SITES_CAPTION,
}
"""Captions by the beginning of a table's name. The first one that fits is used."""
NOTES = (
    "MTF at Nyquist is measured on restored slanted edges.",
    (
        "SNR is measured in restored flat fields, where nothing is to be seen: a denoiser may "
        "reach any SNR there."
    ),
    (
        "The paper's rows were printed for another test set; its LPIPS network is not stated. They "
        "do not compare."
    ),
    "LPIPS-squeeze treats the panchromatic image as grey, values over full scale.",
)


def headline(rows: Sequence[Row]) -> str:
    """Return the sentence at the top of the page, which names the best method by mean PSNR and
    compares it with the degraded input.

    Args:
        rows: all rows of the evaluation; the first measured row of the table 'mean' is the input.
    """
    means = [row for row in rows if row.table == "mean"]
    ours = [row for row in means if row.figures["PSNR"].mode == "measured"]
    best = max(ours, key=lambda row: row.figures["PSNR"].value or 0.0)
    degraded = ours[0].figures["PSNR"]
    return (
        f"Best by PSNR: {best.name}, {best.figures['PSNR']} dB; the degraded input has "
        f"{degraded} dB (measured)."
    )
