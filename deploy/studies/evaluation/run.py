"""An evaluation from names and folders to rows and a report: what `beers-deploy evaluate` does behind its options."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from beers_deploy.model.io.images import list_images
from beers_deploy.model.metrics.bootstrap import too_few
from beers_deploy.model.progress import Log, Progress, no_log, once, reporting
from beers_deploy.model.recipe import profiles_for, read_pairs_recipe
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
from beers_deploy.studies.evaluation.targets import acquire_targets, target_figures


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        sensors: profiles of the degraded and of the reference images.
        methods: as they were run.
        pairs: that they were run on.
        mean: a row a method, and the paper's.
        sites: a row a site.
        images: a row a method and image.
        swept: rows of the sweep, where one was asked for.
        said: what a reader must know of the pairs.
        inputs: the files that the figures rest on: models, weights of LPIPS, scenes or pairs.
    """

    sensors: tuple[Sensor, Sensor]
    methods: Sequence[Method]
    pairs: Sequence[NamedPair]
    mean: Sequence[Row]
    sites: Sequence[Row]
    images: Sequence[Row]
    swept: Sequence[Row]
    said: Sequence[str]
    inputs: Sequence[Path]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows: means, sites, images, the sweep."""
        return (*self.mean, *self.sites, *self.images, *self.swept)

    @property
    def title(self) -> str:
        """The two sensors, and how many images."""
        degraded, reference = self.sensors
        return f"{degraded.name} -> {reference.name}, {len(self.pairs)} image{'' if len(self.pairs) == 1 else 's'}"

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know."""
        few = too_few(len({pair.site for pair in self.pairs}))
        return [few, *self.said] if few else list(self.said)


Methods = Mapping[str, NetworkLike | Restore] | Sequence[str]
"""Names of methods, or what restores by the name that it is listed under."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Evaluated(Table):
    """Methods compared on the same pairs: means with intervals, sites, images.

    Attributes:
        found: the same with the methods and the pairs.
    """

    found: Evaluation

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write report.html and pictures into a folder; returns the page's path."""
        from beers_deploy.studies.evaluation.page import write_page  # which imports this module

        return write_page(self.found, Path(folder))


def evaluate(
    methods: Methods,
    pairs: Iterable[Pair] | str | os.PathLike[str] | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    sensor: SensorLike | None = None,
    reference: SensorLike | None = None,
    lpips: str | os.PathLike[str] | None = None,
    seed: int = 0,
    progress: Progress = None,
) -> Evaluated:
    """Compare restorations on the same pairs; the degraded input is always a row.

    Args:
        methods: names such as "traditional" or "convbeers-s-int8"; or a mapping of the name in the table to such a
            name, a network, or a function of an image (H, W) of digital numbers.
        pairs: simulated ones, or a folder with degraded/ and reference/; None simulates them.
        images: folder of scenes to simulate pairs from; drawn ones if None.
        sensor: of the degraded images; of pairs the one that made them, else the default one.
        reference: the sensor that is aimed at.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones, for LPIPS.
        seed: of every random draw.
        progress: a function that is told each step, False for silence, None for a bar or lines on standard error.

    Raises:
        OptionError: no such method.
        ImageError: pairs that cannot be read, or differ in size.
        ProfileError: no such sensor.
    """
    asked = methods if isinstance(methods, Mapping) else dict(zip(methods, methods, strict=True))
    made = None if pairs is None or isinstance(pairs, str | os.PathLike) else list(pairs)
    folder = Path(pairs) if isinstance(pairs, str | os.PathLike) else None
    if made and sensor is None:
        sensor, reference = made[0].profiles
    with reporting(progress):
        found = run_evaluation(
            {DEGRADED: DEGRADED, **asked},
            images=None if images is None else Path(images),
            pairs=folder if made is None else made,
            sensor=sensor,
            reference=reference,
            lpips=None if lpips is None else Path(lpips),
            seed=seed,
            say=no_log,
        )
    arguments: dict[str, object] = {"images": images, "pairs": folder, "sensor": found.sensors[0].name}
    arguments |= {"reference": found.sensors[1].name, "methods": ",".join(asked), "seed": seed}
    return Evaluated("evaluate", arguments, tuple(found.inputs), found.rows, notes=tuple(found.notes), found=found)


def _methods(given: Methods, sensors: tuple[Sensor, Sensor], log: Log) -> list[Method]:
    if not isinstance(given, Mapping):
        return [method_named(name, *sensors, log) for name in given]
    return [_method(name, each, sensors, log) for name, each in given.items()]


def _method(name: str, given: NetworkLike | Restore, sensors: tuple[Sensor, Sensor], log: Log) -> Method:
    if isinstance(given, str):
        return replace(method_named(given, *sensors, log), name=name)
    if callable(given) and not isinstance(given, Network) and not hasattr(given, "state_dict"):
        return Method(name, given, "what the function knows")
    network = Network.load(cast("NetworkLike", given), sensor=sensors[0])
    known = knowledge_of(network.model, sensors[0].name)
    return Method(name, network_method(network.model, sensors[0].nominal().max_dn), known)


def _named(pairs: Sequence[Pair]) -> list[NamedPair]:
    found = []
    for number, pair in enumerate(pairs):
        seen, meant = (image.astype(np.float32) for image in pair)
        found.append(NamedPair(f"pair{number}", seen, meant, noise_free=pair.clean))
    return found


def run_evaluation(
    names: Methods,
    *,
    images: Path | None = None,
    pairs: Path | Sequence[Pair] | None = None,
    sensor: SensorLike | None = None,
    reference: SensorLike | None = None,
    lpips: Path | None = None,
    sweep: bool = False,
    seed: int = 0,
    say: Callable[[str], None],
) -> Evaluation:
    """Score every method on the same pairs and targets.

    Args:
        names: of the methods, the degraded input first.
        images: folder of scenes to simulate pairs from; None for drawn ones.
        pairs: folder of pairs instead, or simulated ones.
        sensor: profile of the degraded images, by name or file; None for the pairs' own, or the default one.
        reference: profile of the reference images, likewise.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones; None asks the environment.
        sweep: whether other blurs, noises and gains are looked at too.
        seed: of every random draw.
        say: is told where a reference profile is taken in other units than it states.
    """
    recipe = read_pairs_recipe(pairs) if isinstance(pairs, Path) else None
    sensors = profiles_for(sensor, reference, recipe, say)
    degraded = sensors[0].nominal()
    told = once(say)
    methods = _methods(names, sensors, told)
    instruments = Instruments(perceptual_distances(lpips), degraded.max_dn)
    if pairs is None:
        loaded, said = pairs_of_scenes(images, *sensors, seed)
    elif isinstance(pairs, Path):
        loaded, said = read_pairs(pairs, degraded.max_dn, recipe), []
    else:
        loaded, said = _named(pairs), []
    named = [path for path in (*map(Path, names), *([lpips] if lpips else [])) if path.is_file()]
    folders = [images] if images else []
    folders += [pairs / role for role in ("degraded", "reference")] if isinstance(pairs, Path) else []
    inputs = [*named, *(path for folder in folders for path in list_images(folder))]
    mean, rows = [], list[Row]()
    targets = acquire_targets(degraded, seed)
    for method in methods:
        scored, *each = score(method, loaded, instruments, seed)
        mean.append(replace(scored, figures={**scored.figures, **target_figures(method, targets)}))
        rows += each
    swept = sweep_tables(methods, images, *sensors, seed) if sweep else ()
    return Evaluation(sensors, methods, loaded, [*mean, *paper_rows()], site_rows(rows), rows, swept, said, inputs)
