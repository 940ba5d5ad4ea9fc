"""Run one study: variants, their measurements, points with their figures, a front and a
recommendation.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import cast

from beers_deploy.dpu.board import dpu_of
from beers_deploy.dpu.cost.model import Constants
from beers_deploy.model.metrics.perceptual import find_backbone
from beers_deploy.model.metrics.statistics import too_few
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.traditional.baselines import BASELINES
from beers_deploy.model.traditional.patch_groups import QUALITIES
from beers_deploy.network import Network, NetworkLike
from beers_deploy.performance.swath import PAPER_SIZE, Swath, parse_size
from beers_deploy.performance.tables import PAPER_TARGET, published_rows
from beers_deploy.performance.timing import interleaved
from beers_deploy.profiles.errors import ModelError, OptionError, counted
from beers_deploy.profiles.figures import Check, Row, predicted
from beers_deploy.profiles.figures import measured as measured_figure
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.graph import refusal
from beers_deploy.results import Input, Table, input_of
from beers_deploy.studies.evaluation.methods import Method, method_named, method_of
from beers_deploy.studies.evaluation.pairs import NamedPair, pairs_of_scenes
from beers_deploy.studies.tradeoff import advice
from beers_deploy.studies.tradeoff.front import PSNR, Comparison, Measured, front_rows, pareto_front
from beers_deploy.studies.tradeoff.measure import (
    ROUNDS,
    TILE_PX,
    Benchmark,
    Scores,
    make_int8,
    measure_host,
)
from beers_deploy.studies.tradeoff.page import Tradeoff
from beers_deploy.studies.tradeoff.points import (
    STANDARD,
    Point,
    Variant,
    board_figures,
    network_points,
    network_variants,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Study:
    """The checked options of `tradeoff`.

    Attributes:
        networks: shipped names, files, or networks in memory; float networks are also quantised.
        boards: the boards that are compared, each named once.
        sensors: the sensors of the degraded and of the reference images.
        scenes: the folder of scenes that no network was trained on; None draws scenes.
        lpips: the file or folder of weights for LPIPS; None reads the path from the environment.
        calibration: the folder of scenes on which float networks are quantised; None draws scenes.
        size: width and height in pixels of the swath whose time is predicted.
        budget: limits that the costs of the recommended point must keep.
        need: limits that its quality must reach.
        seed: the seed of every random draw.
    """

    networks: Sequence[NetworkLike]
    boards: Sequence[TargetProfile]
    sensors: tuple[Sensor, Sensor]
    scenes: Path | None
    lpips: Path | None
    calibration: Path | None
    size: tuple[int, int]
    budget: Sequence[advice.Constraint]
    need: Sequence[advice.Constraint]
    seed: int

    def __post_init__(self) -> None:
        twice = max(self.board_names, key=self.board_names.count)
        if self.board_names.count(twice) > 1:
            # The points of the two could not be told apart.
            raise OptionError(
                f"`target` must name each board once, but two are named {twice!r}. Leave one out."
            )
        for profile in self.boards:
            # A board without constants is refused before anything is measured.
            Constants.of(dpu_of(profile))

    @property
    def names(self) -> list[str]:
        """The names and paths of the networks, as they are given."""
        return [
            each.label if isinstance(each, Network) else os.fspath(cast(str, each))
            for each in self.networks
        ]

    @property
    def board_names(self) -> list[str]:
        """The names of the boards, in the given order."""
        return [profile.name for profile in self.boards]

    @property
    def arguments(self) -> dict[str, str]:
        """The arguments whose recorded text is normalised, by name; all others are recorded as
        typed.

        Limits are written with the full name of their figure and its unit, such as `board latency
        <= 20 s`.
        """
        sensor, reference = self.sensors
        return {
            "sensor": sensor.name,
            "reference": reference.name,
            "network": ",".join(self.names),
            "budget": ", ".join(map(str, self.budget)),
            "need": ", ".join(map(str, self.need)),
        }

    @property
    def inputs(self) -> tuple[Input, ...]:
        """All files that the figures depend on, with their digests."""
        files = [path for path in map(Path, self.names) if path.is_file()]
        for source in (self.scenes, self.calibration):
            files += list_images(source) if source else []
        backbone = find_backbone("squeeze", self.lpips)
        files += [backbone] if backbone else []
        return tuple(map(input_of, files))


def benchmark_of(study: Study) -> tuple[Benchmark, list[str]]:
    """Simulate the pairs of images on which all methods of a study are measured.

    Returns:
        The images with their metrics, and sentences for the reader on how they were simulated.
    """
    pairs, remarks = pairs_of_scenes(study.scenes, *study.sensors, study.seed)
    return Benchmark(pairs, *study.sensors, study.lpips, study.seed), remarks


def points_for(study: Study, quantize: Callable[[Network], Network]) -> list[Point]:
    """Return the operating points of a study, before they are measured.

    Args:
        study: the options.
        quantize: returns the INT8 network of a float one, or raises ModelError.
    """
    variants = network_variants(study.networks, study.sensors[0], quantize)
    whole = Swath(*study.size)
    of_networks = (network_points(variant, study.boards, whole) for variant in variants)
    # Networks in INT8 run on the DPUs of the boards, traditional pipelines on the boards'
    # processors, and float networks and methods of other libraries on this machine alone.
    traditional = [Variant(f"traditional-{quality}") for quality in QUALITIES]
    return [
        *chain.from_iterable(of_networks),
        *(Point(variant, board) for variant, board in product(traditional, study.boards)),
        *(Point(Variant(baseline)) for baseline in BASELINES),
    ]


def run_tradeoff(study: Study) -> Tradeoff:
    """Measure the quality of every operating point of a study, predict its time on the boards, and
    recommend one point.

    Raises:
        BeersError: a network or an image cannot be loaded, or a network does not fit the study.
    """
    # The digests are those of the files that are measured.
    inputs = study.inputs
    quantize = partial(
        make_int8, scenes=study.calibration, sensor=study.sensors[0], seed=study.seed
    )
    points = points_for(study, quantize)
    benchmark, remarks = benchmark_of(study)
    results = _measured(points, benchmark, Swath(*study.size))
    if PAPER_TARGET in study.board_names and study.size == parse_size(PAPER_SIZE):
        # The published rows are not corrected to these images, because the paper used others.
        for row in published_rows():
            figures = {f"board {key}": figure for key, figure in row.figures.items()}
            results.append(Measured(row.name, figures, {"board": PAPER_TARGET}))
    question = advice.Question(study.budget, study.need, Comparison(benchmark.sites, study.seed))
    notes = (*_notes(benchmark, study.board_names), *remarks)
    table = weigh(results, study.board_names, question, notes)
    return replace(table, arguments=study.arguments, inputs=inputs)


def require_quantizable(network: Network) -> Network:
    """Return a float network in place of its INT8 one, for a preview without quantising.

    Raises:
        ModelError: `quantize` would refuse the network.
    """
    reason = refusal(network.model)
    if reason:
        raise ModelError(reason)
    return network


PREVIEW_PX = 256
PREVIEW_RUNS = 3


def preview(study: Study) -> Table:
    """Return what a study would measure, and an estimate of its duration on this machine.

    Every method is timed on a small crop of the first image, and the time is scaled by the pixels.

    Returns:
        A table of one row: the numbers of points, methods and images, and the time in seconds.
    """
    benchmark, remarks = benchmark_of(study)
    # A float network stands for its INT8 one, because quantising would take too long here.
    points = points_for(study, require_quantizable)
    methods = _methods(points, benchmark)
    crop, reference = (
        image[:PREVIEW_PX, :PREVIEW_PX]
        for image in (benchmark.pairs[0].degraded, benchmark.pairs[0].reference)
    )
    small = replace(benchmark, pairs=[NamedPair("crop", crop, reference)])
    times = interleaved(
        [partial(small.score, method.restore) for method in methods.values()], PREVIEW_RUNS
    )
    crops = sum(pair.degraded.size for pair in benchmark.pairs) / crop.size
    # Each method is also timed on a tile, after a run to warm up.
    tiles = (1 + ROUNDS) * TILE_PX**2 / crop.size
    # A point with seams restores each image twice: in its tiles, and exactly.
    seams = Counter(point.variant for point in points if point.halo_px is not None)
    low_s = high_s = 0.0
    for variant, samples in zip(methods, times, strict=True):
        runs = (1 + 2 * seams[variant]) * crops + tiles
        times_s = [runs * time_s for time_s, _ in samples]
        low_s += min(times_s)
        high_s += max(times_s)
    counts = {"point": len(points), "method": len(methods), "image": len(benchmark.pairs)}
    figures = {
        f"{unit}s": measured_figure(count, unit, "the plan of the study")
        for unit, count in counts.items()
    }
    how = f"{PREVIEW_RUNS} runs of each method on a crop of {PREVIEW_PX} px, times the pixels"
    figures["time here"] = predicted((low_s + high_s) / 2, "s", (low_s, high_s), how)
    return Table(
        title="what a study of these options measures",
        arguments=study.arguments,
        inputs=study.inputs,
        rows=(Row("preview", "study", figures),),
        notes=tuple(remarks),
        headings={"preview": ""},
    )


def weigh(
    points: Sequence[Measured],
    boards: Sequence[str],
    asked: advice.Question,
    remarks: Sequence[str] = (),
) -> Tradeoff:
    """Compare measured operating points: find the front of quality against cost, the recommended
    point, and the best point of each board.

    Args:
        points: the measured points of all boards, and published runs.
        boards: the names of the boards.
        asked: the budget and the need.
        remarks: sentences for the reader on how the points were measured.
    """
    cost = asked.cost(points)
    best, line = advice.recommend(points, asked)
    # The front shows PSNR against one cost: a point that the budget excludes for another reason,
    # such as its power, would hide those that can be recommended.
    others = [constraint for constraint in asked.constraints if constraint.key not in (PSNR, cost)]
    front = pareto_front(advice.within(points, others, cost) or points, cost)
    numbered = front_rows(front, cost, asked.compare)
    by_board = advice.board_rows(points, boards, best, asked)
    # A single board has a sentence only if no point of it complies with the limits.
    sentences = [
        f"{row.name}: {row.text['point'] + ': ' if row.figures else ''}{row.text['verdict']}"
        for row in by_board
        if len(by_board) > 1 or not row.figures
    ]
    name = best.name if best else "none"
    figures = best.figures if best else {}
    every = (Row("points", point.name, point.figures, point.text) for point in points)
    rows = (Row("recommended", name, figures, {"line": line}), *by_board, *numbered, *every)
    fits = Check("points within budget and need", int(best is not None), 1, "point", "at least")
    return Tradeoff(
        command="tradeoff",
        title="what accuracy costs in time",
        rows=rows,
        checks=(fits,),
        notes=(line, *sentences, *remarks),
        details=frozenset({"recommended", "boards", "points"}),
        points=points,
        front=front,
        cost=cost,
        best=best,
        line=line,
        boards=tuple(boards),
        constraints=asked.constraints,
        remarks=tuple(remarks),
    )


def _measured(
    points: Sequence[Point],
    benchmark: Benchmark,
    swath: Swath,
) -> list[Measured]:
    """Measure quality and time here of every point, and predict its figures on the board."""
    methods = _methods(points, benchmark)
    results = list[Measured]()
    # Points of several boards may cut the images alike.
    scores_of: dict[tuple[Variant, int | None, tuple[int, ...]], list[Scores]] = {}
    with steps("tradeoff", len(points) + 1) as bar:
        for point in points:
            bar.advance(0, f"measuring {point.name}")
            method = methods[point.variant]
            key = point.variant, point.halo_px, benchmark.cuts(point)
            if key not in scores_of:
                scores_of[key] = benchmark.scores(point, method.restore)
            scores = scores_of[key]
            figures = benchmark.means(scores)
            halo = "exact" if point.halo_px is None else str(point.halo_px)
            text = {
                "board": point.board.name if point.board else "this machine",
                "configuration": point.dpu.name if point.dpu else "none",
                "tile": str(point.tile_px) if point.dpu else "none",
                "halo": halo if point.dpu else "none",
                "method": point.variant.method,
                "precision": point.variant.precision,
                "sensor": method.sensor_known,
            }
            results.append(Measured(point.name, figures, text, point, scores))
            bar.advance(1, point.name)
        host = measure_host(methods, benchmark)
        bar.advance(1, "timed on this machine")
    medians_s = {variant: times["host p50"].value or 1.0 for variant, times in host.items()}
    for point, result in zip(points, results, strict=True):
        here_s = medians_s[point.variant]
        # If the pipeline itself was not timed, the board's stated time is used as it is.
        slower = here_s / medians_s.get(Variant(STANDARD), here_s)
        runs = benchmark.runs(point) if point.dpu is not None else 1.0
        figures = host[point.variant] | board_figures(point, swath, slower, runs)
        if point.dpu is not None:
            figures["network runs"] = measured_figure(
                runs, "run/tile", "exposures that tiles of the images ask for"
            )
        result.figures.update(figures)
    return results


def _methods(points: Sequence[Point], benchmark: Benchmark) -> dict[Variant, Method]:
    """Return the method of each variant: a network with its exposures, or a traditional one."""
    sensors = benchmark.degraded, benchmark.reference
    return {
        variant: method_of(variant.name, variant.network, *sensors)
        if variant.network
        else method_named(variant.method, *sensors)
        for variant in dict.fromkeys(point.variant for point in points)
    }


def _notes(benchmark: Benchmark, boards: Sequence[str]) -> Iterator[str]:
    sites = len(set(benchmark.sites))
    names = ", ".join(boards)
    yield (
        f"No board was used: figures of {names} are predicted, but for the paper's, which are "
        "published."
    )
    yield (
        f"PSNR is the mean over {counted(len(benchmark.pairs), 'image')} of "
        f"{counted(sites, 'site')}; clipped pixels are left out."
    )
    yield (
        "Gains are differences on the same images from the next cheaper point of the front, with "
        "95 % bootstrap intervals over whole sites; one whose interval holds 0 is not significant."
    )
    if too_few(sites):
        yield too_few(sites)
    yield (
        "Exact halos give the same pictures in tiles of any size; smaller ones were measured "
        "in the point's tiles."
    )
    yield (
        "Board latency counts each exposure that a tile of these images needs; 'bench' counts one, "
        "or those of its --image."
    )
    yield (
        "The pipelines know both sensors; the table of all points (-v) states what each network "
        "knows of them."
    )
