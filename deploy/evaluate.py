"""An evaluation from names to rows and a report: what `beers-deploy evaluate` does between options and tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.methods import method_named
from deploy.networks import once
from deploy.report.evaluation_page import evaluation_report, pictures
from deploy.report.page import write_report
from model.evaluation.methods import Method
from model.evaluation.pairs import NamedPair, oversampling_note, profiles_for, read_pairs_recipe
from model.evaluation.run import Evaluation, evaluate_methods, load_pairs
from model.evaluation.scores import Instruments, perceptual_distances
from model.evaluation.sweep import sweep_tables
from model.metrics.bootstrap import LEAST_SITES
from profiles.figures import Row
from profiles.sensor import SensorProfile


@dataclass(frozen=True)
class EvaluationRequest:
    """What is compared, and on what.

    Attributes:
        names: of the methods, the degraded input first.
        images: folder of scenes to simulate pairs from; None for drawn ones.
        pairs: folder of pairs instead.
        sensor: profile of the degraded images, by name or file; None for the pairs' own, or the default one.
        reference: profile of the reference images, likewise.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones; None asks the environment.
        sweep: whether other blurs, noises and gains are looked at too.
        seed: of every random draw.
    """

    names: Sequence[str]
    images: Path | None
    pairs: Path | None
    sensor: str | None
    reference: str | None
    lpips: Path | None
    sweep: bool
    seed: int


@dataclass(frozen=True)
class EvaluationRun:
    """What an evaluation found.

    Attributes:
        sensors: profiles of the degraded and of the reference images.
        methods: as they were run.
        pairs: that they were run on.
        result: rows of means, sites and images.
        swept: rows of the sweep, where one was asked for.
        small: names of scenes that were too small to use.
    """

    sensors: tuple[SensorProfile, SensorProfile]
    methods: Sequence[Method]
    pairs: Sequence[NamedPair]
    result: Evaluation
    swept: Sequence[Row]
    small: Sequence[str]

    @property
    def title(self) -> str:
        """The two sensors, and how many images."""
        degraded, reference = self.sensors
        return f"{degraded.name} -> {reference.name}, {len(self.pairs)} image{'' if len(self.pairs) == 1 else 's'}"

    @property
    def sampling(self) -> str:
        """A sentence where pairs were simulated at another oversampling than the profile's; else nothing."""
        return oversampling_note(self.pairs, self.sensors[0])

    @property
    def notes(self) -> list[str]:
        """What a reader of the tables must know."""
        sites = len({pair.site for pair in self.pairs})
        few = f"no interval over sites is shown: of {sites}, fewer than {LEAST_SITES}, none could be trusted"
        left_out = f"left out, too small: {', '.join(self.small)}"
        said = ((few, sites < LEAST_SITES), (self.sampling, bool(self.sampling)), (left_out, bool(self.small)))
        return [note for note, holds in said if holds]

    def write(self, out: Path) -> Path:
        """Write report.html and the strips of pictures into a folder; returns the report's path."""
        strips, page = pictures(self.pairs, self.methods, out), out / "report.html"
        tables = self.result.mean, self.result.sites, self.swept
        write_report(evaluation_report(self.title, *tables, strips, self.sampling), page)
        return page


def run_evaluation(request: EvaluationRequest, say: Callable[[str], None]) -> EvaluationRun:
    """Score every method on the same pairs and targets.

    Args:
        request: methods and images.
        say: is told where a reference profile is taken in other units than it states.

    Raises:
        BeersError: a name, a file or a folder that is not what it should be.
    """
    recipe = read_pairs_recipe(request.pairs) if request.pairs is not None else None
    sensors = profiles_for(request.sensor, request.reference, recipe, say)
    degraded = sensors[0].nominal()
    told = once(say)
    methods = [method_named(name, *sensors, told) for name in request.names]
    instruments = Instruments(perceptual_distances(request.lpips), degraded.max_dn)
    pairs, small = load_pairs(request.images, request.pairs, *sensors, request.seed, recipe)
    result = evaluate_methods(methods, pairs, instruments, degraded, request.seed)
    swept = sweep_tables(methods, request.images, *sensors, request.seed) if request.sweep else ()
    return EvaluationRun(sensors, methods, pairs, result, swept, small)
