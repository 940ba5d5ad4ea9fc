"""Measure the time of networks for a tile on this machine.

Networks are timed interleaved, so that other programs affect them alike. Load and memory are
reported with each time.
"""

import statistics
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import numpy as np
import onnx
import psutil

from beers_deploy.dpu.reading import inputs_of
from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.consistency.step import Consistency
from beers_deploy.model.processor import require_cores
from beers_deploy.network import Network, NetworkLike, other_precision
from beers_deploy.performance.timing import cpu_load, interleaved, resident_bytes
from beers_deploy.profiles.errors import ModelError, counted
from beers_deploy.profiles.figures import Figure, Row, measured
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.session import open_session, require_finite
from beers_deploy.restoration.steps import keeps_pixels

Samples = Sequence[tuple[float, Figure]]
"""The time in s and the mean power in W of each run."""


def _opened(
    model: onnx.ModelProto, name: str, tile_px: int, threads: int
) -> tuple[Callable[[], object], int]:
    """Return a call that runs a network on a grey tile, and the rise of this process's memory in
    bytes by opening the network and running it once.
    """
    shapes = inputs_of(model, tile_px, name)
    feed = {key: np.full((1, *shape), 0.25, np.float32) for key, shape in shapes.items()}
    before_bytes = resident_bytes()
    session = open_session(model, threads)
    require_finite(session.run(None, feed), name)  # warm-up, not counted
    return partial(session.run, None, feed), resident_bytes() - before_bytes


def _figures(samples: Samples, held_bytes: int) -> dict[str, Figure]:
    """Return the figures of the runs of a network."""
    total_s = sum(time_s for time_s, _ in samples)
    runs = counted(len(samples), "run")
    source = f"{runs} in {total_s:.1f} s after one for warm-up, loading left out"
    memory = "rise of resident memory once the file was opened and had run once"
    power = next((each for _, each in samples if each.value is None), samples[0][1])
    if power.value is not None:
        # Runs differ in length: the mean power is energy over time, not the mean of the powers.
        energy_j = sum((each.value or 0.0) * time_s for time_s, each in samples)
        power = measured(energy_j / total_s, "W", power.source)
    return _percentiles(samples, source) | {
        "throughput": measured(len(samples) / total_s, "frame/s", source),
        "power": power,
        "memory": measured(held_bytes / 1e6, "MB", memory),
    }


def _percentiles(samples: Samples, source: str) -> dict[str, Figure]:
    """Return the median and the 90th percentile of the times of some runs."""
    times_ms = [1e3 * time_s for time_s, _ in samples]
    return {
        f"p{p}": measured(float(np.percentile(times_ms, p)), "ms/tile", source) for p in (50, 90)
    }


def host_rows(
    network: NetworkLike,
    target: TargetProfile,
    tile_px: int,
    threads: int,
    sensor: Sensor | None = None,
) -> list[Row]:
    """Time a network for one tile on this machine, next to its counterpart in the other precision.

    The counterpart is the shipped network of the same architecture; if there is none, the network
    runs alone. Both run in onnxruntime in turn, after one run of each for warm-up.

    Args:
        network: the network, in float32 or INT8.
        target: the board whose file states the shortest time and the smallest number of runs.
        tile_px: side of the tile in pixels.
        threads: the number of threads; 0 for the default of onnxruntime.
        sensor: a sensor whose consistency step, which makes block means of the result agree with
            the raw image, is timed too; None for none.

    Returns:
        A row for each network with its median time (p50), 90th percentile, rate, power and memory;
        the row of the step, for all bands, if it can follow the network; and, with a counterpart,
        the ratio of float32 time to INT8 time.
    """
    require_cores("threads", threads)
    source = Network.load(network)
    other = other_precision(source)
    networks = {source.name: source}
    if other is not None:
        precision = "INT8" if other.precision == "int8" else "float32"
        networks[f"{precision} of the same shape"] = other
    min_time_s = target.value("measurement", "min_time_s")
    min_runs = int(target.value("measurement", "min_runs"))
    # The load is measured from one call to the next: this one opens the window of the timed runs.
    cpu_load()
    opened = [_opened(each.model, name, tile_px, threads) for name, each in networks.items()]
    runs = interleaved([call for call, _ in opened], min_runs, min_time_s)
    conditions = conditions_of(threads or psutil.cpu_count(logical=False) or 1)
    rows = []
    for name, samples, (_, held_bytes) in zip(networks, runs, opened, strict=True):
        figures = _figures(samples, held_bytes) | conditions
        rows.append(Row("host", f"{name}, {tile_px} x {tile_px}", figures))
    bands = 0
    # The step cannot follow a network that cannot be tiled.
    with suppress(ModelError):
        bands = source.geometry.channels_out if keeps_pixels(source.geometry) else 0
    if sensor is not None and bands:
        figures = _step_figures(sensor, tile_px, bands, (min_runs, min_time_s))
        rows.append(Row("host", f"consistency step, {tile_px} x {tile_px}", figures))
    if other is not None:
        own_s, other_s = (statistics.median(time_s for time_s, _ in run) for run in runs)
        ratio = own_s / other_s if other.precision == "int8" else other_s / own_s
        figure = measured(ratio, "x", f"medians of {len(runs[0])} runs each, interleaved")
        rows.append(Row("host", "float32 time / INT8 time, here", {"ratio": figure}))
    return rows


def _step_figures(
    sensor: Sensor, tile_px: int, bands: int, least: tuple[int, float]
) -> dict[str, Figure]:
    """Time the consistency step of all bands of a tile of noise, on one thread.

    Args:
        sensor: the sensor whose step is timed.
        tile_px: the side of the tile in pixels.
        bands: the number of bands.
        least: the smallest number of runs, and their shortest total time in s.
    """
    instrument = sensor.nominal()
    step = Consistency.of(instrument, sensor.reference.nominal())
    generator = np.random.default_rng(0)
    noise = generator.uniform(0, instrument.max_dn / 2, (tile_px, tile_px))
    raw = noise.astype(np.float32)
    side = Placed(tile_px, 0, 0, tile_px)

    def correct() -> None:
        for _ in range(bands):
            step.correction(raw, raw, side, side, (0, 0))

    correct()
    (samples,) = interleaved([correct], *least)
    runs = counted(len(samples), "run")
    return _percentiles(samples, f"{runs} on one thread after one for warm-up")


def conditions_of(threads: int) -> dict[str, Figure]:
    """Return the figures "threads" and "CPU load", which state how comparable a measured time is.

    Args:
        threads: the number of threads of the runtime. The load is that since the last call of
            `cpu_load`, other processes included.
    """
    return {"threads": measured(threads, "thread", "of the runtime"), "CPU load": cpu_load()}
