"""Time of layers on the DPU from their work: six constants that are fitted, three that are not.

    compute = array operations / (P efficiency) + lane steps / R
    memory  = weights / BW + batch maps / map_bytes_per_s
    layer   = longer of the two + serial shorter of the two + layer_s
    batch   = sum of layers + batch_s
    host    = bytes in / host_in_bytes_per_s + bytes out / host_out_bytes_per_s
    FPS     = 1 / max(batch time / batch, host)

P, R and BW are the peaks of the array, of the engines in programmable logic and of the memory: from the target's
description, not fitted. `serial` is the share of the shorter of compute and memory that does not hide behind the
longer. The published rates cannot tell it (the fit is as good from 0.25 to 1), so it is assumed, and the interval of
a network outside the fitted range spans all of it. One image's weights serve the whole batch; each batch handler has
its own array and its own maps, and all share the memory.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.board import Dpu
from deploy.dpu.work import Work

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
