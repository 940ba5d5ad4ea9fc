"""An evaluation from pairs and methods to rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from deploy.defaults import load_scenes
from deploy.evaluation.methods import BLIND, TRAINED, Method
from deploy.evaluation.pairs import NamedPair, oversamplings_of, read_pairs, simulate_pairs
from deploy.evaluation.paper import paper_rows
from deploy.evaluation.recipe import PairsRecipe
from deploy.evaluation.scores import Instruments, score, site_rows
from deploy.evaluation.sweep import conditions, sweep_rows
from deploy.evaluation.targets import acquire_targets, target_figures
from deploy.progress import steps
from deploy.results import Row
from model.images import list_images, site_of
from profiles.sensor import Sensor, SensorProfile


@dataclass(frozen=True)
class Evaluation:
    """The rows of an evaluation: a mean a method and the paper's, a site each, an image each."""

    mean: tuple[Row, ...]
    sites: tuple[Row, ...]
    images: tuple[Row, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All of them."""
        return (*self.mean, *self.sites, *self.images)


def load_pairs(
    images: Path | None,
    pairs: Path | None,
    degraded: SensorProfile,
    reference: SensorProfile,
    seed: int,
    recipe: PairsRecipe | None = None,
) -> tuple[list[NamedPair], list[str]]:
    """Pairs from a folder of pairs, from a folder of scenes, or from drawn scenes; and scenes too small to use."""
    if pairs is not None:
        return read_pairs(pairs, degraded.nominal().max_dn, recipe), []
    scenes = load_scenes(images, reference.nominal(), seed)
    return simulate_pairs(scenes, degraded, reference, seed, oversamplings_of(degraded))


def evaluate_methods(
    methods: Sequence[Method], pairs: Sequence[NamedPair], instruments: Instruments, sensor: Sensor, seed: int
) -> Evaluation:
    """Score every method on every pair, and on targets acquired by `sensor`."""
    targets = acquire_targets(sensor, seed)
    means, images = [], []
    for method in methods:
        with steps(method.name, len(pairs)) as bar:
            mean, *rest = score(method, pairs, instruments, seed, bar.advance)
        figures = {**mean.figures, **target_figures(method, targets)}
        means.append(replace(mean, figures=figures))
        images += rest
    return Evaluation((*means, *paper_rows()), tuple(site_rows(images)), tuple(images))


def sweep_tables(
    methods: Sequence[Method],
    images: Path | None,
    degraded: SensorProfile,
    reference: SensorProfile,
    seed: int,
) -> tuple[Row, ...]:
    """PSNR and MTF of the networks and the chain under conditions other than the nominal ones; a scene a site."""
    scenes = load_scenes(images, reference.nominal(), seed)
    first = {site_of(scene.name): scene for scene in reversed(scenes)}
    networks = [method for method in methods if method.told in (BLIND, TRAINED)]
    with steps("sweep", len(conditions(degraded.nominal(), degraded))) as bar:
        return tuple(sweep_rows(networks, list(first.values()), degraded, reference, seed, bar.advance))


def input_files(
    methods: Sequence[str], images: Path | None, pairs: Path | None, lpips: Path | None
) -> tuple[Path, ...]:
    """The files that an evaluation's figures rest on: models, scenes or pairs, weights of LPIPS."""
    named = [path for path in (*map(Path, methods), *([lpips] if lpips else [])) if path.is_file()]
    folders = [images] if images else [pairs / role for role in ("degraded", "reference")] if pairs else []
    return (*named, *(path for folder in folders for path in list_images(folder)))
