"""How long a network takes on the DPU, layer by layer, how far off that may be, and at what power.

Counts come from `work` and `host`, the formula from `model`, constants and widths from the target's
[cost], where `benchmarks/cost_model` writes what it finds on published networks. None of them is
ConvBEERS: the paper's own figure is what the model is compared with, never what it is made from.

The interval is FPS e^-width to FPS e^width, so wide that nine of ten families of networks, each
left out of the fit once, lie inside. Each part of an image's time has a width of its own, and the
rate has their mean, weighed by how much it follows each; beyond all networks that were fitted it is
no narrower than `width_outside` (docs/explanation/cost-model.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from beers_deploy.dpu.board import Dpu, Levels
from beers_deploy.dpu.checker.placement import Placement
from beers_deploy.dpu.cost.host import (
    Task,
    consistency_interval_s,
    host_parts_s,
    placed_work,
    refused_interval_s,
    task_of,
)
from beers_deploy.dpu.cost.kinship import correction, levels_of
from beers_deploy.dpu.cost.model import (
    PARTS,
    Constants,
    Interval,
    Layers,
    Structure,
    between,
    frame_rate,
    shares_of,
)
from beers_deploy.dpu.cost.work import Work, count_work, largest_map_bytes
from beers_deploy.dpu.graph import Operation
from beers_deploy.profiles.errors import ModelError, printable
from beers_deploy.profiles.figures import Figure, predicted, unavailable

Bound = Literal["host", "DPU"]


@dataclass(frozen=True)
class LayerCost:
    """The predicted times of one operation for a batch, and its work for one image."""

    work: Work
    compute_s: float
    memory_s: float
    time_s: float

    @property
    def bound(self) -> str:
        """Return which part of the time is longest: compute, memory or, if neither is, overhead."""
        overhead_s = self.time_s - self.compute_s - self.memory_s
        parts = {"compute": self.compute_s, "memory": self.memory_s, "overhead": overhead_s}
        return max(parts, key=lambda name: parts[name])


@dataclass(frozen=True)
class Prediction:
    """The prediction of the cost model for one network on one configuration.

    Attributes:
        dpu: the configuration.
        alone_s: time of one core's batch on the DPU while its other cores rest.
        layers: the cost of each layer, for a batch.
        host_s: time of an image on all cores of the host together.
        task: what the host does with the results.
        width: half the width of the interval, in ln(FPS).
        bound: what limits the rate, the DPU or the host.
        levels: the properties that it shares with runs of the user's board.
        speed: the factor by which these runs show the board to be faster than the constants.
        outside: properties outside the range of the fitted networks; empty if there are none.
        note: what was assumed of the file.
        refused: names of the nodes that the DPU refuses and the host runs.
        refused_s: shortest and longest time of these nodes, a part of `host_s`.
        step_s: shortest and longest time of the consistency step, a part of `host_s`.
    """

    dpu: Dpu
    alone_s: float
    layers: tuple[LayerCost, ...]
    host_s: float
    task: Task
    width: float
    bound: Bound
    levels: Levels
    speed: float
    outside: tuple[str, ...]
    note: str
    refused: tuple[str, ...]
    refused_s: Interval
    step_s: Interval

    @property
    def batch(self) -> int:
        """Return the number of images that are processed at once."""
        return self.dpu.batch

    @cached_property
    def batch_time_s(self) -> float:
        """Return the time of the layers of one batch on the DPU, without the host."""
        return math.fsum(layer.time_s for layer in self.layers)

    @property
    def fps(self) -> float:
        """Return the images per second, if batches follow each other and the host works in
        parallel.
        """
        return self._rate(self.host_s)

    @property
    def fps_interval(self) -> Interval:
        """Return the lowest and the highest rate in frames per second.

        The first assumes the slowest host, the second the fastest; both are widened by `spread`.
        """
        # The host at its fastest comes first.
        fast, slow = map(self._rate, self._host_ends_s)
        return self._widened(slow, fast)

    @property
    def host_interval_s(self) -> Interval:
        """Return the lowest and the highest value of `host_s`."""
        return self._widened(*self._host_ends_s)

    @property
    def latency_s(self) -> float:
        """Return the time in s from the first image of a batch to its last result, with one thread.

        The thread uses one core of the DPU, then one core of the host. The relative error is about
        that of the rate (docs/reference/boards.md), so the interval has the width of the rate's.
        """
        return self._latency_s(self.host_s)

    @property
    def latency_interval_s(self) -> Interval:
        """Return the lowest and the highest value of `latency_s`."""
        return self._widened(*map(self._latency_s, self._host_ends_s))

    def _widened(self, low: float, high: float) -> Interval:
        return low / self.spread, high * self.spread

    def _latency_s(self, host_s: float) -> float:
        # `host_s` is the time of all cores together: one thread does the work on one of them.
        return self.alone_s + self.dpu.handlers * host_s * self.dpu.whole("cpu", "cores")

    @property
    def spread(self) -> float:
        """Return the factor by which each time may be wrong in either direction."""
        return math.exp(self.width)

    @property
    def _host_ends_s(self) -> Interval:
        """Return the host's time with the shortest and with the longest time of the refused nodes
        and of the consistency step.
        """
        rest_s = self.host_s - between(self.refused_s) - between(self.step_s)
        # Only these two parts have ends of their own: the rest of the host's time is fitted.
        low_s, high_s = (sum(ends) for ends in zip(self.refused_s, self.step_s, strict=True))
        return rest_s + low_s, rest_s + high_s

    def _rate(self, host_s: float) -> float:
        """Return images a second if the host takes that long for an image."""
        dpu_s = self.batch_time_s / self.batch
        return frame_rate(dpu_s, host_s, self.dpu.value("cost", "contention_exponent"))

    @property
    def operations(self) -> int:
        """Return the int8 operations for one image."""
        return sum(layer.work.operations for layer in self.layers)

    @property
    def streamed_bytes(self) -> int:
        """Return the bytes of feature maps that pass through memory for one image."""
        return sum(layer.work.map_bytes for layer in self.layers)


def predict(
    placement: Placement, dpu: Dpu, task: Task | None = None, step_px: float = 0.0
) -> Prediction:
    """Predict the rate and latency of a network on a DPU, from formula and constants.

    The DPU must run all convolutions. Nodes that it refuses before the first or after the last of
    them run on the host.

    Args:
        placement: where each node of the network runs.
        dpu: the configuration of a board.
        task: what the host does with the results; None derives it from the file.
        step_px: pixels of an image for which the host computes the consistency step; 0 for no step.

    Raises:
        ModelError: the DPU refuses a node inside the core, or the network has no convolution.
    """
    if placement.cutting:
        names = ", ".join(node.op.name for node in placement.cutting[:3])
        raise ModelError(
            "The cost model needs a core that runs on the DPU as a whole, but the DPU refuses "
            f"{printable(names)}. Run 'beers-deploy check' for the reasons and remedies."
        )
    constants = Constants.of(dpu)
    structure = Structure.of(dpu)
    works = count_work(placement.core, dpu)
    if not any(work.operations for work in works):
        raise ModelError(
            "The cost model finds no work for the DPU, because the network has no convolution. "
            "Give a network with convolutions."
        )
    columns = Layers.of(works, dpu)
    parts_s = columns.parts_s(constants, structure)
    times_s = columns.time_s(constants, structure)
    refused = [node.op for node in placement.failed]
    refused_s = refused_interval_s(refused, dpu)
    task = task or task_of(placement)
    step_s = consistency_interval_s(step_px, dpu) if step_px else (0.0, 0.0)
    host_parts = host_parts_s(placed_work(placement, task)[None], constants)
    host_parts /= dpu.whole("cpu", "cores")
    # Work that no rate is published for is taken at the geometric mean of its two ends.
    host_parts[0, 0] += between(refused_s) + between(step_s)
    host_s = float(host_parts.sum())
    shares = shares_of(
        parts_s.sum(axis=0)[None] / dpu.batch, host_parts, structure.contention_exponent
    )
    width = float(shares[0] @ [dpu.value("cost", WIDTHS[part]) for part in PARTS])
    outside = _outside(placement.core, dpu)
    if outside:
        width = max(width, dpu.value("cost", WIDTHS["outside"]))
    bound: Bound = "host" if host_s > math.fsum(times_s) / dpu.batch else "DPU"
    levels = levels_of(placement.core, dpu, bound)
    # The runs of the owner's board correct all times alike.
    speed, width_left = correction(levels, dpu.runs)
    layer_times_s = np.stack(
        [columns.compute_s(constants), columns.memory_s(constants), times_s], axis=1
    )
    layers = zip(works, (layer_times_s / speed).tolist(), strict=True)
    return Prediction(
        dpu=dpu,
        alone_s=float(columns.time_s(constants, structure, alone=True).sum()) / speed,
        layers=tuple(LayerCost(work, *seconds) for work, seconds in layers),
        host_s=host_s / speed,
        task=task,
        width=width * width_left,
        bound=bound,
        levels=levels,
        speed=speed,
        outside=outside,
        note=placement.note,
        refused=tuple(op.name for op in refused),
        refused_s=(refused_s[0] / speed, refused_s[1] / speed),
        step_s=(step_s[0] / speed, step_s[1] / speed),
    )


WIDTHS = {part: f"width_{part}" for part in (*PARTS, "outside")}
"""Where [cost] keeps half the width of an interval, in ln(FPS)."""
ROUNDED = 1e-3
"""How far [cost] rounds the ends of the fitted range: the largest fitted
network is not beyond it.
"""


def _outside(core: Sequence[Operation], dpu: Dpu) -> tuple[str, ...]:
    """Return a sentence for each property of a network that exceeds the range of the fitted
    networks.
    """
    operations = sum(op.operations for op in core)
    values = (
        ("map_bytes", "largest map", largest_map_bytes(core), 1e-6, "MB"),
        ("operations", "work", operations, 1e-9, "GOP"),
    )
    sentences = []
    for key, name, value, scale, unit in values:
        most = dpu.limit("cost", f"fitted_{key}").high
        # The ends of the fitted range are rounded in the file: the largest fitted network lies
        # inside.
        if value > most * (1 + ROUNDED):
            sentences.append(f"{name} {scale * value:.3g} {unit} (fitted up to {scale * most:.3g})")
    return tuple(sentences)


def dpu_power(dpu: Dpu) -> Figure:
    """Return the power in W while the DPU runs: the published range of the board.

    It does not depend on the network. The published points do not allow an energy per operation or
    per byte: above idle, the VCK190 needs 0.8 pJ for an operation of YOLOv8s, and 2.3 pJ for one of
    ConvBEERS.
    """
    if "dpu_range_w" not in dpu.tables.get("power", {}):
        return unavailable("W", f"no power of {dpu.target.name} under its DPU is published")
    power = dpu.limit("power", "dpu_range_w")
    ends = power.low, power.high
    source = f"not predictable from public data: the range of what is published: {power.source}"
    return predicted(between(ends), "W", ends, source)
