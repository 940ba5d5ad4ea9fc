"""One study: variants, what is measured of each, points with their figures, a front and a
recommendation.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from beers_deploy.bench.swath import PAPER_SIZE, Swath, parse_size
from beers_deploy.bench.tables import PAPER_TARGET, published_rows
from beers_deploy.dpu.board import BoardLike, boards_of, dpu_of
from beers_deploy.dpu.cost.model import Constants
from beers_deploy.model.metrics.bootstrap import too_few
from beers_deploy.model.metrics.perceptual import find_backbone
from beers_deploy.model.progress import Log, Progress, no_log, reporting, steps
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.profiles import TargetProfile
from beers_deploy.profiles.errors import MachineError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.figures import measured as measured_figure
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import REFERENCE
from beers_deploy.profiles.target import DEFAULT_TARGET
from beers_deploy.results import input_of
from beers_deploy.studies.evaluation.methods import Method, method_named, method_of
from beers_deploy.studies.evaluation.pairs import pairs_of_scenes
from beers_deploy.studies.tradeoff import advice
from beers_deploy.studies.tradeoff.boards import Question, board_rows
from beers_deploy.studies.tradeoff.measure import (
    Benchmark,
    Labelled,
    Measurements,
    make_int8,
    measure_host,
)
from beers_deploy.studies.tradeoff.page import Tradeoff
from beers_deploy.studies.tradeoff.points import (
    CHAIN,
    Point,
    Variant,
    board_figures,
    network_variants,
    points_of,
)


def tradeoff(
    networks: Sequence[NetworkLike],
    *,
    images: str | os.PathLike[str] | None = None,
    sensor: SensorLike = SENSOR,
    reference: SensorLike | None = None,
    board: BoardLike | Sequence[BoardLike] = DEFAULT_TARGET,
    size: tuple[int, int] | str = PAPER_SIZE,
    budget: str | None = None,
    need: str | None = None,
    lpips: str | os.PathLike[str] | None = None,
    calibration: str | os.PathLike[str] | None = None,
    labelled: str | os.PathLike[str] | None = None,
    detector: Path | None = None,
    classes: str | None = None,
    seed: int = 0,
    cache: str | os.PathLike[str] | None = None,
    progress: Progress = None,
    log: Log = no_log,
) -> Tradeoff:
    """Measure networks and traditional pipelines on the same images, predict their runs, and
    recommend a point.

    Args:
        networks: shipped names, files, or networks in memory; float ones are quantised on the way.
        images: folder of held-out scenes to simulate from; drawn ones if None.
        sensor: of the degraded images.
        reference: the sensor that is aimed at; the shipped one if None.
        board: one or several, compared in one front; "all" for the shipped ones. Their order
            changes nothing.
        size: (width, height) of the swath in pixels, or as text.
        budget: what can be afforded, such as "latency<=20s".
        need: what must be reached, such as "psnr>=44".
        lpips: weights of SqueezeNet 1.1, or a folder of backbones, for LPIPS.
        calibration: folder of scenes to quantise networks on; drawn ones if None.
        labelled: folder of labelled pictures for a detector, whose mAP50 is then a figure of each
            point.
        detector: ONNX file; the embedded one if None.
        classes: labelled classes under the detector's names, such as "car=vehicle".
        seed: of every random draw.
        cache: folder of measurements that a later run goes on with; None keeps none.
        progress: a function that is told each step, False for silence, None for a bar or lines on
            standard error.
        log: is told which network has no INT8, and what of the sensor lies outside the range that
            was trained.

    Raises:
        BeersError: a network, an image, a profile or weights that cannot be used.

    Examples:
        >>> found = bd.tradeoff(["convbeers-xs"], budget="latency<=20s")
        >>> found.best.network.precision
        'int8'
    """
    boards = boards_of(board)
    width_height = parse_size(size) if isinstance(size, str) else size
    _require_different(boards)
    for profile in boards:
        # A board without constants is refused before anything is measured.
        Constants.of(dpu_of(profile))
    limits = advice.parse_constraints("budget", budget), advice.parse_constraints("need", need)
    scenes, weights, calibration_folder = (
        None if path is None else Path(path) for path in (images, lpips, calibration)
    )
    degraded = Sensor.load(sensor)
    aim = Sensor.load(reference or REFERENCE).in_units_of(degraded)
    given = list(networks)
    names = [each if isinstance(each, str) else Network.load(each).label for each in given]
    board_names = [profile.name for profile in boards]
    keep = nullcontext(cache) if cache is not None else TemporaryDirectory(prefix="beers-deploy-")
    with keep as folder, reporting(progress):
        measurements = Measurements.open(Path(folder) / "measurements.json")
        swath = Swath(*width_height)
        quantise = partial(
            make_int8,
            folder=Path(folder) / "int8",
            scenes=calibration_folder,
            sensor=degraded,
            seed=seed,
        )
        points = points_of(network_variants(given, degraded, quantise, log), boards, swath)
        pairs, remarks = pairs_of_scenes(scenes, degraded, aim, seed)
        benchmark = Benchmark(pairs, degraded, aim, weights, seed)
        pictures = Labelled.open(Path(labelled), detector, classes, benchmark) if labelled else None
        results = _measured(points, benchmark, pictures, measurements, swath, log)
    if PAPER_TARGET in board_names and width_height == parse_size(PAPER_SIZE):
        # The rows stand as printed: the paper's images are others.
        for row in published_rows():
            figures = {f"board {key}": figure for key, figure in row.figures.items()}
            results.append(advice.Measured(row.name, figures, {"board": PAPER_TARGET}))
    notes = (
        *_notes(benchmark, board_names),
        *(pictures.notes if pictures else ()),
        *remarks,
    )
    files = [path for path in map(Path, names) if path.is_file()]
    for source in (scenes, calibration_folder):
        files += list_images(source) if source else []
    files += [path for path in (find_backbone("squeeze", weights), detector) if path]
    files += [scene.path for scene in pictures.scenes if scene.path] if pictures else []
    arguments: dict[str, object] = {
        "images": images,
        "sensor": degraded.name,
        "reference": aim.name,
        "need": need,
        "size": "x".join(map(str, width_height)),
        "budget": budget,
        "calibration": calibration,
        "seed": seed,
        "target": ",".join(board_names),
        "network": ",".join(names),
    }
    if labelled:
        arguments |= {"labelled": labelled, "detector": detector, "classes": classes}
    about: dict[str, Any] = {
        "arguments": arguments,
        "inputs": tuple(map(input_of, files)),
        "notes": notes,
    }
    question = Question(*limits, advice.Comparison(benchmark.sites, seed))
    return weigh(results, board_names, question, **about)


def _require_different(boards: Sequence[TargetProfile]) -> None:
    """Raise OptionError if two boards have one name: their points could not be told apart."""
    names = [profile.name for profile in boards]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise OptionError(
            "board", expected="boards, each once", got=f"two {twice!r}", remedy="leave one out"
        )


def weigh(
    points: Sequence[advice.Measured], boards: Sequence[str], asked: Question, **about: Any
) -> Tradeoff:
    """Find the front, the recommendation, and what each board offers.

    Args:
        points: of all boards, and published runs.
        boards: their names.
        asked: budget and need.
        **about: the arguments, inputs and notes of the study.
    """
    cost = advice.chosen_cost(points, asked.budget)
    best, line = advice.recommend(points, asked.budget, asked.need, asked.compare)
    front = advice.pareto_front(advice.affordable(points, asked.constraints, cost), cost)
    numbered = advice.front_rows(front, cost, asked.compare)
    by_board = board_rows(points, boards, best, asked)
    name = best.name if best else "none"
    figures = best.figures if best else {}
    every = (Row("points", point.name, point.figures, point.text) for point in points)
    rows = (Row("recommended", name, figures, {"line": line}), *by_board, *numbered, *every)
    return Tradeoff(
        "tradeoff",
        rows=rows,
        points=points,
        front=front,
        front_rows=numbered,
        cost=cost,
        best=best,
        line=line,
        boards=tuple(boards),
        board_rows=by_board,
        constraints=asked.constraints,
        **about,
    )


def _measured(
    points: Sequence[Point],
    benchmark: Benchmark,
    labelled: Labelled | None,
    measurements: Measurements,
    swath: Swath,
    log: Log,
) -> list[advice.Measured]:
    """Every point with its figures; a method whose library is not installed is left out."""
    methods = _methods([point.variant for point in points], benchmark, log)
    runnable = [point for point in points if point.variant in methods]
    results = list[advice.Measured]()
    with steps("tradeoff", len(runnable) + 1) as bar:
        for point in runnable:
            bar.advance(0, f"measuring {point.name}")
            method = methods[point.variant]
            scores = benchmark.scores(point, method.restore, measurements)
            figures = benchmark.means(scores)
            if labelled is not None:
                figures[advice.MAP50] = labelled.figure(point, method, measurements)
            results.append(
                advice.Measured(point.name, figures, _text(point, method), point, scores)
            )
            bar.advance(1, point.name)
        host = measure_host(methods, benchmark, measurements)
        bar.advance(1, "timed on this machine")
    medians_s = {variant: times["host p50"].value or 1.0 for variant, times in host.items()}
    for point, result in zip(runnable, results, strict=True):
        here_s = medians_s[point.variant]
        # Where the chain itself was not timed, the board's stated time stands as it is.
        slower = here_s / medians_s.get(Variant(CHAIN), here_s)
        runs = benchmark.runs(point) if point.dpu is not None else 1.0
        figures = host[point.variant] | board_figures(point, swath, slower, runs)
        if point.dpu is not None:
            figures["network runs"] = measured_figure(
                runs, "run/tile", "exposures that tiles of the images ask for"
            )
        result.figures.update(figures)
    return results


def _methods(variants: Sequence[Variant], benchmark: Benchmark, log: Log) -> dict[Variant, Method]:
    methods: dict[Variant, Method] = {}
    for variant in dict.fromkeys(variants):
        try:
            methods[variant] = _method(variant, benchmark)
        except MachineError as error:
            # The library of this method is not installed: the study goes on without it.
            log(f"{variant.name} is left out: {error}")
    return methods


def _method(variant: Variant, benchmark: Benchmark) -> Method:
    """Return the method of a variant: a network with its exposures, or a traditional one."""
    degraded = benchmark.degraded
    if variant.network is None:
        return method_named(variant.method, degraded, benchmark.reference)
    return method_of(variant.name, variant.network, degraded, benchmark.reference)


def _text(point: Point, method: Method) -> dict[str, str]:
    halo = "exact" if point.halo_px is None else str(point.halo_px)
    return {
        "board": point.board.name if point.board else "this machine",
        "configuration": point.dpu.name if point.dpu else "none",
        "tile": str(point.tile_px) if point.dpu else "none",
        "halo": halo if point.dpu else "none",
        "method": point.variant.method,
        "precision": point.variant.precision,
        "sensor": method.sensor_known,
    }


def _notes(benchmark: Benchmark, boards: Sequence[str]) -> Iterator[str]:
    sites = len(set(benchmark.sites))
    names = ", ".join(boards)
    yield (
        f"No board was used: figures of {names} are predicted, but for the paper's, which are "
        "published."
    )
    yield (
        f"PSNR is the mean over {len(benchmark.pairs)} images of {sites} sites; clipped "
        "pixels are left out."
    )
    yield (
        "Gains are differences on the same images from the next cheaper point of the front, "
        "with 95 % bootstrap "
        "intervals over whole sites; one whose interval holds 0 is not significant."
    )
    if too_few(sites):
        yield too_few(sites)
    yield (
        "Exact halos give the same pictures in tiles of any size; smaller ones were measured "
        "in the point's tiles."
    )
    yield "The chains know both sensors; what a network knows of them stands beside it."
