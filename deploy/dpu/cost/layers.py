"""What one image asks of the DPU's parts, layer by layer, and how long each layer takes.

Work is counted from shapes alone; time follows from it by six constants that are fitted and three that are not.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.board import Dpu
from deploy.dpu.checker.finding import groups_of
from deploy.dpu.graph import Operation, Shape

FUSED = ("activation", "quantise", "dequantise")
"""Kinds that cost nothing: done on the way out of the operation before."""


@dataclass(frozen=True)
class Work:
    """One operation: what it counts for one image; its weights are loaded once a batch."""

    name: str
    kind: str
    operations: int
    array_operations: int  # computed by the array, used or not
    lane_steps: int  # values that the ALU or the element-wise engine takes in, unused lanes included
    weight_bytes: int
    load_map_bytes: int
    store_map_bytes: int

    @property
    def array_use(self) -> float:
        """Operations used over computed, 0 to 1; 1 for what does not run on the array."""
        return self.operations / self.array_operations if self.array_operations else 1.0


def count_work(operations: Sequence[Operation], dpu: Dpu) -> tuple[Work, ...]:
    """The work of operations that run one behind the other on the DPU."""
    flow = _Flow(operations, dpu)
    return tuple(_count(op, flow, dpu) for op in operations if op.kind not in FUSED)


def _count(op: Operation, flow: "_Flow", dpu: Dpu) -> Work:
    array, lanes = _array_operations(op, dpu), _lane_steps(op, dpu)
    return Work(op.name, op.kind, op.operations, array, lanes, op.weight_bytes, flow.load(op), flow.store(op))


def _array_operations(op: Operation, dpu: Dpu) -> int:
    if op.kind not in ("conv", "transposed"):
        return 0
    lanes, (inputs, outputs), (rows, columns) = dpu.input_parallel, op.channels, op.window.kernel
    gathered = rows * _up(columns * inputs, lanes) if inputs < lanes else rows * columns * _up(inputs, lanes)
    if op.kind == "conv":
        return 2 * gathered * _up(outputs, dpu.output_parallel) * _positions(op.out_shape, dpu)
    strides = op.window.stride[0] * op.window.stride[1]  # a transposed one: each output pixel meets 1 / strides of it
    return 2 * gathered * _up(outputs, dpu.output_parallel) * _positions(op.out_shape, dpu) // strides


def _lane_steps(op: Operation, dpu: Dpu) -> int:
    if op.kind not in ("depthwise", "pool", "add", "mul") or not op.in_shapes or op.in_shapes[0] is None:
        return 0
    passes = max(op.channels[1] // max(op.channels[0], 1), 1) if op.kind == "depthwise" else 1
    window = op.window.kernel[0] * op.window.kernel[1]
    return passes * window * _up(op.in_shapes[0][0], dpu.input_parallel) * _positions(op.out_shape, dpu)


def _positions(shape: Shape | None, dpu: Dpu) -> int:
    """Output pixels, rows filled up to the pixels computed at a time."""
    return shape[1] * _up(shape[2], dpu.whole("array", "pixel_parallel")) if shape else 0


def _up(count: int, size: int) -> int:
    return groups_of(count, size) * size


class _Flow:
    """Which results pass through memory."""

    def __init__(self, operations: Sequence[Operation], dpu: Dpu) -> None:
        self._kept_bytes, self._lanes = dpu.value("memory", "feature_map_bytes"), dpu.input_parallel
        self._same: dict[str, str] = {}
        for op in operations:
            if op.kind in FUSED:
                self._same |= dict.fromkeys(op.outputs, self._root(op.inputs[0]))
        computing = [op for op in operations if op.kind not in FUSED]
        self._order = {name: when for when, op in enumerate(computing) for name in op.outputs}
        self._readers = Counter(self._root(name) for op in computing for name in op.inputs)
        self._joined = {self._root(name) for op in computing if op.kind == "concat" for name in op.inputs}
        self._sums = {self._root(self._fused(op)): op.output for op in computing if op.kind == "add"}

    def load(self, op: Operation) -> int:
        """Bytes read: all operands but the one that an add is fused with."""
        if op.kind == "concat":
            return 0
        fused = self._fused(op) if op.kind == "add" else None
        fed = zip(op.inputs, op.in_shapes, strict=True)
        return sum(_size(shape) for name, shape in fed if name != fused and self._leaves(name, shape))

    def store(self, op: Operation) -> int:
        """Bytes written; an add's are those of the operation that it is fused with."""
        if op.kind in ("add", "concat"):
            return 0
        name = self._root(op.output)
        while name in self._sums and self._readers[name] == 1:
            name = self._sums[name]
        last = not self._readers[name]
        return _size(op.out_shape) if last or name in self._joined or self._leaves(name, op.out_shape) else 0

    def _fused(self, add: Operation) -> str:
        """The operand of an add that is made last."""
        return max(add.inputs, key=lambda name: self._order.get(self._root(name), -1))

    def _leaves(self, name: str, shape: Shape | None) -> bool:
        root = self._root(name)
        held = _up(shape[0], self._lanes) * shape[1] * shape[2] if shape else 0
        return root not in self._order or held > self._kept_bytes or self._readers[root] > 2

    def _root(self, name: str) -> str:
        return self._same.get(name, name)


