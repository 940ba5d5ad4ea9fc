"""One study from start to end.

networks, pairs -> points -> what the cache lacks is measured -> outcomes -> fronts, advice, pictures
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx

from deploy.bench.host import Sensors, drawn_acquisition
from deploy.bench.tables import PAPER_TARGET, Swath, layer_rows
from deploy.cache import Cache
from deploy.dpu.board import Dpu, dpu_of
from deploy.dpu.checker.placement import place
from deploy.dpu.checker.table import network_rows
from deploy.dpu.reading import network_of
from deploy.networks import Say, silent
from deploy.restoration.engine import restore_dn
from deploy.restoration.plan import make_plan
from deploy.tradeoff.accuracy import BenchmarkSet
from deploy.tradeoff.advice import Choice, Recommendation, choose, notes, recommendations
from deploy.tradeoff.board import DpuRun
from deploy.tradeoff.boards import OnBoard, every_configuration, on_boards
from deploy.tradeoff.detection import Detection
from deploy.tradeoff.host_time import TILE_PX
from deploy.tradeoff.measurements import Measurements, run_jobs
from deploy.tradeoff.methods import CalibrationScenes, MethodStore, find_networks, is_papers
from deploy.tradeoff.outcome import Assembly, Outcome, Results
from deploy.tradeoff.paper import at_a_glance, findings, paper_outcomes, papers_point
from deploy.tradeoff.points import Point, Variant
from deploy.tradeoff.selection import Request, require_method, require_on_dpu, select_points
from deploy.tradeoff.study import Crop, Front, Study, difference_rows, front_rows, fronts, held_against
from model.evaluation.pairs import NamedPair, oversampling_note
from model.evaluation.run import load_pairs
from model.evaluation.scores import Instruments, fidelity_db, perceptual_distances
from model.evaluation.targets import acquire_targets
from model.io.files import sha256
from model.io.images import MAX_DN
from model.io.pictures import busiest_windows
from profiles import load_target
from profiles.figures import Row
from quant.onnx_file import load_onnx

CROP_PX, MOST = 128, 8
FRONT = ("board latency", "PSNR")


def crop_points(
    outcomes: Sequence[Outcome], fronts: Sequence[Front], chosen: Sequence[Outcome | None]
) -> list[Outcome]:
    """Chosen points, the best of each kind, and the front of PSNR against latency: one of each variant and halo."""
    by_name = {each.name: each for each in outcomes}
    members = [by_name[name] for front in fronts if (front.x, front.y) == FRONT for name in front.members]
    known = sorted((o for o in outcomes if o.value("PSNR") is not None), key=lambda o: -(o.value("PSNR") or 0.0))
    best = {each.point.variant.kind: each for each in reversed(known)}.values()
    wanted = [each for each in (*chosen, *best, *reversed(members)) if each is not None]
    alike: dict[tuple[Variant, str], Outcome] = {}
    for each in wanted:
        alike.setdefault((each.point.variant, each.point.halo), each)
    return list(alike.values())[:MOST]


def make_crops(points: Sequence[Outcome], measurements: Measurements) -> tuple[Crop, ...]:
    """Degraded, each point as it would restore it, reference; of the pair that is hardest to restore."""
    max_dn = measurements.benchmark.instruments.max_dn
    pair = hardest(measurements.benchmark.pairs, max_dn)
    side = min(CROP_PX, *pair.reference.shape)
    top, left = busiest_windows(pair.reference, side)[0]

    def crop(name: str, title: str, dn: np.ndarray) -> Crop:
        here, truth, seen = (
            np.asarray(image[top : top + side, left : left + side], np.float32)
            for image in (dn, pair.reference, pair.degraded)
        )
        return Crop(name, title, here, None if dn is pair.reference else fidelity_db(here, truth, seen, max_dn))

    made = [crop(each.name, each.name, _restored(each, pair, measurements)) for each in points]
    return (crop("degraded", "degraded", pair.degraded), *made, crop("reference", "reference", pair.reference))


def hardest(pairs: Sequence[NamedPair], max_dn: int = MAX_DN) -> NamedPair:
    """The pair whose degraded image is farthest from its reference, among those that hold a crop where any does."""
    large = [pair for pair in pairs if min(pair.reference.shape) >= CROP_PX] or pairs
    return min(large, key=lambda pair: fidelity_db(pair.degraded, pair.reference, pair.degraded, max_dn))


def _restored(outcome: Outcome, pair: NamedPair, measurements: Measurements) -> np.ndarray:
    opened, point = measurements.store.open(outcome.point.variant), outcome.point
    if opened.infer is None:
        return opened.restore(pair.degraded)
    tiling = measurements.store.tiling(point.variant.method)
    plan = make_plan((1, *pair.degraded.shape), point.tile_px, point.halo_px(tiling.halo_px), tiling)
    return restore_dn(pair.degraded, opened.infer, plan, measurements.store.max_dn)


LPIPS = "LPIPS-squeeze"


@dataclass(frozen=True)
class StudyRun:
    """A study; `met` is false where no point keeps what was asked for, `labelled` are files that a detector took."""

    study: Study
    met: bool
    labelled: tuple[Path, ...] = ()

    @property
    def rows(self) -> tuple[Row, ...]:
        """What to take, points, differences, boards, layers and placement, for a document."""
        named = [
            (kind, name, row) for kind, tables in self._by_network() for name, rows in tables.items() for row in rows
        ]
        return (
            *self.study.recommended,
            *self.study.points,
            *self.study.differences,
            *(row for front in self.study.fronts for row in front_rows(self.study, front)),
            *self.study.boards,
            *(Row(f"{kind} of {name}: {r.table}", r.name, r.figures, r.text) for kind, name, r in named),
        )

    def _by_network(self) -> list[tuple[str, Mapping[str, Sequence[Row]]]]:
        return [("layers", self.study.layers), ("placement", self.study.placement)]


def run_study(request: Request, cache: Cache, say: Say = silent) -> StudyRun:
    """Measure what the cache lacks, and put it together.

    Raises:
        BeersError: a network, an image, a profile or weights that cannot be used.
    """
    swath, target = Swath(*request.size_px), load_target(request.target)
    dpus = every_configuration(request.boards or (request.target,))
    detection = make_detection(request, cache)
    store = make_store(request, cache, say)
    require_on_dpu(store, request.own, target)
    points = select_points(store, swath, target)
    require_method(points, request.against)
    benchmark, small = make_benchmark(request)
    measurements = Measurements(store, benchmark, host_tile(store, request.seed), cache, detection)
    lacks = lacking(store, points)
    there = [point for point in points if str(point.variant) not in lacks]
    run_jobs(measurements.jobs(there, list(dict.fromkeys(point.variant for point in there))))
    assembly = Assembly(measurements, swath, lacks, target)
    outcomes = [
        *(assembly.outcome(point) for point in points),
        *(paper_outcomes(swath, assembly.units) if target.name == PAPER_TARGET else []),
    ]
    results = Results({each.name: each for each in outcomes}, benchmark.sites, request.seed)
    sampled = oversampling_note(benchmark.pairs, request.profiles[0])
    remarks = notes(benchmark, sampled, small, lacks, calibrated_on(request), target.name)
    remarks += detection.notes() if detection else ()
    return _put_together(request, measurements, results, remarks, dpus)


def _put_together(
    request: Request, measurements: Measurements, results: Results, remarks: tuple[str, ...], dpus: Sequence[Dpu]
) -> StudyRun:
    outcomes, found = list(results.outcomes.values()), fronts(results)
    paper = papers_point(
        results, lambda method: is_papers(measurements.store.model(method)), dpu_of(load_target(request.target)).name
    )
    asked = [*request.budget, *request.need]
    choice = choose(results, request.budget, request.need) if asked else Choice(None, ())
    shown = crop_points(outcomes, found, [choice.outcome, paper])
    runs = {each.board.network: each for each in reversed(outcomes) if isinstance(each.board, DpuRun)}
    moved = on_boards(outcomes, dpus, lambda variant: legal_model(measurements, variant))
    advised = advise(request, results, moved)
    against = held_against(results, request.against)
    study = Study(
        advised[0].sentence if advised else "No point could be measured.",
        tuple(each.row for each in outcomes),
        found,
        (*choice.advice, at_a_glance(results, paper), *findings(results, paper)),
        make_crops(shown, measurements),
        {name: tuple(layers_of(run)) for name, run in sorted(runs.items())},
        {name: tuple(placement_of(measurements, run)) for name, run in sorted(runs.items())},
        remarks,
        tuple(each.row for each in moved),
        tuple(each.row for each in advised),
        against,
        difference_rows(results, against),
    )
    labelled = measurements.detection.files if measurements.detection else ()
    return StudyRun(study, not asked or choice.outcome is not None, tuple(labelled))


def advise(request: Request, results: Results, moved: Sequence[OnBoard]) -> list[Recommendation]:
    """What to take on the study's board, and of its networks on each other board."""
    asked = request.budget, request.need
    found = recommendations(results, *asked, load_target(request.target).name)
    for board in dict.fromkeys(each.dpu.target.name for each in moved):
        if board != load_target(request.target).name:
            there = {each.outcome.name: each.outcome for each in moved if each.dpu.target.name == board}
            found += recommendations(replace(results, outcomes=there), *asked, board)
    return found


