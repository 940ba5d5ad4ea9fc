"""What a point costs on the board, and by how much that of one point differs from another's.

Two predictions of the DPU lean on one model and share most of its error. So points are compared by the ratio of their
times, and its interval is made by this rule:

- Same network, configuration and tile: they differ in the count of tiles alone, and the ratio is exact.
- Otherwise the ratio is taken with nothing hidden behind computing and with everything hidden (the same board for
  both), and widened by what ratios of published rates were off by: 90 % quantile over pairs of networks of one family
  on one configuration each, neither seen by the fit.
- The power of a run is known for one network and no configuration: energies of two networks or configurations may
  also differ by the whole range assumed for it.
- Two chains on the board's CPU do the same kinds of work and share the factor by which it is slower than this host:
  their CPU times are compared. A method of unknown kinds may be slowed down otherwise: intervals must not overlap.
- A method on the CPU and a network on the DPU share nothing: their intervals must not overlap.
"""

import math
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise

import numpy as np
import onnx

from deploy.bench.board_cpu import CpuTime, board_cpu_row, chain_time
from deploy.bench.rates import measured_rates
from deploy.bench.tables import Swath, efficiency, energy, swath_latency
from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.checker.placement import place
from deploy.dpu.cost.constants import Constants, Structure
from deploy.dpu.cost.latency import Prediction, dpu_power, predict
from deploy.dpu.cost.published import published_cases
from deploy.dpu.cost.validation import leave_out, regimes_of
from deploy.dpu.reading import network_of
from model.traditional.settings import QUALITIES
from model.traditional.work import chain_work
from profiles import load_target
from profiles.figures import Figure, predicted

FRAME_PX = 640
FIGURES = ("latency", "throughput", "power", "energy", "efficiency")
PAIR_QUANTILE = 0.9
CHAIN = "traditional-"
"""What a chain's quality follows in its name."""
HIDING = (0.0, 1.0)
"""Shares of the shorter of compute and memory that do not hide behind the longer: all that is possible."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class DpuRun:
    """A network on the DPU, for a swath in whole tiles and whole batches."""

    network: str
    dpu: Dpu
    prediction: Prediction
    swath: Swath

    @property
    def batches(self) -> int:
        """Batches of the swath, the last perhaps not full."""
        return math.ceil(self.swath.tiles / self.prediction.batch)

    def latency_s(self, serial: float) -> float:
        """Of the swath, if that share is not hidden."""
        hidden = serial - self.prediction.structure.serial
        shorter_s = math.fsum(min(layer.compute_s, layer.memory_s) for layer in self.prediction.layers)
        batch_s = self.prediction.batch_time_s + hidden * shorter_s
        images = self.batches * self.prediction.batch
        return images / self.prediction.rate(batch_s, self.prediction.host_s)

    def figures(self) -> dict[str, Figure]:
        """The five figures of the board."""
        power, latency = dpu_power(self.dpu), swath_latency(self.prediction, self.batches)
        return _figures(latency, power, self.swath)


@dataclass(frozen=True)
class CpuRun:
    """A method on the board's own processor: what the swath takes on one core of this host, and of which kinds."""

    time: CpuTime
    swath: Swath

    def figures(self) -> dict[str, Figure]:
        """The five figures of the board."""
        row = board_cpu_row(self.time, self.swath, load_target("vck190"), measured_rates())
        return _figures(row.figures["latency"], row.figures["power"], self.swath)


def cpu_run(method: str, cpu_s: Interval, swath: Swath) -> CpuRun:
    """A method of that name; of the chains the kinds of work are known, of others not.

    Args:
        method: as points are called.
        cpu_s: CPU time here that the swath takes, least and most, in s.
        swath: the image it is about.
    """
    quality = QUALITIES.get(method.removeprefix(CHAIN))
    if quality is None:
        return CpuRun(CpuTime(cpu_s, {}), swath)
    rates, work = measured_rates(), chain_work(swath.height_px, swath.width_px, quality)
    explained = math.fsum(rates.times_s(work).values()) / math.sqrt(cpu_s[0] * cpu_s[1])
    return CpuRun(chain_time(cpu_s, work, rates, explained), swath)


BoardRun = DpuRun | CpuRun


