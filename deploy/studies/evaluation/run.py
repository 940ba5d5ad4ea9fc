"""An evaluation from names and folders to rows and a report: what `beers-deploy evaluate` does behind its options."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from beers_deploy.model.io.images import list_images
from beers_deploy.model.metrics.bootstrap import too_few
from beers_deploy.model.progress import once
from beers_deploy.model.recipe import profiles_for, read_pairs_recipe
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation.methods import Method, method_named
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


def run_evaluation(
    names: Sequence[str],
    *,
    images: Path | None = None,
    pairs: Path | None = None,
    sensor: str | None = None,
    reference: str | None = None,
    lpips: Path | None = None,
    sweep: bool = False,
    seed: int = 0,
    say: Callable[[str], None],
) -> Evaluation:
    """Score every method on the same pairs and targets.

    Args:
        names: of the methods, the degraded input first.
        images: folder of scenes to simulate pairs from; None for drawn ones.
        pairs: folder of pairs instead.
        sensor: profile of the degraded images, by name or file; None for the pairs' own, or the default one.
        reference: profile of the reference images, likewise.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones; None asks the environment.
        sweep: whether other blurs, noises and gains are looked at too.
        seed: of every random draw.
        say: is told where a reference profile is taken in other units than it states.

    Raises:
        BeersError: a name, a file or a folder that is not what it should be.
    """
    recipe = read_pairs_recipe(pairs) if pairs is not None else None
    sensors = profiles_for(sensor, reference, recipe, say)
    degraded = sensors[0].nominal()
    told = once(say)
    methods = [method_named(name, *sensors, told) for name in names]
    instruments = Instruments(perceptual_distances(lpips), degraded.max_dn)
    if pairs is None:
        loaded, said = pairs_of_scenes(images, *sensors, seed)
    else:
        loaded, said = read_pairs(pairs, degraded.max_dn, recipe), []
    named = [path for path in (*map(Path, names), *([lpips] if lpips else [])) if path.is_file()]
    folders = [images] if images else [pairs / role for role in ("degraded", "reference")] if pairs else []
    inputs = [*named, *(path for folder in folders for path in list_images(folder))]
    mean, rows = [], list[Row]()
    targets = acquire_targets(degraded, seed)
    for method in methods:
        scored, *each = score(method, loaded, instruments, seed)
        mean.append(replace(scored, figures={**scored.figures, **target_figures(method, targets)}))
        rows += each
    swept = sweep_tables(methods, images, *sensors, seed) if sweep else ()
    return Evaluation(sensors, methods, loaded, [*mean, *paper_rows()], site_rows(rows), rows, swept, said, inputs)
