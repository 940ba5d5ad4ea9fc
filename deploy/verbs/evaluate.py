"""`evaluate`: several restorations on the same pairs, measured by the same instruments."""

import logging
import math
import os
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError, listed, printable
from beers_deploy.verbs.parameters import (
    Factors,
    Holds,
    InputPath,
    Interval,
    LabelledFolder,
    Methods,
    OutputFile,
    OutputFolder,
    Pairs,
    Progress,
    Seed,
    SensorLike,
)
from beers_deploy.verbs.verb import changed, path_or_none, refuse_with, refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.pairs import Pair
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.results import Table

logger = logging.getLogger(__name__)

METHODS = "degraded,traditional,deconvolve-first,convbeers-s,convbeers-s-int8"
PAGE = "report.html"


@verb
def evaluate(
    *,
    methods: Methods = METHODS,
    images: LabelledFolder | None = None,
    pairs: Pairs | None = None,
    sensor: SensorLike | None = None,
    reference: SensorLike | None = None,
    lpips: InputPath | None = None,
    out: Annotated[OutputFolder, Holds(PAGE, folders=("",))] | None = None,
    calibrate: OutputFile | None = None,
    sweep: bool = False,
    brightness: Factors = "1",
    bits_per_pixel: Factors | None = None,
    consistency: bool = True,
    exposure: bool = True,
    strict: bool = False,
    detector: InputPath | None = None,
    labels: LabelledFolder | None = None,
    split: str | None = None,
    side: Annotated[int, Interval(ge=32, le=4096)] | None = None,
    classes: str | None = None,
    seed: Seed = 0,
    progress: Progress = None,
) -> "Table":
    """Compare restorations with the reference, in the mean and by site.

    The tables have PSNR, SSIM and LPIPS, MTF and SNR on edges and flat fields, and on targets the
    flux of points and the contrast of faint detail: docs/explanation/reading-the-numbers.md says
    how they are measured. With a detector they have average precision, precision and recall, and
    the share of the loss that restoration regains.

    Args:
        methods: names, separated by commas: degraded is always a row. Shipped networks and the
            traditional methods use the sensor; NAME@blind uses none, NAME@SENSOR another one.
            In Python also a mapping of names to networks or functions of an image (H, W).
        images: folder of scenes to simulate from; drawn scenes by default.
        pairs: folder with degraded/ and reference/, as 'simulate' writes it; in Python also pairs.
        sensor: sensor of the degraded images: name or .toml file; by default the one that made the
            pairs, or pleiades-degraded. With a detector several, separated by commas.
        reference: sensor of the reference images; pleiades-reference by default.
        lpips: weights of SqueezeNet 1.1 for LPIPS-squeeze, or a folder of backbones.
        out: folder for report.html and pictures.
        calibrate: copy of the network's file to write, with the interval of 'restore --interval'
            fitted on these pairs; `methods` must be that file alone.
        sweep: also compare with the traditional pipeline, which takes most of the time, under 16
            sensors known exactly, and 7 known wrongly.
        brightness: also compare with the radiance of the scenes times these factors, such as
            0.25,0.05.
        bits_per_pixel: also compare restoration before and after JPEG 2000 compresses to this
            number of bits per pixel; several with commas.
        consistency: make results agree with the image at low frequencies, and smooth dark parts, if
            the sensor is given.
        exposure: restore dark parts and strong edges at other exposures (shipped networks).
        strict: fail instead of warning if pairs contradict the sensor.
        detector: ONNX detector as Ultralytics exports it, to run on the labelled images.
        labels: folder of VOC labels, or COCO's .json, of the images; next to them by default.
        split: use only the pictures that a list in the folder names, such as test.
        side: side of the detector's input in pixels, if its file leaves it open.
        classes: labelled classes by the detector's names: car=vehicle,minibus=vehicle.
        seed: seed of every random draw.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of means, sites and images; or of what the detector found.

    Raises:
        OptionError: no such method, or options that do not go together.
        ImageError: images, pairs or labels that cannot be read.
        ProfileError: no such sensor.

    Examples:
        >>> pair = bd.simulate(size=96)
        >>> methods = {"mine": lambda image: image, "convbeers-xs": "convbeers-xs"}
        >>> table = bd.evaluate(methods=methods, pairs=[pair])
        >>> [row.name for row in table.rows][:3]
        ['degraded', 'mine', 'convbeers-xs']
    """
    from beers_deploy.model.raster.images import list_images

    folder = path_or_none(out)
    options = partial(changed, evaluate, locals())
    if detector is not None:
        steps = ("consistency", "exposure", "strict")
        others = ("pairs", "lpips", "calibrate", "sweep", "brightness", "bits_per_pixel", *steps)
        refuse_with("`detector`", **options(*others))
        return _detection(
            methods,
            images,
            sensor,
            reference,
            Path(detector),
            labels,
            split,
            side,
            classes,
            seed,
            folder,
        )
    refuse_without("`detector`", **options("labels", "split", "side", "classes"))
    if pairs is None:
        refuse_without("`pairs`", **options("strict"))
    else:
        refuse_with("`pairs`", **options("images", "sweep", "brightness"))
    if images is not None:
        # An empty folder is refused before torch is loaded.
        list_images(Path(images))
    from beers_deploy.restoration.steps import Around
    from beers_deploy.studies.evaluation.calibrate import calibrate_network, network_to_calibrate
    from beers_deploy.studies.evaluation.run import run_evaluation

    given = _folder_or_pairs(pairs)
    named = named_methods(methods)
    sensors = _sensors(sensor, reference, given)
    rates = list[float]()
    if bits_per_pixel is not None:
        refuse_with("`methods` degraded", bits_per_pixel=len(named) == 1)
        rates = numbers_of("bits_per_pixel", bits_per_pixel, sensors[0].nominal().bits, "1,2,3")
    # All scenes are seen in their own light first.
    factors = dict.fromkeys([1.0, *numbers_of("brightness", brightness, 1, "0.25,0.05")])
    source = None if calibrate is None else network_to_calibrate(named, Path(calibrate))
    table = run_evaluation(
        methods=named,
        sensors=sensors,
        scenes=path_or_none(images),
        pairs=given,
        lpips=path_or_none(lpips),
        factors=list(factors),
        rates=rates,
        sweep=sweep,
        strict=strict,
        around=Around(consistency, exposure),
        seed=seed,
    )
    if source is not None and calibrate is not None:
        calibrate_network(table, *source, Path(calibrate))
    if folder is not None:
        logger.info("wrote %s", table.report(folder))
    return table