def _figures(latency: Figure, power: Figure, swath: Swath) -> dict[str, Figure]:
    frames, (fast_s, slow_s) = swath.pixels / FRAME_PX**2, latency.interval or (latency.value or 0.0,) * 2
    source = f"pixels of the swath as frames of {FRAME_PX} x {FRAME_PX}, over the latency: {latency.source}"
    rate = predicted(frames / (latency.value or math.inf), "frame/s", (frames / slow_s, frames / fast_s), source)
    found = (latency, rate, power, energy(latency, power), efficiency(swath.pixels, latency, power))
    return {f"board {name}": figure for name, figure in zip(FIGURES, found, strict=True)}


def latency_ratio(a: BoardRun, b: BoardRun) -> Interval:
    """How many times as long `a` takes as `b`: see the module's rule."""
    if isinstance(a, DpuRun) and isinstance(b, DpuRun):
        ratios = [a.latency_s(serial) / b.latency_s(serial) for serial in HIDING]
        spread = 1.0 if _same(a, b) and a.swath.tile_px == b.swath.tile_px else math.exp(pair_error())
        return min(ratios) / spread, max(ratios) * spread
    if isinstance(a, CpuRun) and isinstance(b, CpuRun):
        if a == b:
            return 1.0, 1.0
        if a.time.shares and b.time.shares:
            return a.time.cpu_s[0] / b.time.cpu_s[1], a.time.cpu_s[1] / b.time.cpu_s[0]
    return _apart(a, b, "board latency")


def energy_ratio(a: BoardRun, b: BoardRun) -> Interval:
    """How many times the energy of `b` that `a` takes: see the module's rule."""
    if isinstance(a, DpuRun) and isinstance(b, DpuRun):
        low, high = latency_ratio(a, b)
        watts = a.dpu.limit("power", "dpu_range_w")
        spread = 1.0 if _same(a, b) else watts.high / watts.low
        return low / spread, high * spread
    if isinstance(a, CpuRun) and isinstance(b, CpuRun):
        return latency_ratio(a, b)
    return _apart(a, b, "board energy")


def _same(a: DpuRun, b: DpuRun) -> bool:
    return (a.network, a.dpu.name) == (b.network, b.dpu.name)


def _apart(a: BoardRun, b: BoardRun, key: str) -> Interval:
    (a_low, a_high), (b_low, b_high) = (run.figures()[key].interval or (1.0, 1.0) for run in (a, b))
    return a_low / b_high, a_high / b_low


@cache
def pair_error() -> float:
    """What ln of the ratio of two published rates was off by, at most, in 9 of 10 pairs of one family.

    Each network predicted without itself; only rates that the DPU bounds.
    """
    dpu = load_dpu("vck190")
    cases = published_cases("vck190", Structure.of(dpu))
    errors = leave_out(cases, [row.network for row in cases.rows])
    regimes = regimes_of(cases, Constants.of(dpu))
    kept = [(row, error) for row, error, kind in zip(cases.rows, errors, regimes, strict=True) if kind != "host"]
    apart = [
        abs(x - y) for (a, x), (b, y) in combinations(kept, 2) if a.family == b.family and a.network != b.network
    ]
    return float(np.quantile(apart, PAIR_QUANTILE))


def predict_model(model: onnx.ModelProto, dpu: Dpu, tile_px: int) -> Prediction:
    """What the cost model says of a network.

    Raises:
        ModelError: it does not run whole on the DPU.
    """
    return predict(place(network_of(model, tile_px), dpu), dpu)


def kept_tiles_px(model: onnx.ModelProto, dpu: Dpu, step_px: int, most_px: int) -> list[int]:
    """Sides of tiles beyond which more layers pass their maps through memory, in steps, up to a largest side.

    Raises:
        ModelError: a network that does not run whole on the DPU.
    """
    sides = range(step_px, most_px + 1, step_px)
    counts = [_streaming_layers(model, dpu, side) for side in sides]
    return [side for side, (here, next_) in zip(sides, pairwise(counts), strict=False) if next_ > here]


def _streaming_layers(model: onnx.ModelProto, dpu: Dpu, tile_px: int) -> int:
    layers = predict_model(model, dpu, tile_px).layers
    return sum(bool(layer.work.load_map_bytes or layer.work.store_map_bytes) for layer in layers)
