"""`tradeoff`: what accuracy costs in time, over many operating points."""

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError, listed
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    Holds,
    InputPath,
    Networks,
    OutputFolder,
    Progress,
    Seed,
    SensorLike,
    Size,
    Targets,
)
from beers_deploy.verbs.verb import path_or_none, refuse_with, verb

if TYPE_CHECKING:
    from beers_deploy.network import NetworkLike
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.results import Table
    from beers_deploy.studies.tradeoff.run import Study

logger = logging.getLogger(__name__)

PAPER_SIZE = "13600x9016"
FIGURES = "tradeoff.json"


STUDY = Holds(FIGURES, "tradeoff.html", "tradeoff.svg")


@verb
def tradeoff(
    *,
    out: Annotated[OutputFolder, STUDY] | None = None,
    images: InputPath | None = None,
    sensor: SensorLike = SENSOR,
    reference: SensorLike | None = None,
    network: Networks = "all",
    budget: str | None = None,
    need: str | None = None,
    lpips: InputPath | None = None,
    calibration: InputPath | None = None,
    target: Targets = DEFAULT_TARGET,
    size: Size = PAPER_SIZE,
    dry_run: bool = False,
    seed: Seed = 0,
    progress: Progress = None,
) -> "Table":
    """Find what accuracy costs in time, over networks and boards, and recommend a point.

    Networks and pipelines are measured on the same images, and their runs on boards are predicted.
    A line states for each board that is not recommended why it is not. The command exits with 1 if
    no point keeps the budget and the need; the page is written all the same.

    Args:
        out: folder of the page and the figures.
        images: folder of scenes to simulate from; drawn scenes by default.
        sensor: sensor of the degraded images: name or .toml file.
        reference: sensor of the reference images; pleiades-reference by default.
        network: separated by commas: shipped names, INT8 files, or float ONNX or safetensors files,
            which are quantised on the way; all stands for the shipped ones.
        budget: what you can afford, such as latency<=9s,power<=20W. The best PSNR wins.
        need: what you must reach, such as psnr>=44. Without a budget the least latency wins.
        lpips: weights of SqueezeNet 1.1 for LPIPS-squeeze, or a folder of backbones.
        calibration: folder of scenes to quantise your networks on; drawn scenes by default.
        target: board whose model predicts: name or .toml file; several with commas, or all.
        size: width x height of the swath in pixels.
        dry_run: print how much is measured and about how long that takes, and write nothing.
        seed: seed of every random draw.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of the points and the front. It is true if a point keeps the limits; `best` is the
        recommended one.

    Raises:
        OptionError: no such network, or limits that cannot be read.
        ImageError: images that cannot be read.
        ProfileError: no such sensor or board.
        ModelError: a network that cannot be tiled.

    Examples:
        >>> table = bd.tradeoff(network="convbeers-xs", budget="latency<=20s")
        >>> table.best.network.precision
        'int8'
    """
    from beers_deploy.dpu.board import boards_of
    from beers_deploy.performance.swath import parse_size
    from beers_deploy.profiles.reference import reference_for
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.studies.tradeoff.advice import parse_constraints

    if dry_run:
        refuse_with("`dry_run`", out=out is not None)
    networks = _networks(network)
    # Limits are read before torch is loaded.
    limits = parse_constraints("budget", budget), parse_constraints("need", need)
    folder = path_or_none(out)
    from beers_deploy.studies.tradeoff.run import Study, preview

    degraded = Sensor.load(sensor)
    study = Study(
        networks=[_loaded(each, degraded) for each in networks],
        boards=boards_of(target),
        sensors=(degraded, reference_for(degraded, reference)),
        scenes=path_or_none(images),
        lpips=path_or_none(lpips),
        calibration=path_or_none(calibration),
        size=parse_size(size),
        budget=limits[0],
        need=limits[1],
        seed=seed,
    )
    return preview(study) if dry_run else _run(study, folder)


def _networks(network: Networks) -> "list[NetworkLike]":
    """Return networks of one, several, or text with commas; "all" stands for the shipped ones."""
    from beers_deploy.model.shipped import shipped_names

    names: list[NetworkLike] = []
    several: list[Any] = [*network] if isinstance(network, list | tuple) else [network]
    for each in several:
        for name in listed(each) if isinstance(each, str) else [each]:
            names += shipped_names() if name == "all" else [name]
    if not names:
        raise OptionError("`network` names no network. Give a name, a file, or all.")
    # A name that is given twice is compared once.
    return [each for k, each in enumerate(names) if each not in names[:k]]


def _loaded(network: "NetworkLike", sensor: "Sensor") -> "NetworkLike":
    """Return a network in memory as a `Network`, and a name or a file as it is."""
    from beers_deploy.network import Network

    if isinstance(network, str | os.PathLike):
        return network
    return Network.load(network, sensor=sensor)


def _run(study: "Study", folder: Path | None) -> "Table":
    """Run a study, and write its page and figures into a folder."""
    from beers_deploy.studies.tradeoff.run import run_tradeoff

    table = run_tradeoff(study)
    if folder is not None:
        logger.info("wrote %s", table.report(folder))
        table.save(folder / FIGURES)
    return table
