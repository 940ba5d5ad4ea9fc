"""Points with invented figures, on a real board."""

from collections.abc import Sequence

import numpy as np
import onnx

from beers_deploy.dpu.board import load_dpu
from beers_deploy.network import Network
from beers_deploy.profiles.figures import Figure, measured, predicted
from beers_deploy.studies.tradeoff.advice import Question, parse_constraints
from beers_deploy.studies.tradeoff.front import Comparison, Measured
from beers_deploy.studies.tradeoff.points import INT8, Point, Variant

SITES = ("a", "a", "b", "c", "d", "e")
DIFFICULTY_DB = np.array([0.0, 1.0, -6.0, 5.0, -2.0, 2.0])
"""Differences of PSNR between sites, which are far larger than those between methods."""
COMPARE = Comparison(SITES, 0)
DPU = load_dpu("vck190")


def made_up(value: float, unit: str, factor: float) -> Figure:
    return predicted(value, unit, (value / factor, value * factor), "made up")


def synthetic(
    name: str,
    psnr_db: float,
    latency_s: float,
    *,
    scatter_db: float = 0.01,
    method: str = "",
    board: str = "vck190",
    power_w: float = 30.0,
) -> Measured:
    """Return an INT8 network whose scores have the differences of the sites and some scatter."""
    noise = np.random.default_rng(sum(map(ord, name))).normal(size=len(SITES))
    values = psnr_db + DIFFICULTY_DB - DIFFICULTY_DB.mean() + scatter_db * (noise - noise.mean())
    network = Network(onnx.ModelProto(), method or name)
    variant = Variant(method or name, INT8, network)
    return Measured(
        name,
        {
            "PSNR": measured(psnr_db, "dB", "made up", (psnr_db - 3, psnr_db + 3)),
            "host p50": measured(latency_s / 10, "s/Mpx", "made up"),
            "board latency": made_up(latency_s, "s", 1.6),
            "board power": made_up(power_w, "W", 2),
            "board energy": made_up(latency_s * power_w, "J", 2),
        },
        {"board": board, "method": name},
        Point(variant, DPU.target, DPU),
        [{"PSNR": float(value)} for value in values],
    )


def question(budget: str | None = None, need: str | None = None) -> Question:
    """Ask for a point within limits, as a user writes them."""
    return Question(parse_constraints("budget", budget), parse_constraints("need", need), COMPARE)


def family() -> Sequence[Measured]:
    """Return networks from small to large, each better and more expensive than the one before.

    The last two are nearly equal, and "slow" is dominated.
    """
    return [
        synthetic("tiny", 44.0, 0.6),
        synthetic("small", 45.0, 2.0),
        synthetic("medium", 45.5, 4.0),
        synthetic("large", 45.503, 30.0, scatter_db=0.05),
        synthetic("slow", 44.5, 9.0),
    ]