def named_methods(methods: Methods) -> dict[str, Any]:
    """Return the methods by the names of their rows, the degraded input first."""
    names = methods if isinstance(methods, Mapping) else listed(methods)
    if not all(isinstance(name, str) for name in names):
        raise OptionError(
            f"`methods` must be names, or a mapping of names to networks or functions, got "
            f"{printable(repr(methods))}."
        )
    if isinstance(methods, Mapping):
        return {"degraded": "degraded", **methods}
    # A method that is named twice is measured once, in the order that is given.
    return {name.strip(): name.strip() for name in ("degraded", *names)}


def numbers_of(name: str, value: Factors, most: float, example: str) -> list[float]:
    """Return the numbers of an option, which are numbers or text with commas, each once.

    Args:
        name: the name of the option.
        value: its value.
        most: the largest number that is accepted; all must be above 0.
        example: a valid value, for the error.
    """
    try:
        numbers = list(dict.fromkeys(map(float, listed(value))))
    except (TypeError, ValueError):
        # NaN lies within no limits, so the message below covers words as well.
        numbers = [math.nan]
    if not all(0 < number <= most for number in numbers):
        raise OptionError(
            f"`{name}` must be numbers above 0 and at most {most:g}, separated by commas, such as "
            f"{example}, got {value!r}."
        )
    return numbers


def _folder_or_pairs(pairs: "Pairs | None") -> "Path | list[Pair] | None":
    """Return the folder of stored pairs, or the pairs in memory, if there are any."""
    from beers_deploy.pairs import Pair

    if pairs is None:
        return None
    if isinstance(pairs, str | os.PathLike):
        return Path(pairs)
    several = list(pairs) if isinstance(pairs, Iterable) else [pairs]
    if not all(isinstance(pair, Pair) for pair in several):
        raise OptionError("`pairs` must be a folder, or a list of Pair as `simulate` returns them.")
    return several


def _sensors(
    sensor: SensorLike | None,
    reference: SensorLike | None,
    pairs: "Path | list[Pair] | None",
) -> "tuple[Sensor, Sensor]":
    """Return the sensors of the degraded and of the reference images."""
    from beers_deploy.model.pairs_recipe import profiles_for, read_pairs_recipe

    recipe = None
    if isinstance(pairs, Path):
        recipe = read_pairs_recipe(pairs)
    elif pairs and sensor is None:
        # Simulated pairs know the sensors that made them.
        sensor, own = pairs[0].profiles
        reference = own if reference is None else reference
    return profiles_for(sensor, reference, recipe)


def _detection(
    methods: Methods,
    images: InputPath | None,
    sensor: SensorLike | None,
    reference: SensorLike | None,
    detector: Path,
    labels: InputPath | None,
    split: str | None,
    side_px: int | None,
    classes: str | None,
    seed: int,
    out: Path | None,
) -> "Table":
    """Return the accuracy of a detector on labelled images, degraded and restored."""
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.studies.detection.detector import open_detector, parse_classes
    from beers_deploy.studies.detection.page import write_page
    from beers_deploy.studies.detection.study import labelled_scenes, run_study
    from beers_deploy.studies.detection.tables import detection_table

    if images is None:
        raise OptionError("`detector` needs `images`. Give the folder of labelled images.")
    if isinstance(methods, Mapping):
        raise OptionError("`methods` must be names with `detector`, but it is a mapping.")
    named = [sensor or SENSOR]
    if isinstance(sensor, str):
        # A sensor that is named twice is compared once.
        named = list(dict.fromkeys(listed(sensor)))
    network = open_detector(detector, side_px)
    scenes, notes = labelled_scenes(
        network.names,
        {} if classes is None else parse_classes(classes),
        Path(images),
        path_or_none(labels),
        split,
    )
    compared = run_study(
        network,
        scenes,
        [Sensor.load(each) for each in named],
        list(named_methods(methods)),
        reference=reference,
        seed=seed,
    )
    table = detection_table(compared, detector, network, scenes, notes)
    if out is not None:
        write_page(compared, table, out / PAGE)
        logger.info("wrote %s", out / PAGE)
    return table