def make_store(request: Request, cache: Cache, say: Say) -> MethodStore:
    """Collect the networks of a request and what chains know of the sensors."""
    found = find_networks(request.networks, request.sensor, say, request.own)
    networks = {network.name: network for network in found}
    return MethodStore(
        networks, *request.profiles, CalibrationScenes(request.calibration, request.sensor, request.seed), cache
    )


def make_detection(request: Request, cache: Cache) -> Detection | None:
    """Labelled images and a detector, where they are asked for."""
    if request.detection is None:
        return None
    return Detection.open(request.detection, request.profiles, request.seed, cache)


def make_benchmark(request: Request) -> tuple[BenchmarkSet, list[str]]:
    """What all are judged on, and the names of images too small for it."""
    sensors = request.profiles
    pairs, small = load_pairs(request.images, None, *sensors, request.seed)
    perceptual = {LPIPS: perceptual_distances(request.lpips)[LPIPS]}
    weights = sha256(request.backbone) if request.backbone else ""
    targets = acquire_targets(sensors[0].nominal(), request.seed)
    return BenchmarkSet(
        pairs, targets, Instruments(perceptual, sensors[0].nominal().max_dn), weights, request.seed
    ), small


def host_tile(store: MethodStore, seed: int) -> np.ndarray:
    """What host times are taken on: a drawn scene as the sensor sees it."""
    sensors = Sensors(store.degraded, store.reference)
    return drawn_acquisition(Swath(TILE_PX, TILE_PX), sensors, seed)


