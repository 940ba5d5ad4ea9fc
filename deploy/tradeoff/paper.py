"""The paper's two runs as points: their times on the board compare, their pictures do not."""

from deploy.bench import PAPER, Swath
from deploy.evaluation.paper import NOTE
from deploy.results import Figure, published, unavailable
from deploy.tradeoff.figures import UNITS
from deploy.tradeoff.outcome import Outcome
from deploy.tradeoff.points import Point, Unit

SIZE_PX = (13600, 9016)
RUNS = {
    "paper: ConvBEERS on the DPU": ("INT8", (42, 7.2, 29.6, 98965)),
    "paper: traditional on the board's CPU": ("float32", (1724, 0.2, 22.5, 3161)),
}
"""Precision; latency, throughput, power and efficiency as printed."""


def paper_outcomes(swath: Swath) -> list[Outcome]:
    """Both runs, where the swath is the paper's; else none."""
    if (swath.width_px, swath.height_px) != SIZE_PX:
        return []
    return [_outcome(name, precision, values) for name, (precision, values) in RUNS.items()]


def _outcome(name: str, precision: str, values: tuple[float, float, float, float]) -> Outcome:
    latency_s, rate, power_w, efficiency = values
    printed = {"latency": latency_s, "throughput": rate, "power": power_w, "efficiency": efficiency}
    found = {f"board {key}": published(value, UNITS[f"board {key}"], PAPER) for key, value in printed.items()}
    found["board energy"] = published(latency_s * power_w, "J", f"{PAPER}: latency x power")
    figures: dict[str, Figure] = {key: found.get(key) or unavailable(unit, NOTE) for key, unit in UNITS.items()}
    text = dict.fromkeys(("halo", "tile", "configuration", "runtime"), "not stated")
    text |= {"method": name, "kind": "paper", "precision": precision, "told": "not stated"}
    return Outcome(Point(Unit(name, "paper", precision)), figures, text)
