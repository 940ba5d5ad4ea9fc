"""What this machine takes: the traditional pipeline on an image, and networks' times for a tile.

Networks are timed interleaved, so that whatever else runs here meets them alike; load, clock
and memory stand beside what was measured.
"""

import math
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import psutil
import torch

from deploy.bench.board_cpu import board_cpu_row, chain_time, kind_rows
from deploy.bench.profile import interleaved, node_rows, profile, timed
from deploy.bench.rates import Rates, measured_rates
from deploy.bench.tables import TABLE, Swath, efficiency
from deploy.dpu.reading import inputs_of
from deploy.host_state import Watch, memory_rise, watched
from deploy.networks import other_precision
from model.processor import require_cores
from model.simulator.acquire import MARGIN_PX, simulate_pair
from model.simulator.detector import Draw
from model.simulator.procedural import procedural_scene
from model.traditional.pipeline import Chain, quality_named, restore_traditional
from model.traditional.rows import one_thread_per_operation
from model.traditional.work import chain_work
from profiles import SensorProfile, TargetProfile
from profiles.figures import Figure, Row, measured, predicted, unavailable
from quant.onnx_file import is_quantised, load_onnx
from quant.session import open_session, require_finite


@dataclass
class Timed:
    """A network, and what its runs took."""

    name: str
    model: onnx.ModelProto
    times_s: list[float] = field(default_factory=list)
    powers: list[Figure] = field(default_factory=list)
    rise_bytes: int = 0


def time_networks(runs: Sequence[Timed], tile_px: int, threads: int, min_time_s: float, min_runs: int) -> None:
    """Time each for one tile, interleaved, until all have run for `min_time_s` and `min_runs` times; fills in `runs`.

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

    def enough(found: Sequence[Sequence[tuple[float, Figure]]]) -> bool:
        shortest_s = min(sum(time_s for time_s, _ in taken) for taken in found)
        return shortest_s >= min_time_s and len(found[0]) >= min_runs

    for run, taken in zip(runs, interleaved(calls, lambda call: timed(call)[1:], enough), strict=True):
        run.times_s += [time_s for time_s, _ in taken]
        run.powers += [power for _, power in taken]


def tile_feed(model: onnx.ModelProto, tile_px: int, where: str = "ONNX model") -> dict[str, np.ndarray]:
    """A grey tile (1, C, tile, tile) for every input.

    Raises:
        ModelError: inputs that are no images, or fixed to another tile.
    """
    shapes = inputs_of(model, tile_px, where)
    return {name: np.full((1, *shape), 0.25, np.float32) for name, shape in shapes.items()}


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
    source = f"medians of {len(int8.times_s)} runs each, interleaved"
    return Row("host", "float32 time / INT8 time, here", {"ratio": measured(ratio, "x", source)})


def _mean_power(run: Timed) -> Figure:
    """Mean over the network's own runs, or why there is none."""
    missing = next((power for power in run.powers if power.value is None), None)
    if missing is not None:
        return unavailable("W", missing.reason)
    energy_j = sum((power.value or 0.0) * time_s for power, time_s in zip(run.powers, run.times_s, strict=True))
    return measured(energy_j / sum(run.times_s), "W", run.powers[0].source)


CROP_PX = 256
CROPS = 3
QUALITY = quality_named("standard")
"""What `Chain` takes when nothing is said."""


@dataclass(frozen=True)
class Sensors:
    """The sensor that acquired an image and the one to imitate."""

    degraded: SensorProfile
    reference: SensorProfile


def drawn_acquisition(swath: Swath, sensors: Sensors, seed: int = 0) -> np.ndarray:
    """Digital numbers of a drawn scene, as large as the swath but no larger than the crops need."""
    height = min(swath.height_px, CROP_PX)
    width = min(swath.width_px, CROPS * CROP_PX)
    ratio = int(sensors.degraded.oversampling.low)
    height, width = ((side + 2 * MARGIN_PX) * ratio for side in (height, width))
    scene = procedural_scene(height, width, np.random.default_rng(seed))
    pair = simulate_pair(scene.radiance, sensors.degraded.nominal(), sensors.reference.nominal(), ratio, Draw(seed))
    return pair.degraded.numpy()


def traditional_rows(
    dn: np.ndarray, swath: Swath, sensors: Sensors, boards: Sequence[TargetProfile], budget_s: float = 60.0
) -> tuple[list[Row], list[Row]]:
    """The traditional pipeline on (H, W) digital numbers, here and scaled to the boards' processors; work by kind.

    Crops are timed first, one small run for warm-up left out. When `dn` is the whole swath and its estimate lies
    within `budget_s`, it is run whole and its time is measured; else the swath's is predicted from the crops', with
    the fastest and the slowest crop as its interval. The board's is scaled from their median CPU time on one core.
    """
    threads = torch.get_num_threads()
    with watched() as watch:
        latency, power = _chain_latency(dn, swath, sensors, budget_s, f"here, {threads} threads")
    rates, work = measured_rates(), chain_work(swath.height_px, swath.width_px, QUALITY)
    cpu_s_per_px, explained = _one_core(list(_crops(dn)), sensors, rates)
    time = chain_time((cpu_s_per_px * swath.pixels,) * 2, work, rates, explained)
    counted = "time of the work counted by kind over CPU time, one core, median of the crops"
    figures = {
        "latency": latency,
        "throughput": _rate(swath.frames, latency),
        "power": power,
        "efficiency": efficiency(swath.pixels, latency, power),
        "explained by kinds": measured(100 * explained, "%", counted),
        **_conditions(watch, threads),
    }
    here = Row(TABLE, "traditional pipeline on this CPU", figures)
    there = [board_cpu_row(time, swath, board, rates) for board in boards]
    return [here, *there], kind_rows(time, work, boards[0], rates)