def lacking(store: MethodStore, points: Sequence[Point]) -> dict[str, str]:
    """Units that cannot be had here, each with the reason."""
    reasons = {str(variant): store.lack(variant) for variant in dict.fromkeys(point.variant for point in points)}
    return {variant: reason for variant, reason in reasons.items() if reason}


def calibrated_on(request: Request) -> str:
    """What INT8 files were calibrated on, in words."""
    return f"the scenes of {request.calibration.name}" if request.calibration else "drawn scenes"


def layers_of(outcome: Outcome) -> list[Row]:
    """Time of each layer of a network's run on the board."""
    assert isinstance(outcome.board, DpuRun)  # noqa: S101 - chosen so
    return layer_rows(outcome.board.prediction, outcome.board.dpu)


def placement_of(measurements: Measurements, outcome: Outcome) -> list[Row]:
    """Where each operation of a network's run on the board is placed."""
    assert isinstance(outcome.board, DpuRun)  # noqa: S101 - chosen so
    tile_px, dpu = outcome.point.tile_px, outcome.board.dpu
    network = network_of(legal_model(measurements, outcome.point.variant), tile_px)
    return network_rows(place(network, dpu), dpu, tile_px)


def legal_model(measurements: Measurements, variant: Variant) -> onnx.ModelProto:
    """The INT8 network that ran on the board."""
    file = measurements.store.int8_file(variant)
    assert file is not None  # noqa: S101 - it ran on the board
    return load_onnx(file)
