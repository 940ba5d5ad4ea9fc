"""An evaluation from pairs and methods to rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from model.evaluation.methods import Method
from model.evaluation.pairs import NamedPair, PairsRecipe, oversamplings_of, read_pairs, simulate_pairs
from model.evaluation.scores import Instruments, paper_rows, score, site_rows
from model.evaluation.targets import acquire_targets, target_figures
from model.io.images import list_images
from model.progress import steps
from model.simulator.procedural import load_scenes
from profiles.figures import Row
from profiles.sensor import Sensor, SensorProfile


@dataclass(frozen=True)
class Evaluation:
    """The rows of an evaluation: a mean a method and the paper's, a site each, an image each."""

    mean: tuple[Row, ...]
    sites: tuple[Row, ...]
    images: tuple[Row, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows: means, sites, images."""
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


def input_files(
    methods: Sequence[str], images: Path | None, pairs: Path | None, lpips: Path | None
) -> tuple[Path, ...]:
    """The files that an evaluation's figures rest on: models, scenes or pairs, weights of LPIPS."""
    named = [path for path in (*map(Path, methods), *([lpips] if lpips else [])) if path.is_file()]
    folders = [images] if images else [pairs / role for role in ("degraded", "reference")] if pairs else []
    return (*named, *(path for folder in folders for path in list_images(folder)))
