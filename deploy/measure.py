"""What this machine takes: the traditional pipeline on an image, and a network's time for a tile."""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from deploy.bench import TABLE, Swath, efficiency
from deploy.energy import timed
from deploy.results import Row, measured, predicted
from model.simulator.acquire import MARGIN_PX, simulate_pair
from model.simulator.draws import Draw
from model.simulator.procedural import procedural_scene
from model.traditional.pipeline import Chain, restore_traditional
from profiles import SensorProfile, TargetProfile
from quant.onnx_file import load_onnx
from quant.session import open_session

CROP_PX = 256
CROPS = 3


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


def traditional_rows(dn: np.ndarray, swath: Swath, sensors: Sensors, budget_s: float = 60.0) -> list[Row]:
    """The traditional pipeline on (H, W) digital numbers: whole if that fits in the budget, else by proportion.

    Crops are timed first, one small run for warm-up left out. When `dn` is the whole swath and its estimate lies
    within `budget_s`, it is run whole and its time is measured; else the swath's is predicted from the crops', with
    the fastest and the slowest crop as its interval.
    """
    crops = list(_crops(dn))
    _restore(crops[0][:32, :32], sensors)
    timings, _, power = timed(lambda: [timed(partial(_restore, crop, sensors))[1] for crop in crops])
    times_s = [t * swath.pixels / crop.size for t, crop in zip(timings, crops, strict=True)]
    estimate_s, place = statistics.median(times_s), f"here, {torch.get_num_threads()} threads"
    if dn.size == swath.pixels and estimate_s <= budget_s:
        _, elapsed_s, power = timed(lambda: _restore(dn, sensors))
        source = f"the whole image, {place}"
        latency = measured(elapsed_s, "s", source)
        throughput = measured(swath.frames / elapsed_s, "frame/s", source)
    else:
        source = f"by proportion from {len(crops)} crops of {crops[0].shape[1]} x {crops[0].shape[0]}, {place}"
        fast_s, slow_s = min(times_s), max(times_s)
        latency = predicted(estimate_s, "s", (fast_s, slow_s), source)
        rates = (swath.frames / slow_s, swath.frames / fast_s)
        throughput = predicted(swath.frames / estimate_s, "frame/s", rates, source)
    figures = {
        "latency": latency,
        "throughput": throughput,
        "power": power,
        "efficiency": efficiency(swath.pixels, latency, power),
    }
    return [Row(TABLE, "traditional pipeline on this CPU", figures)]


def host_rows(model: Path, target: TargetProfile, tile_px: int, threads: int = 0) -> list[Row]:
    """A network's time for one tile through onnxruntime: median and 90th percentile over a minimum time and count."""
    session = open_session(load_onnx(model), threads)
    feed = {i.name: np.full((1, i.shape[1], tile_px, tile_px), 0.25, np.float32) for i in session.get_inputs()}
    session.run(None, feed)  # warm-up, not counted
    min_time_s, min_runs = target.value("measurement", "min_time_s"), target.value("measurement", "min_runs")
    samples: list[float] = []

    def repeat() -> None:
        while len(samples) < min_runs or sum(samples) < min_time_s:
            samples.append(timed(lambda: session.run(None, feed))[1])

    _, total_s, power = timed(repeat)
    source = f"{len(samples)} runs in {total_s:.1f} s after one for warm-up, loading left out"
    figures = {
        "p50": measured(1e3 * float(np.percentile(samples, 50)), "ms/tile", source),
        "p90": measured(1e3 * float(np.percentile(samples, 90)), "ms/tile", source),
        "throughput": measured(len(samples) / total_s, "frame/s", source),
        "power": power,
    }
    return [Row("host", f"{model.stem}, {tile_px} x {tile_px}", figures)]


def _crops(dn: np.ndarray) -> Iterator[np.ndarray]:
    """Square crops along the image's diagonal, or the image where it is no larger."""
    height, width = (min(CROP_PX, side) for side in dn.shape)
    for k in range(CROPS):
        top, left = ((side - crop) * k // (CROPS - 1) for side, crop in zip(dn.shape, (height, width), strict=True))
        yield dn[top : top + height, left : left + width]


def _restore(dn: np.ndarray, sensors: Sensors) -> torch.Tensor:
    image = torch.from_numpy(np.ascontiguousarray(dn, dtype=np.float32))
    return restore_traditional(image, Chain(sensors.degraded.nominal(), sensors.reference.nominal()))
