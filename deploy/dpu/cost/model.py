"""The formula of the cost model, and its constants, which stand in a target's [cost].

compute = array operations / (peak array_efficiency) + lane steps / lanes
memory  = longer of (weights + maps) / port and
          cores (weights + batch handlers maps) / (DDR memory_efficiency)
layer   = longer of the two + (1 - overlap) shorter of the two + layer_s
batch   = sum of layers
host    = host_image_s + bytes in / rate + bytes out / rate + values of the task / its rate
rate    = 1 / (dpu^q + host^q)^(1 / q), with q = contention_exponent
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.cost.work import Work

Array = NDArray[np.float64]
Interval = tuple[float, float]


@dataclass(frozen=True)
class Constants:
    """The constants that are fitted to published rates.

    Constants of the hardware are not fitted, so that a board can be predicted with the constants of
    another board of the same kind.

    The first four describe the DPU. Rates of the host are rates of one of its cores; a value is one
    number of a result.
    """

    array_efficiency: float
    """Share of the array's peak that a full layer reaches, at most 1."""
    port_bytes_per_cycle: float
    """What one batch handler moves in a cycle of the programmable logic."""
    memory_efficiency: float
    """Share of the memory's peak that all cores together reach."""
    layer_s: float
    """Start of a layer."""
    host_image_s: float
    """What the host does for any image."""
    host_in_bytes_per_s: float
    """Scaling the image and handing it over."""
    host_out_bytes_per_s: float
    """Taking the results back."""
    argmax_values_per_s: float
    softmax_values_per_s: float
    sort_values_per_s: float
    image_values_per_s: float

    @classmethod
    def of(cls, dpu: Dpu) -> Self:
        """Read the constants that a target profile states in [cost]."""
        return cls(*(dpu.value("cost", name) for name in NAMES))

    @property
    def host_s_per_unit(self) -> Array:
        """Return the time of an image, of a byte in, of a byte out and of a value of each task,
        (7,).
        """
        host_names = NAMES[NAMES.index("host_image_s") :]
        image_s, *rates = (getattr(self, name) for name in host_names)
        return np.array([image_s, *(1 / rate for rate in rates)])


NAMES = tuple(field.name for field in fields(Constants))


@dataclass(frozen=True)
class Structure:
    """The parameters of the formula that depend on the kind of the board and are not fitted."""

    overlap: float
    """Share of the shorter of compute and memory that is hidden behind the longer."""
    contention_exponent: float
    """Exponent q of (dpu^q + host^q)^(1/q): 2 where the two get in each other's way, large where
    they do not.
    """

    @classmethod
    def of(cls, dpu: Dpu) -> Self:
        """Read the constants of a target profile."""
        return cls(*(dpu.value("cost", field.name) for field in fields(cls)))


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
    serial: Array  # 1, or 0 where the transfers queue up

    @classmethod
    def of(cls, works: Sequence[Work], dpu: Dpu) -> Self:
        """Collect the layers of one network."""
        array = dpu.engine_ops_per_s
        lanes = dpu.lane_steps_per_s
        clock_hz = dpu.value("array", "pl_clock_hz")
        memory = dpu.limit("memory", "ddr_bytes_per_s").high
        board = (clock_hz, memory, dpu.handlers, dpu.cores)
        rows = [
            (
                work.array_operations / array,
                work.lane_steps / lanes,
                work.weight_bytes,
                work.map_bytes,
                work.launched,
                *board,
                work.serial,
            )
            for work in works
        ]
        # The ten fields, also of a network without layers: an empty list alone has one axis.
        return cls(*np.array(rows, dtype=np.float64).reshape(-1, 10).T)

    def compute_s(self, constants: Constants) -> Array:
        """Return the time of the array and of the engines next to it, (n,). All batch handlers work
        at once.
        """
        return self.array_s / constants.array_efficiency + self.lane_s

    def memory_s(self, constants: Constants, *, alone: bool = False) -> Array:
        """Return the time of the transfers for a batch of every core or, if `alone`, of one core,
        (n,).
        """
        port = constants.port_bytes_per_cycle * self.pl_clock_hz
        shared = constants.memory_efficiency * self.memory_bytes_per_s
        shared_s = (self.weight_bytes + self.handlers * self.map_bytes) / shared
        port_s = (self.weight_bytes + self.map_bytes) / port
        port_s *= 1 + (SERIAL_PORT - 1) * self.serial
        shared_s *= 1 + (SERIAL_DDR - 1) * self.serial
        # Cores share the DDR alone: each loads its own weights through ports of its own.
        return np.maximum(port_s, (1.0 if alone else self.cores) * shared_s)

    def time_s(self, constants: Constants, structure: Structure, *, alone: bool = False) -> Array:
        """Return the time of each layer for a batch, (n,)."""
        times: Array = self.parts_s(constants, structure, alone=alone).sum(axis=1)
        return times

    def parts_s(self, constants: Constants, structure: Structure, *, alone: bool = False) -> Array:
        """Return the time of each layer for a batch by the first four of PARTS, (n, 4)."""
        compute = self.compute_s(constants)
        memory = self.memory_s(constants, alone=alone)
        # What the longer of the two hides of the shorter counts for neither.
        exposed = 1 - structure.overlap
        compute_s = np.where(compute >= memory, compute, exposed * compute)
        memory_s = np.where(compute >= memory, exposed * memory, memory)
        on_array = self.array_s > 0
        start_s = constants.layer_s * self.launched
        return np.stack([compute_s * on_array, compute_s * ~on_array, memory_s, start_s], axis=1)


