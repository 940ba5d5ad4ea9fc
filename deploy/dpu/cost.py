"""How long a network takes on the DPU: a first structural model, and how far off it has been.

    T_batch = ops / (P efficiency) + W / BW_w + B S / BW_d + t0        FPS = B / T_batch

ops     int8 operations of one image (a multiply-accumulate counts as two), P the peak of one batch handler
W       bytes of weights, loaded once a batch and shared by its B images
S       bytes of one image's convolution tensors too large for the feature-map banks: each is written to memory and
        read back; an add is fused with the convolution before it and reads its other operand
t0      start of a batch

The terms add up (no overlap), so that a batch is exactly the sum of its layers and t0. Pools, concats, activations
and resizes cost nothing in this model: it is too fast for networks made of many.

The constants were fitted on ten published networks (`profiles/targets/vck190.toml`), none of them ConvBEERS: the
paper's own figure is what the model is compared with, never what it is made from. Leaving each of the ten out once,
frames a second came out off by 29.4 % in the mean and by at most 137 % too fast. The interval is made of those two:

    slow end = FPS of full array groups / (1 + 1.37)        fast end = FPS / (1 - 0.294)

Full array groups: the array computes 16 input by 32 (C64: 64) output channels at a time, used or not. The fit knows
nothing of it; the slow end does. The interval is no confidence interval: it spans errors seen, for networks unlike
this one.
"""

import math
from dataclasses import dataclass

from deploy.dpu.board import Dpu
from deploy.dpu.finding import groups_of
from deploy.dpu.graph import Operation
from deploy.dpu.placement import Placement
from profiles.errors import ModelError


@dataclass(frozen=True)
class LayerCost:
    """What one operation costs for one batch. Bytes are those moved for one image, the columns of AMD's vaitrace."""

    name: str
    kind: str
    operations: int
    array_use: float  # used over computed channels, 0 to 1
    load_map_bytes: int
    load_weight_bytes: int
    store_map_bytes: int
    time_s: float


@dataclass(frozen=True)
class Prediction:
    """What the model says of one network on one configuration; `note` says what was assumed of the file."""

    configuration: str
    batch: int
    layers: tuple[LayerCost, ...]
    overhead_s: float
    fps_interval: tuple[float, float]
    note: str = ""

    @property
    def batch_time_s(self) -> float:
        """Time of one batch: the layers and the overhead, nothing else."""
        return math.fsum([*(layer.time_s for layer in self.layers), self.overhead_s])

    @property
    def fps(self) -> float:
        """Images a second, batches back to back."""
        return self.batch / self.batch_time_s

    @property
    def operations(self) -> int:
        """int8 operations for one image."""
        return sum(layer.operations for layer in self.layers)

    @property
    def streamed_bytes(self) -> int:
        """S: feature-map bytes that one image moves through memory."""
        return sum(layer.load_map_bytes + layer.store_map_bytes for layer in self.layers)


def predict(placement: Placement, dpu: Dpu) -> Prediction:
    """Predict a network that runs whole on the DPU.

    Raises:
        ModelError: a node that the DPU cannot run, or nothing for it to do.
    """
    if placement.failed:
        names = ", ".join(node.op.name for node in placement.failed[:3])
        remedy = "run 'beers-deploy check' for the reasons and remedies"
        raise ModelError("cost model", expected="a core that runs whole on the DPU", got=names, remedy=remedy)
    layers = tuple(_layer(op, dpu) for op in placement.core if op.kind != "activation")
    if not any(layer.operations for layer in layers):
        remedy = "give a network with convolutions"
        raise ModelError("cost model", expected="work for the DPU", got="no convolution", remedy=remedy)
    overhead_s = dpu.value("cost", "overhead_s")
    fps = dpu.batch / math.fsum([*(layer.time_s for layer in layers), overhead_s])
    interval = _interval(fps, layers, overhead_s, dpu)
    return Prediction(dpu.name, dpu.batch, layers, overhead_s, interval, placement.note)


def layer_time_s(operations: float, weight_bytes: int, streamed_bytes: int, dpu: Dpu) -> float:
    """The first three terms of T_batch; `operations` and `streamed_bytes` are those of one image."""
    compute_s = operations / (dpu.engine_ops_per_s * dpu.value("cost", "efficiency"))
    weights_s = weight_bytes / dpu.value("cost", "weight_bytes_per_s")
    return compute_s + weights_s + dpu.batch * streamed_bytes / dpu.value("cost", "data_bytes_per_s")


def _layer(op: Operation, dpu: Dpu) -> LayerCost:
    load, store = _traffic(op, dpu.value("cost", "kept_bytes"))
    time_s = layer_time_s(op.operations, op.weight_bytes, load + store, dpu)
    return LayerCost(op.name, op.kind, op.operations, _array_use(op, dpu), load, op.weight_bytes, store, time_s)


def _traffic(op: Operation, kept_bytes: float) -> tuple[int, int]:
    """Feature-map bytes (read, written) through memory for one image."""
    if op.kind == "add":
        other = op.out_bytes if len(op.inputs) > 1 else 0
        return (other if other > kept_bytes else 0), 0
    if not op.operations:
        return 0, 0
    return (op.in_bytes if op.in_bytes > kept_bytes else 0), (op.out_bytes if op.out_bytes > kept_bytes else 0)


def _array_use(op: Operation, dpu: Dpu) -> float:
    """Channels used over channels computed; 1 for what does not run on the array."""
    if op.kind not in ("conv", "transposed"):
        return 1.0
    sizes = (dpu.whole("array", "input_channel_parallel"), dpu.output_parallel)
    computed = [groups_of(count, size) * size for count, size in zip(op.channels, sizes, strict=True)]
    return op.channels[0] * op.channels[1] / (computed[0] * computed[1])


def _interval(fps: float, layers: tuple[LayerCost, ...], overhead_s: float, dpu: Dpu) -> tuple[float, float]:
    slow = [
        layer_time_s(
            layer.operations / layer.array_use,
            layer.load_weight_bytes,
            layer.load_map_bytes + layer.store_map_bytes,
            dpu,
        )
        for layer in layers
    ]
    low = dpu.batch / math.fsum([*slow, overhead_s]) / (1 + dpu.value("cost", "error_worst_fast"))
    return low, fps / (1 - dpu.value("cost", "error_mean"))
