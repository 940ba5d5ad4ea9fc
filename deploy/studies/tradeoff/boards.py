"""What a point costs on its board: latency, rate, power and energy, predicted."""

import math

from deploy.bench.tables import Swath, efficiency, energy, swath_latency
from deploy.dpu.cost.latency import dpu_power
from deploy.studies.tradeoff.points import Point, predict_tile
from profiles import TargetProfile
from profiles.figures import Figure, predicted, published, unavailable

FRAME_PX = 640
UNITS = {
    "board latency": "s",
    "board throughput": "frame/s",
    "board power": "W",
    "board energy": "J",
    "board efficiency": "px/s/W",
}
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
    if point.board is None or (point.dpu is None and slower is None):
        return {key: unavailable(unit, point.reason or NOT_ON_A_BOARD) for key, unit in UNITS.items()}
    swath = point.swath(whole) if point.dpu else whole
    if point.dpu is None:
        latency, power = _chain_latency(point.board, swath, slower or 1.0), _cpu_power(point.board)
    else:
        prediction = predict_tile(point.variant, point.tile_px, point.dpu)
        latency = swath_latency(prediction, math.ceil(swath.tiles / prediction.batch))
        power = dpu_power(point.dpu)
    work = energy(latency, power), efficiency(swath.pixels, latency, power)
    return dict(zip(UNITS, (latency, _rate(swath, latency), power, *work), strict=True))


def _rate(swath: Swath, latency: Figure) -> Figure:
    """Frames of the paper's size a second."""
    if latency.value is None or latency.interval is None:
        return unavailable("frame/s", latency.reason)
    frames, (fast_s, slow_s) = swath.pixels / FRAME_PX**2, latency.interval
    source = f"pixels of the swath as frames of {FRAME_PX} x {FRAME_PX}, over the latency"
    return predicted(frames / latency.value, "frame/s", (frames / slow_s, frames / fast_s), source)


def _chain_latency(board: TargetProfile, swath: Swath, slower: float) -> Figure:
    """Of a traditional chain on the board's processor: the target's figure for CHAIN, by the ratio measured here."""
    stated = board.tables.get("cpu", {}).get("chain_s_per_mpx")
    if stated is None:
        return unavailable("s", f"{board.name} states no time of the traditional chain on its processor")
    low_s, high_s = (end * slower * swath.pixels / 1e6 for end in (stated.low, stated.high))
    source = f"{stated.source}; times of the chains here: {slower:.2f} of {CHAIN}"
    return predicted(math.sqrt(low_s * high_s), "s", (low_s, high_s), source)


def _cpu_power(board: TargetProfile) -> Figure:
    stated = board.tables.get("power", {}).get("cpu_run_w")
    if stated is None:
        return unavailable("W", "no power of a run on this board's processor is published")
    return published(stated.low, "W", stated.source)
