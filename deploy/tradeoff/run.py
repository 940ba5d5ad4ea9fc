"""One study from start to end.

networks, pairs -> points -> what the cache lacks is measured -> outcomes -> fronts, advice, pictures
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from deploy.bench import Swath, layer_rows
from deploy.dpu.board import load_dpu
from deploy.dpu.checking import network_rows
from deploy.dpu.placement import place
from deploy.dpu.reading import network_of
from deploy.evaluation.pairs import oversampling_note
from deploy.evaluation.perceptual import perceptual_distances
from deploy.evaluation.run import load_pairs
from deploy.evaluation.scores import Instruments
from deploy.evaluation.targets import acquire_targets
from deploy.measure import Sensors, drawn_acquisition
from deploy.results import Row
from deploy.tradeoff.accuracy import Ground
from deploy.tradeoff.board import DpuRun
from deploy.tradeoff.cache import Cache
from deploy.tradeoff.choice import Choice, choose
from deploy.tradeoff.crops import crop_points, make_crops
from deploy.tradeoff.figures import Assembly
from deploy.tradeoff.findings import findings, headline, papers_point
from deploy.tradeoff.host_time import TILE_PX
from deploy.tradeoff.int8 import Calibration
from deploy.tradeoff.jobs import run_jobs
from deploy.tradeoff.lab import Lab
from deploy.tradeoff.networks import find_networks, is_papers
from deploy.tradeoff.notes import notes
from deploy.tradeoff.outcome import Arena, Outcome
from deploy.tradeoff.paper import paper_outcomes
from deploy.tradeoff.points import Point
from deploy.tradeoff.prices import fronts
from deploy.tradeoff.request import Request
from deploy.tradeoff.selection import select_points
from deploy.tradeoff.shelf import Shelf
from deploy.tradeoff.study import Study
from model.files import sha256
from quant.onnx_file import load_onnx

LPIPS = "LPIPS-squeeze"


@dataclass(frozen=True)
class Result:
    """A study; `met` is false where no point keeps what was asked for."""

    study: Study
    met: bool

    @property
    def rows(self) -> tuple[Row, ...]:
        """Points, layers and placement, for a document."""
        named = [
            (kind, name, row) for kind, tables in self._by_network() for name, rows in tables.items() for row in rows
        ]
        return (
            *self.study.points,
            *(Row(f"{kind} of {name}: {r.table}", r.name, r.figures, r.text) for kind, name, r in named),
        )

    def _by_network(self) -> list[tuple[str, Mapping[str, Sequence[Row]]]]:
        return [("layers", self.study.layers), ("placement", self.study.placement)]


def run_study(request: Request, cache: Cache) -> Result:
    """Measure what the cache lacks, and put it together.

    Raises:
        BeersError: a network, an image, a profile or weights that cannot be used.
    """
    swath = Swath(*request.size_px)
    shelf = make_shelf(request, cache)
    ground, small = make_ground(request)
    lab = Lab(shelf, ground, host_tile(shelf, request.seed), cache)
    points = select_points(shelf, swath)
    lacks = lacking(shelf, points)
    there = [point for point in points if str(point.unit) not in lacks]
    run_jobs(lab.jobs(there, list(dict.fromkeys(point.unit for point in there))))
    assembly = Assembly(lab, swath, lacks)
    outcomes = [*(assembly.outcome(point) for point in points), *paper_outcomes(swath)]
    arena = Arena({each.name: each for each in outcomes}, ground.sites, request.seed)
    sampled = oversampling_note(ground.pairs, request.profiles[0])
    return _put_together(request, lab, arena, notes(ground, sampled, small, lacks, calibrated_on(request)))


def _put_together(request: Request, lab: Lab, arena: Arena, remarks: tuple[str, ...]) -> Result:
    outcomes, found = list(arena.outcomes.values()), fronts(arena)
    paper = papers_point(arena, lambda method: is_papers(lab.shelf.model(method)), load_dpu().name)
    asked = [*request.budget, *request.need]
    choice = choose(arena, request.budget, request.need) if asked else Choice(None, ())
    shown = crop_points(outcomes, found, [choice.outcome, paper])
    runs = {each.board.network: each for each in reversed(outcomes) if isinstance(each.board, DpuRun)}
    study = Study(
        headline(arena, paper),
        tuple(each.row for each in outcomes),
        found,
        (*choice.advice, *findings(arena, paper)),
        make_crops(shown, lab),
        {name: tuple(layers_of(run)) for name, run in sorted(runs.items())},
        {name: tuple(placement_of(lab, run)) for name, run in sorted(runs.items())},
        remarks,
    )
    return Result(study, not asked or choice.outcome is not None)


def make_shelf(request: Request, cache: Cache) -> Shelf:
    """The methods of a study."""
    networks = {network.name: network for network in find_networks(request.networks)}
    return Shelf(networks, *request.profiles, Calibration(request.calibration, request.sensor, request.seed), cache)


def make_ground(request: Request) -> tuple[Ground, list[str]]:
    """What all are judged on, and the names of images too small for it."""
    sensors = request.profiles
    pairs, small = load_pairs(request.images, None, *sensors, request.seed)
    perceptual = {LPIPS: perceptual_distances(request.lpips)[LPIPS]}
    weights = sha256(request.backbone) if request.backbone else ""
    targets = acquire_targets(sensors[0].nominal(), request.seed)
    return Ground(pairs, targets, Instruments(perceptual, sensors[0].nominal().max_dn), weights, request.seed), small


def host_tile(shelf: Shelf, seed: int) -> np.ndarray:
    """What host times are taken on: a drawn scene as the sensor sees it."""
    sensors = Sensors(shelf.degraded, shelf.reference)
    return drawn_acquisition(Swath(TILE_PX, TILE_PX), sensors, seed)


def lacking(shelf: Shelf, points: Sequence[Point]) -> dict[str, str]:
    """Units that cannot be had here, each with the reason."""
    reasons = {str(unit): shelf.lack(unit) for unit in dict.fromkeys(point.unit for point in points)}
    return {unit: reason for unit, reason in reasons.items() if reason}


def calibrated_on(request: Request) -> str:
    """In words."""
    return f"the scenes of {request.calibration.name}" if request.calibration else "drawn scenes"


def layers_of(outcome: Outcome) -> list[Row]:
    """Time of each layer of a network's run on the board."""
    assert isinstance(outcome.board, DpuRun)  # noqa: S101 - chosen so
    return layer_rows(outcome.board.prediction, outcome.board.dpu)


def placement_of(lab: Lab, outcome: Outcome) -> list[Row]:
    """What runs where."""
    assert isinstance(outcome.board, DpuRun)  # noqa: S101 - chosen so
    file = lab.shelf.int8_file(outcome.point.unit)
    assert file is not None  # noqa: S101 - it ran on the board
    tile_px, dpu = outcome.point.tile_px, outcome.board.dpu
    return network_rows(place(network_of(load_onnx(file), tile_px), dpu), dpu, tile_px)
