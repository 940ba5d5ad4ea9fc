"""`evaluate`: restorations compared on the same pairs, from names, networks and functions to rows and a report."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from beers_deploy.model.dataset import PairsRecipe, profiles_for, read_pairs_recipe
from beers_deploy.model.io.images import list_images
from beers_deploy.model.metrics.bootstrap import too_few
from beers_deploy.model.progress import Log, Progress, no_log, once, reporting
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.pairs import Pair
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.function import Restore, network_method
from beers_deploy.results import Table
from beers_deploy.studies.evaluation.methods import DEGRADED, Method, knowledge_of, method_named
from beers_deploy.studies.evaluation.pairs import NamedPair, pairs_of_scenes, read_pairs
from beers_deploy.studies.evaluation.scores import Instruments, paper_rows, perceptual_distances, score, site_rows
from beers_deploy.studies.evaluation.sweep import sweep_tables
from beers_deploy.studies.evaluation.targets import Targets, acquire_targets, target_figures

Methods = Mapping[str, NetworkLike | Restore] | Sequence[str]
"""Names of methods, or what restores by the name that it is listed under."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Evaluation(Table):
    """Methods compared on the same pairs: means, sites, images, and other sensors where they were asked for.

    Attributes:
        sensors: of the degraded and of the reference images.
        methods: as they were run.
        pairs: that they were run on.
        mean: a row a method, and the paper's.
        sites: a row a site.
        swept: rows of the sweep.
    """

    sensors: tuple[Sensor, Sensor]
    methods: Sequence[Method]
    pairs: Sequence[NamedPair]
    mean: Sequence[Row]
    sites: Sequence[Row]
    swept: Sequence[Row]

    @property
    def title(self) -> str:
        """The two sensors, and how many images."""
        degraded, reference = self.sensors
        return f"{degraded.name} -> {reference.name}, {len(self.pairs)} image{'' if len(self.pairs) == 1 else 's'}"

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write report.html and pictures into a folder; returns the page's path."""
        from beers_deploy.studies.evaluation.page import write_page  # which imports this module

        return write_page(self, Path(folder))


def evaluate(
    methods: Methods,
    pairs: Iterable[Pair] | str | os.PathLike[str] | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    sensor: SensorLike | None = None,
    reference: SensorLike | None = None,
    lpips: str | os.PathLike[str] | None = None,
    sweep: bool = False,
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
        seed: of every random draw.
        progress: a function that is told each step, False for silence, None for a bar or lines on standard error.
        log: is told where a reference is taken in other units than it states.

    Raises:
        OptionError: no such method.
        ImageError: pairs that cannot be read, or differ in size.
        ProfileError: no such sensor.
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
        instruments = Instruments(perceptual_distances(weights), sensors[0].nominal().max_dn)
        loaded, said = _pairs(made, folder, scenes, sensors, recipe, seed)
        mean, rows = _scored(ways, loaded, instruments, acquire_targets(sensors[0].nominal(), seed), seed)
        swept = sweep_tables(ways, scenes, *sensors, seed) if sweep else ()
    few = too_few(len({pair.site for pair in loaded}))
    arguments: dict[str, object] = {"images": images, "pairs": folder, "sensor": sensors[0].name, "lpips": lpips}
    arguments |= {"reference": sensors[1].name, "methods": ",".join(asked), "sweep": sweep, "seed": seed}
    sites = site_rows(rows)
    return Evaluation(
        "evaluate",
        arguments,
        tuple(_inputs(asked, weights, scenes, folder)),
        (*mean, *sites, *rows, *swept),
        notes=tuple([few, *said] if few else said),
        sensors=sensors,
        methods=ways,
        pairs=loaded,
        mean=mean,
        sites=sites,
        swept=swept,
    )


def _inputs(asked: Iterable[str], weights: Path | None, scenes: Path | None, pairs: Path | None) -> Iterator[Path]:
    """The files that the figures rest on: networks, weights of LPIPS, scenes or pairs."""
    yield from (path for path in (*map(Path, asked), *([weights] if weights else [])) if path.is_file())
    folders = [scenes] if scenes else [pairs / role for role in ("degraded", "reference")] if pairs else []
    yield from (path for folder in folders for path in list_images(folder))


def _pairs(
    made: Sequence[Pair] | None,
    folder: Path | None,
    scenes: Path | None,
    sensors: tuple[Sensor, Sensor],
    recipe: PairsRecipe | None,
    seed: int,
) -> tuple[list[NamedPair], list[str]]:
    if made is not None:
        return [_named(number, pair) for number, pair in enumerate(made)], []
    if folder is not None:
        return read_pairs(folder, sensors[0].nominal().max_dn, recipe), []
    return pairs_of_scenes(scenes, *sensors, seed)


def _named(number: int, pair: Pair) -> NamedPair:
    seen, meant = (image.astype(np.float32) for image in pair)
    return NamedPair(f"pair{number}", seen, meant, noise_free=pair.clean)


def _scored(
    methods: Sequence[Method], pairs: Sequence[NamedPair], instruments: Instruments, targets: Targets, seed: int
) -> tuple[list[Row], list[Row]]:
    mean, rows = list[Row](), list[Row]()
    for method in methods:
        scored, *each = score(method, pairs, instruments, seed)
        mean.append(replace(scored, figures={**scored.figures, **target_figures(method, targets)}))
        rows += each
    return [*mean, *paper_rows()], rows


def _method(name: str, given: NetworkLike | Restore, sensors: tuple[Sensor, Sensor], log: Log) -> Method:
    if isinstance(given, str):
        return replace(method_named(given, *sensors, log), name=name)
    if callable(given) and not isinstance(given, Network) and not hasattr(given, "state_dict"):
        return Method(name, given, "what the function knows")
    network = Network.load(cast("NetworkLike", given), sensor=sensors[0])
    known = knowledge_of(network.model, sensors[0].name)
    return Method(name, network_method(network.model, sensors[0].nominal().max_dn), known)
