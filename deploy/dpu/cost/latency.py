"""Predict the time of a network on the DPU layer by layer, with its interval, and the power.

Counts come from `work` and `host`, the formula from `model`, constants and widths from the target's
[cost]. There `benchmarks/cost_model` writes the constants that it fits to published networks. None
of them is ConvBEERS: the model is compared with the paper's figure, and never fitted to it.

The interval is FPS e^-width to FPS e^width. Nine of ten families of networks, each left out of the
fit once, lie inside. Each part of an image's time has a width of its own, and the rate has their
mean, weighted by the influence of each part. Beyond all fitted networks the interval is no narrower
than `width_outside` (docs/explanation/cost-model.md).
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
    FloatWork,
    Task,
    consistency_interval_s,
    float_interval_s,
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
    """The predicted time of one operation on the DPU, for a batch.

    Attributes:
        work: the work of the operation for one image.
        compute_s: the time that the DPU's engines compute, in s.
        memory_s: the time of the transfers to and from memory, in s.
        time_s: the time of the operation in s. It is shorter than the sum of both, as far as they
            overlap, and includes the start of the operation.
    """

    work: Work
    compute_s: float
    memory_s: float
    time_s: float

    @property
    def bound(self) -> str:
        """The longest part of the time: "compute", "memory", or "overhead" for the rest."""
        overhead_s = self.time_s - self.compute_s - self.memory_s
        parts = {"compute": self.compute_s, "memory": self.memory_s, "overhead": overhead_s}
        return max(parts, key=lambda name: parts[name])


@dataclass(frozen=True)
class Prediction:
    """The prediction of the cost model for one network on one DPU configuration.

    A batch is the images that the DPU computes at once. The host is the processor of the board,
    which prepares images and reads results while the DPU computes.

    Attributes:
        dpu: the configuration.
        alone_s: time in s of one core's batch on the DPU while the other cores rest.
        layers: the cost of each operation on the DPU, for a batch.
        host_s: time in s of an image on all cores of the host together.
        task: the host's task with the results.
        width: half the width of the interval of the rate, in ln(frames per second).
        bound: the part that limits the rate, the DPU or the host.
        levels: keys that runs of the user's board may share with the network (`kinship`).
        speed: the factor by which these runs show the board to be faster than the fitted constants
            say; 1 without runs. All times here are divided by it.
        outside: a sentence for each property beyond the networks that the constants were fitted to;
            empty if there are none.
        note: the assumption about a float file; empty for a quantised one.
        refused: the names of the nodes that the DPU refuses and the host runs.
        refused_s: shortest and longest time in s of these nodes for an image, and of enlarging or
            activating it in float; a part of `host_s`.
        step_s: shortest and longest time in s of the consistency step for an image, a part of
            `host_s`. The step makes block means of the result agree with the raw image.
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
        """The number of images that are processed at once."""
        return self.dpu.batch

    @cached_property
    def batch_time_s(self) -> float:
        """The time in s of one batch on the DPU, without the host, if all cores work."""
        return math.fsum(layer.time_s for layer in self.layers)

    @property
    def fps(self) -> float:
        """The predicted rate in frames per second.

        Batches follow each other without a pause, and the host works in parallel to the DPU.
        """
        return self._rate(self.host_s)

    @property
    def fps_interval(self) -> Interval:
        """The lowest and the highest rate in frames per second.

        The lowest assumes the longest time of the host, the highest the shortest. The lowest is
        then divided by `spread`, and the highest multiplied by it.
        """
        # The host at its fastest comes first.
        fast, slow = map(self._rate, self._host_ends_s)
        return self._widened(slow, fast)

    @property
    def host_interval_s(self) -> Interval:
        """The interval of `host_s` in s, for one image."""
        return self._widened(*self._host_ends_s)

    @property
    def latency_s(self) -> float:
        """The time in s from the first image of a batch to its last result, with one thread.

        The thread uses one core of the DPU, then one core of the host. The relative error is about
        that of the rate (docs/reference/boards.md), so the interval has the width of the rate's.
        """
        return self._latency_s(self.host_s)

    @property
    def latency_interval_s(self) -> Interval:
        """The interval of `latency_s` in s."""
        return self._widened(*map(self._latency_s, self._host_ends_s))

    def _widened(self, low: float, high: float) -> Interval:
        return low / self.spread, high * self.spread

    def _latency_s(self, host_s: float) -> float:
        # `host_s` is the time of all cores together: one thread does the work on one of them.
        return self.alone_s + self.dpu.handlers * host_s * self.dpu.whole("cpu", "cores")

    @property
    def spread(self) -> float:
        """e^width, the factor by which the rate and each time may be wrong either way."""
        return math.exp(self.width)

    @property
    def _host_ends_s(self) -> Interval:
        """The host's time with the shortest and with the longest time of the refused nodes
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
        """The number of int8 operations of all layers on the DPU, for one image."""
        return sum(layer.work.operations for layer in self.layers)

    @property
    def streamed_bytes(self) -> int:
        """The bytes of feature maps that layers load from memory and store to it, for one
        image; weights are not counted.
        """
        return sum(layer.work.map_bytes for layer in self.layers)


NO_FLOATS = FloatWork()


def predict(
    placement: Placement,
    dpu: Dpu,
    task: Task | None = None,
    step_px: float = 0.0,
    float_work: FloatWork = NO_FLOATS,
) -> Prediction:
    """Predict the rate and latency of a network on a DPU by the cost model (see `model`).

    The DPU must run all convolutions. Nodes that it refuses before the first convolution or after
    the last one run on the host.

    Args:
        placement: where each node of the network runs.
        dpu: the configuration of a board, with the runs of the user's own board if there are any.
        task: the host's task with the results; None derives it from the network's operators.
        step_px: number of pixels of an image for which the host computes the consistency step,
            which makes block means of the result agree with the raw image; 0 for no step.
        float_work: the work of the host in float on the results of an INT8 network.

    Raises:
        ModelError: the DPU refuses a node inside the core, or the network has no convolution.
    """
    if cutting := placement.cutting:
        names = ", ".join(node.op.name for node in cutting[:3])
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
    times_s = parts_s.sum(axis=1)
    refused = [node.op for node in placement.failed]
    task = task or task_of(placement)
    by_nodes_s = refused_interval_s(refused, dpu)
    in_float_s = float_interval_s(placement, task, float_work, dpu)
    refused_s = (by_nodes_s[0] + in_float_s[0], by_nodes_s[1] + in_float_s[1])
    step_s = consistency_interval_s(step_px, dpu)
    host_parts = host_parts_s(placed_work(placement, task)[None], constants)
    host_parts /= dpu.whole("cpu", "cores")
    # Work that no rate is published for is taken at the geometric mean of its two ends.
    host_parts[0, 0] += between(refused_s) + between(step_s)
    host_s = float(host_parts.sum())
    dpu_parts = parts_s.sum(axis=0)[None] / dpu.batch
    (shares,) = shares_of(dpu_parts, host_parts, structure.contention_exponent)
    width = float(shares @ [dpu.value("cost", WIDTHS[part]) for part in PARTS])
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
"""The key in [cost] of half the width of an interval, in ln(FPS), by the part of the time."""
ROUNDED = 1e-3
"""Relative rounding of the fitted range in [cost], so that the largest fitted network is inside."""


def _outside(core: Sequence[Operation], dpu: Dpu) -> tuple[str, ...]:
    """Return a sentence for each property of a network that exceeds the range of the fitted
    networks.
    """
    operations = sum(op.operations for op in core)
    values = (
        ("fitted_map_bytes", "largest map", largest_map_bytes(core), 1e-6, "MB"),
        ("fitted_operations", "work", operations, 1e-9, "GOP"),
    )
    sentences = []
    for key, name, value, scale, unit in values:
        most = dpu.limit("cost", key).high
        if value > most * (1 + ROUNDED):
            sentences.append(f"{name} {scale * value:.3g} {unit} (fitted up to {scale * most:.3g})")
    return tuple(sentences)


def dpu_power(dpu: Dpu) -> Figure:
    """Return the power of a board in W while its DPU runs, for the energy per image.

    The power does not depend on the network. The published points do not allow an energy per
    operation or per byte: above idle, the VCK190 needs 0.8 pJ for an operation of YOLOv8s, and 2.3
    pJ for one of ConvBEERS.

    Args:
        dpu: a configuration of the board.

    Returns:
        The geometric mean of the published range, with the range as its interval; unavailable if
        none is published.
    """
    if "dpu_range_w" not in dpu.tables.get("power", {}):
        return unavailable("W", f"no power of {dpu.target.name} under its DPU is published")
    power = dpu.limit("power", "dpu_range_w")
    ends = power.low, power.high
    source = f"not predictable from public data: the range of what is published: {power.source}"
    return predicted(between(ends), "W", ends, source)