SERIAL_PORT = 2
SERIAL_DDR = 3
"""How many times as long a serial read takes through the port and from the DDR: 3.6 GB/s on a
ZCU104, where AMD's profile of its layers has 3.2 to 3.7.
"""

PARTS = ("array", "lanes", "memory", "start", "copies", "task")
"""What the time of an image consists of: the array, the engines beside it, transfers and starts on
the DPU, then the host's copies and its task. The prediction of each is off by a width of its own.
"""


def shares_of(dpu_s: Array, host_s: Array, contention_exponent: float) -> Array:
    """Return the sensitivity of the frame rate to each part of the time, (n, 6).

    The rate falls by about s % if a part with the sensitivity s takes 1 % longer. The parts are
    those of PARTS: four of the DPU, then two of the host. The sensitivities of an image add up to
    1.

    Args:
        dpu_s: time of an image by the first four parts, (n, 4).
        host_s: time by the last two, on all cores, (n, 2).
        contention_exponent: exponent of `frame_rate`.
    """
    dpu, host = (times.sum(axis=1, keepdims=True) for times in (dpu_s, host_s))
    follows_host = host**contention_exponent / (
        host**contention_exponent + dpu**contention_exponent
    )
    # Where the rates are those of the DPU alone the host takes no time.
    host_shares = np.divide(host_s, host, out=np.zeros_like(host_s), where=host > 0)
    parts = [(1 - follows_host) * dpu_s / dpu, follows_host * host_shares]
    return np.concatenate(parts, axis=1)


def frame_rate(dpu_s: float, host_s: float, contention_exponent: float) -> float:
    """Return the images per second.

    Args:
        dpu_s: time of the DPU for one image.
        host_s: time of the host's cores for one image.
        contention_exponent: q of the formula above.
    """
    longer = max(dpu_s, host_s)
    shorter = min(dpu_s, host_s)
    # (dpu^q + host^q)^(1/q) with the longer time factored out: no power leaves the floats' range.
    return float(
        1 / (longer * (1 + (shorter / longer) ** contention_exponent) ** (1 / contention_exponent))
    )


def between(interval: Interval) -> float:
    """Return the geometric mean of the ends of an interval."""
    return math.sqrt(interval[0] * interval[1])
