"""Networks that take turns on this machine: what else it does meets them alike, so their times can be compared."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import onnx

from deploy.counterpart import is_quantised
from deploy.dpu.reading import network_of
from deploy.energy import timed
from deploy.host_state import memory_rise
from deploy.results import Figure, Row, measured, unavailable
from quant.session import open_session, require_finite


@dataclass
class Timed:
    """A network, and what its runs took."""

    name: str
    model: onnx.ModelProto
    times_s: list[float] = field(default_factory=list)
    powers: list[Figure] = field(default_factory=list)
    rise_bytes: int = 0


def take_turns(runs: Sequence[Timed], tile_px: int, threads: int, min_time_s: float, min_runs: int) -> None:
    """Run each for one tile in turn until all have run for `min_time_s` and `min_runs` times; fills in `runs`.

    Raises:
        ModelError: a network that gives NaN or infinity.
    """
    calls = []
    for run in runs:
        feed = tile_feed(run.model, tile_px, run.name)
        with memory_rise() as memory:
            session = open_session(run.model, threads)
            require_finite(session.run(None, feed), run.name)  # warm-up, not counted
        run.rise_bytes = memory.rise_bytes
        calls.append(partial(session.run, None, feed))
    while min(sum(run.times_s) for run in runs) < min_time_s or len(runs[0].times_s) < min_runs:
        for run, call in zip(runs, calls, strict=True):
            _, time_s, power = timed(call)
            run.times_s.append(time_s)
            run.powers.append(power)


def tile_feed(model: onnx.ModelProto, tile_px: int, where: str = "ONNX model") -> dict[str, np.ndarray]:
    """A grey tile (1, C, tile, tile) for every input.

    Raises:
        ModelError: inputs that are no images, or fixed to another tile.
    """
    inputs = network_of(model, tile_px, where).inputs
    return {name: np.full((1, *shape), 0.25, np.float32) for name, shape in inputs.items()}


def timed_rows(runs: Sequence[Timed], tile_px: int, conditions: Mapping[str, Figure]) -> list[Row]:
    """One row a network, and for two of them how much faster INT8 is here."""
    rows = [_row(run, tile_px, conditions) for run in runs]
    return [*rows, _ratio_row(runs)] if len(runs) == 2 else rows


def _row(run: Timed, tile_px: int, conditions: Mapping[str, Figure]) -> Row:
    times_ms, total_s = 1e3 * np.array(run.times_s), sum(run.times_s)
    source = f"{len(run.times_s)} runs in {total_s:.1f} s after one for warm-up, loading left out"
    memory = "highest rise of resident memory while the file was opened and run once, sampled every 2 ms"
    figures = {
        "p50": measured(float(np.percentile(times_ms, 50)), "ms/tile", source),
        "p90": measured(float(np.percentile(times_ms, 90)), "ms/tile", source),
        "throughput": measured(len(run.times_s) / total_s, "frame/s", source),
        "power": _mean_power(run),
        "peak memory": measured(run.rise_bytes / 1e6, "MB", memory),
    }
    return Row("host", f"{run.name}, {tile_px} x {tile_px}", {**figures, **conditions})


def _ratio_row(runs: Sequence[Timed]) -> Row:
    int8, float32 = sorted(runs, key=lambda run: not is_quantised(run.model))
    ratio = statistics.median(float32.times_s) / statistics.median(int8.times_s)
    source = f"medians of {len(int8.times_s)} runs each, taking turns"
    return Row("host", "float32 time / INT8 time, here", {"ratio": measured(ratio, "x", source)})


def _mean_power(run: Timed) -> Figure:
    """Mean over the network's own runs, or why there is none."""
    missing = next((power for power in run.powers if power.value is None), None)
    if missing is not None:
        return unavailable("W", missing.reason)
    energy_j = sum((power.value or 0.0) * time_s for power, time_s in zip(run.powers, run.times_s, strict=True))
    return measured(energy_j / sum(run.times_s), "W", run.powers[0].source)
