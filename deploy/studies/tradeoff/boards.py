"""What a point costs on its board: latency, rate, power and energy, predicted."""

import math

from beers_deploy.bench.tables import Swath, chain_rate, efficiency, energy, processor_row, swath_latency
from beers_deploy.dpu.cost.latency import dpu_power
from beers_deploy.profiles.figures import Figure, predicted, unavailable
from beers_deploy.studies.tradeoff.advice import NAMES
from beers_deploy.studies.tradeoff.points import Point, predict_tile

UNITS = {key: unit for key, unit in NAMES.values() if key.startswith("board")}
NOT_ON_A_BOARD = "no time of this method on the board's processor is stated"
CHAIN = "traditional-standard"
"""The chain whose time on a board's processor a target states."""


def board_figures(point: Point, whole: Swath, slower: float | None = None) -> dict[str, Figure]:
    """The figures of a point's board; unavailable, with the reason, where it has none.

    Args:
        point: a network on a DPU, or a traditional chain on the board's processor.
        whole: the swath.
        slower: how many times as long a chain takes as CHAIN, measured on this machine.
    """
    if point.dpu is not None:
        swath = point.swath(whole)
        prediction = predict_tile(point.variant, point.tile_px, point.dpu)
        latency = swath_latency(prediction, math.ceil(swath.tiles / prediction.batch))
        power = dpu_power(point.dpu)
    elif point.board is not None and slower is not None:
        row = processor_row(whole, point.board)
        latency, power = _slower(row.figures["latency"], slower), row.figures["power"]
    else:
        latency = unavailable("s", point.reason or NOT_ON_A_BOARD)
    if latency.value is None:
        return {key: unavailable(unit, latency.reason) for key, unit in UNITS.items()}
    work = energy(latency, power), efficiency(whole.pixels, latency, power)
    return dict(zip(UNITS, (latency, chain_rate(whole, latency), power, *work), strict=True))


def _slower(latency: Figure, times: float) -> Figure:
    """Of another chain than CHAIN, by the ratio measured here."""
    if latency.value is None or latency.interval is None:
        return latency
    low_s, high_s = (end * times for end in latency.interval)
    source = f"{latency.source}; times of the chains here: {times:.2f} of {CHAIN}"
    return predicted(latency.value * times, "s", (low_s, high_s), source)
