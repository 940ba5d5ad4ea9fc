"""Measure the time of networks for a tile on this machine.

Networks are timed interleaved, so that other programs affect them alike. Load and memory are
reported with each time.
"""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
from beers_deploy.profiles.figures import Figure, Row, measured
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.onnx_file import is_quantized
from beers_deploy.quant.session import open_session, require_finite


@dataclass
class Timed:
    """A network with the measurements of its runs on this machine.

    Attributes:
        name: the name of the network in tables.
        model: the network.
        times_s: the time of each run in s.
        powers: the mean power in W during each run; unavailable where no counter can be read.
        held_bytes: the rise of this process's memory by opening the network and running it once.
    """

    name: str
    model: onnx.ModelProto
    times_s: list[float] = field(default_factory=list)
    powers: list[Figure] = field(default_factory=list)
    held_bytes: int = 0


def time_networks(
    runs: Sequence[Timed], tile_px: int, threads: int, min_time_s: float, min_runs: int
) -> None:
    """Time networks on a grey tile on this processor, and add the results to `runs`.

    The networks run in turn until each has run for `min_time_s` in total and `min_runs` times, so
    that other load on the machine affects all of them alike.

    Args:
        runs: the networks. Their times, powers and memory are filled in.
        tile_px: side of the tile in pixels.
        threads: the number of threads of onnxruntime; 0 for its default.
        min_time_s: the shortest total time of a network's runs, in s.
        min_runs: the smallest number of runs of a network.
    """
    calls = []
    for run in runs:
        shapes = inputs_of(run.model, tile_px, run.name)
        feed = {name: np.full((1, *shape), 0.25, np.float32) for name, shape in shapes.items()}
        before_bytes = resident_bytes()
        session = open_session(run.model, threads)
        require_finite(session.run(None, feed), run.name)  # warm-up, not counted
        run.held_bytes = resident_bytes() - before_bytes
        calls.append(partial(session.run, None, feed))

    for run, samples in zip(runs, interleaved(calls, min_runs, min_time_s), strict=True):
        run.times_s += [time_s for time_s, _ in samples]
        run.powers += [power for _, power in samples]


def _row(run: Timed, tile_px: int, conditions: Mapping[str, Figure]) -> Row:
    times_ms = 1e3 * np.array(run.times_s)
    total_s = sum(run.times_s)
    source = f"{len(run.times_s)} runs in {total_s:.1f} s after one for warm-up, loading left out"
    memory = "rise of resident memory once the file was opened and had run once"
    figures = {
        "p50": measured(float(np.percentile(times_ms, 50)), "ms/tile", source),
        "p90": measured(float(np.percentile(times_ms, 90)), "ms/tile", source),
        "throughput": measured(len(run.times_s) / total_s, "frame/s", source),
        "power": _mean_power(run),
        "memory": measured(run.held_bytes / 1e6, "MB", memory),
    }
    return Row("host", f"{run.name}, {tile_px} x {tile_px}", {**figures, **conditions})


def _mean_power(run: Timed) -> Figure:
    """Return the mean power over the network's own runs, or the figure that is unavailable."""
    # Runs differ in length: the mean power is energy over time, not the mean of the powers.
    energy_j = 0.0
    for power, time_s in zip(run.powers, run.times_s, strict=True):
        if power.value is None:
            return power
        energy_j += power.value * time_s
    return measured(energy_j / sum(run.times_s), "W", run.powers[0].source)


def host_rows(
    network: NetworkLike,
    target: TargetProfile,
    tile_px: int,
    threads: int = 0,
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
        the row of the step; and, with a counterpart, the ratio of float32 time to INT8 time.
    """
    require_cores("threads", threads)
    source = Network.load(network)
    other = other_precision(source)
    runs = [Timed(source.name, source.model)]
    if other is not None:
        precision = "INT8" if other.precision == "int8" else "float32"
        runs.append(Timed(f"{precision} of the same shape", other.model))
    min_time_s = target.value("measurement", "min_time_s")
    min_runs = int(target.value("measurement", "min_runs"))
    # The load is measured from one call to the next: this one opens the window of the timed runs.
    cpu_load()
    time_networks(runs, tile_px, threads, min_time_s, min_runs)
    conditions = conditions_of(threads or psutil.cpu_count(logical=False) or 1)
    rows = [_row(run, tile_px, conditions) for run in runs]
    if sensor is not None:
        rows.append(step_row(sensor, tile_px, min_time_s, min_runs))
    if other is not None:
        # False sorts before True: the INT8 network comes last.
        float32, int8 = sorted(runs, key=lambda run: is_quantized(run.model))
        ratio = statistics.median(float32.times_s) / statistics.median(int8.times_s)
        figure = measured(ratio, "x", f"medians of {len(int8.times_s)} runs each, interleaved")
        rows.append(Row("host", "float32 time / INT8 time, here", {"ratio": figure}))
    return rows


def step_row(sensor: Sensor, tile_px: int, min_time_s: float, min_runs: int) -> Row:
    """Time the consistency step on one thread of this machine, on a tile of noise.

    The step makes block means of a restored image agree with the raw image.

    Args:
        sensor: the sensor, whose blur the step uses.
        tile_px: side of the tile in pixels.
        min_time_s: the shortest total time of the runs, in s.
        min_runs: the smallest number of runs.
    """
    instrument = sensor.nominal()
    step = Consistency.of(instrument, sensor.reference.nominal())
    generator = np.random.default_rng(0)
    noise = generator.uniform(0, instrument.max_dn / 2, (tile_px, tile_px))
    raw = noise.astype(np.float32)
    side = Placed(tile_px, 0, 0, tile_px)
    call = partial(step.correction, raw, raw, side, side, (0, 0))
    call()
    samples = interleaved([call], min_runs, min_time_s)[0]
    times_ms = np.array([1e3 * time_s for time_s, _ in samples])
    source = f"{len(times_ms)} runs on one thread after one for warm-up"
    figures = {
        f"p{p}": measured(float(np.percentile(times_ms, p)), "ms/tile", source) for p in (50, 90)
    }
    return Row("host", f"consistency step, {tile_px} x {tile_px}", figures)


def conditions_of(threads: int) -> dict[str, Figure]:
    """Return the figures "threads" and "CPU load", which state how comparable a measured time is.

    Args:
        threads: the number of threads of the runtime. The load is that since the last call of
            `cpu_load`, other processes included.
    """
    return {"threads": measured(threads, "thread", "of the runtime"), "CPU load": cpu_load()}