def _one_core(crops: Sequence[np.ndarray], sensors: Sensors, rates: Rates) -> tuple[float, float]:
    """CPU time of one core for a pixel, in s, and the share of it that the counted work explains.

    Of the median crop. With several threads on a busy machine their waiting for one another is CPU time too.
    """
    with one_thread_per_operation():
        cpu_s = [_wall_and_cpu_s(crop, sensors)[1] for crop in crops]
    height, width = crops[0].shape
    counted_s = math.fsum(rates.times_s(chain_work(height, width, QUALITY)).values())
    median_s = statistics.median(cpu_s)
    return median_s / crops[0].size, counted_s / median_s


def _chain_latency(
    dn: np.ndarray, swath: Swath, sensors: Sensors, budget_s: float, place: str
) -> tuple[Figure, Figure]:
    """Of the chain on the swath: latency, and the processor's power."""
    crops = list(_crops(dn))
    _restore(crops[0][:32, :32], sensors)
    times_s, _, power = timed(lambda: [_wall_and_cpu_s(crop, sensors)[0] for crop in crops])
    wall_s = [t * swath.pixels / crop.size for t, crop in zip(times_s, crops, strict=True)]
    estimate_s = statistics.median(wall_s)
    if dn.size == swath.pixels and estimate_s <= budget_s:
        _, elapsed_s, power = timed(lambda: _restore(dn, sensors))
        return measured(elapsed_s, "s", f"the whole image, {place}"), power
    source = f"by proportion from {len(crops)} crops of {crops[0].shape[1]} x {crops[0].shape[0]}, {place}"
    return predicted(estimate_s, "s", (min(wall_s), max(wall_s)), source), power


def _wall_and_cpu_s(dn: np.ndarray, sensors: Sensors) -> tuple[float, float]:
    """What the chain takes on the wall's clock, and of all this process's cores together."""
    wall, cpu = time.perf_counter(), time.process_time()
    _restore(dn, sensors)
    return time.perf_counter() - wall, time.process_time() - cpu


def host_rows(model: Path, target: TargetProfile, tile_px: int, threads: int = 0) -> list[Row]:
    """A network's time for one tile through onnxruntime, float32 and INT8 interleaved, and its nodes' times.

    Each runs for the target's minimum time and count, one run for warm-up left out. Its pair in the other
    precision is the shipped network of the same variant; without one it runs alone.

    Raises:
        OptionError: more threads than cores.
    """
    require_cores("--threads", threads)
    given = load_onnx(model)
    other = other_precision(given)
    runs = [Timed(model.stem, given)]
    if other is not None:
        runs.append(Timed(f"{'INT8' if is_quantised(other) else 'float32'} of the same shape", other))
    min_time_s, min_runs = target.value("measurement", "min_time_s"), int(target.value("measurement", "min_runs"))
    with watched() as watch:
        time_networks(runs, tile_px, threads, min_time_s, min_runs)
    conditions = _conditions(watch, threads or psutil.cpu_count(logical=False) or 1)
    nodes, total_ms = profile(given, tile_feed(given, tile_px), threads)
    return [*timed_rows(runs, tile_px, conditions), *node_rows(nodes, total_ms)]


def _conditions(watch: Watch, threads: int) -> dict[str, Figure]:
    return {
        "threads": measured(threads, "thread", "of the runtime"),
        "CPU load": watch.load,
        "clock": watch.clock,
    }


def _rate(frames: float, latency: Figure) -> Figure:
    """Frames a second, of the latency's own mode."""
    time_s = latency.value or 0.0
    if latency.interval is None:
        return measured(frames / time_s, "frame/s", latency.source)
    low, high = latency.interval
    return predicted(frames / time_s, "frame/s", (frames / high, frames / low), latency.source)


def _crops(dn: np.ndarray) -> Iterator[np.ndarray]:
    """Square crops along the image's diagonal, or the image where it is no larger."""
    height, width = (min(CROP_PX, side) for side in dn.shape)
    for k in range(CROPS):
        top, left = ((side - crop) * k // (CROPS - 1) for side, crop in zip(dn.shape, (height, width), strict=True))
        yield dn[top : top + height, left : left + width]


def _restore(dn: np.ndarray, sensors: Sensors) -> torch.Tensor:
    image = torch.from_numpy(np.ascontiguousarray(dn, dtype=np.float32))
    return restore_traditional(image, Chain(sensors.degraded.nominal(), sensors.reference.nominal()))