def _size(shape: Shape | None) -> int:
    return shape[0] * shape[1] * shape[2] if shape else 0


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Constants:
    """What is fitted: see the module. Rates in bytes a second, times in seconds."""

    efficiency: float
    map_bytes_per_s: float
    batch_s: float
    layer_s: float
    host_in_bytes_per_s: float
    host_out_bytes_per_s: float

    @classmethod
    def of(cls, dpu: Dpu) -> Self:
        """Those of a target profile."""
        return cls(*(dpu.value("cost", field.name) for field in fields(cls)))

    @classmethod
    def from_logs(cls, logs: Array) -> Self:
        """The inverse of `logs`."""
        return cls(*np.exp(logs).tolist())

    def rounded(self) -> Self:
        """Four significant digits: what a profile stores."""
        return type(self)(*(float(f"{value:.3e}") for value in astuple(self)))

    @property
    def logs(self) -> Array:
        """Natural logarithms, (6,): what the fit moves."""
        logs: Array = np.log(np.array(astuple(self)))
        return logs


@dataclass(frozen=True)
class Layers:
    """Layers as arrays (n,), each with the DPU that runs it; maps are those of one image."""

    array_operations: Array
    lane_steps: Array
    weight_bytes: Array
    map_bytes: Array
    launched: Array  # 1, or 0 for what is fused or only moves no data
    peak_ops_per_s: Array
    lane_steps_per_s: Array
    memory_bytes_per_s: Array
    batch: Array

    @classmethod
    def of(cls, works: Sequence[Work], dpu: Dpu) -> Self:
        """The layers of one network."""
        columns = [
            (w.array_operations, w.lane_steps, w.weight_bytes, w.load_map_bytes + w.store_map_bytes, is_launched(w))
            for w in works
        ]
        board = (dpu.engine_ops_per_s, dpu.lane_steps_per_s, dpu.value("memory", "ddr_bytes_per_s"), dpu.batch)
        return cls(*np.array([(*row, *board) for row in columns], dtype=np.float64).reshape(-1, 9).T)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Several networks one behind the other."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def compute_s(self, constants: Constants) -> Array:
        """Time of the array and of the engines beside it, for a batch (n,)."""
        array_s = self.array_operations / (self.peak_ops_per_s * constants.efficiency)
        return array_s + self.lane_steps / self.lane_steps_per_s

    def memory_s(self, constants: Constants) -> Array:
        """Time of the transfers, for a batch (n,)."""
        return self.weight_bytes / self.memory_bytes_per_s + self.batch * self.map_bytes / constants.map_bytes_per_s

    def time_s(self, constants: Constants, serial: float) -> Array:
        """Time of each layer, for a batch (n,)."""
        compute, memory = self.compute_s(constants), self.memory_s(constants)
        busy: Array = np.maximum(compute, memory) + serial * np.minimum(compute, memory)
        return busy + constants.layer_s * self.launched


def is_launched(work: Work) -> bool:
    """Whether a layer has a start of its own: adds are fused, concats only name places."""
    return work.kind not in ("add", "concat")


def host_s(bytes_in: Array, bytes_out: Array, constants: Constants) -> Array:
    """Time of the host for one image, beside the DPU; bytes of one image (n,)."""
    return bytes_in / constants.host_in_bytes_per_s + bytes_out / constants.host_out_bytes_per_s
