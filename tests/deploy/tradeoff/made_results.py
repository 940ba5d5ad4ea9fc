"""Small arenas with figures that were made up."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deploy.bench.tables import Swath
from deploy.dpu.board import load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.latency import predict
from deploy.dpu.zoo.networks import convbeers
from deploy.tradeoff.accuracy import Scores
from deploy.tradeoff.board import DpuRun
from deploy.tradeoff.host_time import Times
from deploy.tradeoff.outcome import UNITS, Outcome, Results
from deploy.tradeoff.points import EXACT, LEGAL, Point, Variant
from profiles.figures import Figure, measured, unavailable

SITES = ("a", "a", "b", "c", "d", "e")
DIFFICULTY_DB = np.array([0.0, 1.0, -6.0, 5.0, -2.0, 2.0])
"""How sites differ: by far more than methods do."""


@dataclass(frozen=True)
class Made:
    """What is made up of a point: its network's shape decides its time on the board."""

    psnr_db: float
    blocks: int = 4
    features: int = 16
    tile_px: int = 640
    configuration: str = "C32B3"
    sensor: str = "blind"
    scatter_db: float = 0.01
    halo: str = EXACT


def outcome(name: str, made: Made, number: int = 0) -> Outcome:
    """A legal network of that name."""
    dpu, swath = load_dpu("vck190", made.configuration), Swath(13600, 9016, made.tile_px, 0)
    prediction = predict(place(convbeers(made.tile_px, made.blocks, made.features), dpu), dpu)
    run = DpuRun(name, dpu, prediction, swath)
    scatter = made.scatter_db * np.random.default_rng(number).normal(size=len(SITES))
    values = made.psnr_db + DIFFICULTY_DB + scatter - scatter.mean() - DIFFICULTY_DB.mean()
    scores = Scores(tuple({"PSNR": value, "SSIM": value / 50, "LPIPS-squeeze": None} for value in values.tolist()))
    figures: dict[str, Figure] = {key: unavailable(unit, "made up") for key, unit in UNITS.items()}
    figures |= {
        "PSNR": measured(made.psnr_db, "dB", "made up", (made.psnr_db - 3, made.psnr_db + 3)),
        "SSIM": measured(made.psnr_db / 50, "ratio", "made up"),
        **run.figures(),
    }
    point = Point(Variant(name, "network", LEGAL), made.tile_px, made.halo, made.configuration)
    times = Times("one", (0.1 * made.blocks,) * 3, (0.1,) * 3, 1000)
    return Outcome(point, figures, {"sensor": made.sensor}, scores, run, times)


def results(points: Mapping[str, Made]) -> Results:
    """An results of such points."""
    made = [outcome(name, point, number) for number, (name, point) in enumerate(points.items())]
    return Results({each.name: each for each in made}, SITES, 0)


def named(found: Results, start: str) -> str:
    """The full name of a point."""
    return next(name for name in found.outcomes if name.startswith(start))
