"""How long each layer takes on the DPU: the formula, over arrays of layers.

compute = array operations / (peak array_efficiency) + lane steps / (lanes lane_efficiency)
memory  = longer of (weights + maps) / port and cores (weights + batch handlers maps) / (DDR memory_efficiency)
layer   = longer of the two + serial shorter of the two + layer_s
batch   = sum of layers + batch_s
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from deploy.dpu.board import Dpu
from deploy.dpu.cost.constants import Array, Constants, Structure
from deploy.dpu.cost.work import Work


@dataclass(frozen=True)
class Layers:
    """Layers as arrays (n,), each with the DPU that runs it; maps are those of one image."""

    array_s: Array  # at the array's peak
    lane_s: Array  # with every lane busy
    weight_bytes: Array
    map_bytes: Array
    launched: Array  # 1, or 0 for what is fused or only moves no data
    pl_clock_hz: Array
    memory_bytes_per_s: Array
    handlers: Array  # batch handlers of a core
    cores: Array

    @classmethod
    def of(cls, works: Sequence[Work], dpu: Dpu) -> Self:
        """The layers of one network."""
        columns = [
            (
                w.array_operations / dpu.engine_ops_per_s,
                w.lane_steps / dpu.lane_steps_per_s,
                w.weight_bytes,
                w.load_map_bytes + w.store_map_bytes,
                w.launched,
            )
            for w in works
        ]
        clock_hz, memory = dpu.value("array", "pl_clock_hz"), dpu.limit("memory", "ddr_bytes_per_s").high
        board = (clock_hz, memory, dpu.batch // dpu.cores, dpu.cores)
        return cls(*np.array([(*row, *board) for row in columns], dtype=np.float64).reshape(-1, 9).T)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Several networks one behind the other."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def compute_s(self, constants: Constants) -> Array:
        """Time of the array and of the engines beside it, (n,): all batch handlers work at once."""
        return self.array_s / constants.array_efficiency + self.lane_s / constants.lane_efficiency

    def memory_s(self, constants: Constants, structure: Structure, *, alone: bool = False) -> Array:
        """Time of the transfers, for a batch of every core or, `alone`, of one core (n,)."""
        port = constants.port_bytes_per_cycle * self.pl_clock_hz
        maps_rate = constants.memory_efficiency * self.memory_bytes_per_s
        weights_rate = self.memory_bytes_per_s if structure.bursts else maps_rate
        shared_s = self.weight_bytes / weights_rate + self.handlers * self.map_bytes / maps_rate
        return np.maximum((self.weight_bytes + self.map_bytes) / port, (1.0 if alone else self.cores) * shared_s)

    def time_s(self, constants: Constants, structure: Structure, *, alone: bool = False) -> Array:
        """Time of each layer, for a batch (n,)."""
        compute, memory = self.compute_s(constants), self.memory_s(constants, structure, alone=alone)
        busy: Array = np.maximum(compute, memory) + structure.serial * np.minimum(compute, memory)
        return busy + constants.layer_s * self.launched
