"""`stress --bit-flips`: the patient, and the tables of what flips do to it and what guards cost."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from deploy.bench import predict_file
from deploy.defaults import HELD_OUT_SEED
from deploy.dpu.board import load_dpu
from deploy.quantising import Calibration
from deploy.results import Row
from deploy.stress import flip_curves, flip_places
from deploy.stress.flip_price import TILE_PX, price_rows
from deploy.stress.flips import Patient
from deploy.stress.int8 import core_of, planes_of
from deploy.stress.subject import Subject
from quant.guards import learn_guards
from quant.upsets import as_stored

CALIBRATION_PATCHES = 16


@dataclass(frozen=True)
class FlipRequest:
    """What to strike, and how often.

    Attributes:
        sensor: profile of the degraded patches.
        images: folder of scenes; drawn ones where there is none.
        target: board whose cost model prices the guards.
        draws: strikes of each kind of memory and rate.
        size_px: side of a patch.
        seed: of patches and strikes.
    """

    sensor: str
    images: Path | None
    target: str
    draws: int
    size_px: int
    seed: int


def flip_rows(subject: Subject, request: FlipRequest, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """Curves, places and prices.

    Raises:
        ModelError: no INT8 file, or one whose whole numbers cannot be told.
        BeersError: no such target, sensor or images.
    """
    core_of(subject)  # refused before anything is drawn
    dpu = load_dpu(request.target, None)
    prediction = predict_file(subject.paths[-1], dpu, TILE_PX)
    patient = make_patient(subject, request)
    curves = flip_curves.curve_rows(patient, request.draws, request.seed, tick)
    places = flip_places.place_rows(patient, request.seed, request.size_px // 2, tick)
    return [*curves, *places, *price_rows(patient, prediction, dpu)]


def ticks(subject: Subject, request: FlipRequest) -> int:
    """How often `flip_rows` reports progress."""
    return flip_curves.ticks(request.draws) + len(core_of(subject).ops)


def make_patient(subject: Subject, request: FlipRequest) -> Patient:
    """The core as the board stores it, guards that calibration patches teach, and other patches to try it on."""
    core = as_stored(core_of(subject))
    taught, tried = (
        Calibration(request.sensor, request.images, count, request.size_px, seed).drawn
        for seed, count in ((request.seed, CALIBRATION_PATCHES), (request.seed + HELD_OUT_SEED, request.draws))
    )
    guards = learn_guards(core, (planes_of(core, image) for image in taught.degraded))
    return Patient(core, guards, list(tried.pairs))
