"""The formula of the cost model, and its constants, which stand in a target's [cost].

compute = array operations / (peak array_efficiency) + lane steps / lanes
memory  = longer of (weights + maps) / port and
          cores (weights + batch handlers maps) / (DDR memory_efficiency)
layer   = longer of the two + (1 - overlap) shorter of the two + layer_s
batch   = sum of layers
host    = host_image_s + bytes in / rate + bytes out / rate + values of the task / its rate
rate    = 1 / (dpu^q + host^q)^(1 / q), with q = contention_exponent

The operand of an add or mul that does not fit on the chip is read serially: its memory takes
SERIAL_PORT and SERIAL_DDR times as long.
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
    """The constants of the cost model that are fitted to published frame rates.

    Constants of the hardware are not fitted, so that a board can be predicted with the constants of
    another board of the same kind.

    The first four describe the DPU, the others the board's processor, which prepares the image and
    reads the results. Times and rates of the processor are those of one of its cores. A value is
    one number of a result.
    """

    array_efficiency: float
    """Share of the array's peak that a full layer reaches, at most 1."""
    port_bytes_per_cycle: float
    """Bytes that one batch handler transfers in a cycle of the programmable logic."""
    memory_efficiency: float
    """Share of the memory's peak that all cores together reach, at most 1."""
    layer_s: float
    """Time that the start of a layer takes, in s."""
    host_image_s: float
    """Time that the processor spends on any image, in s."""
    host_in_bytes_per_s: float
    """Rate at which the image is scaled and sent to the DPU."""
    host_out_bytes_per_s: float
    """Rate at which the results are copied from the DPU."""
    argmax_values_per_s: float
    """Rate at which the best of several classes is searched."""
    softmax_values_per_s: float
    """Rate at which scores of classes are converted to probabilities."""
    sort_values_per_s: float
    """Rate at which boxes or key points are ranked."""
    image_values_per_s: float
    """Rate at which results are converted to pixels."""

    @classmethod
    def of(cls, dpu: Dpu) -> Self:
        """Read the constants that a board's profile states in its table [cost].

        Raises:
            ProfileError: the profile lacks one, because the board has no cost model.
        """
        return cls(*(dpu.value("cost", name) for name in NAMES))

    @property
    def host_s_per_unit(self) -> Array:
        """The time in s that each unit of `host.host_work` takes on one core, shape (7,).

        The units are an image, a byte to the DPU, a byte from it, and a value of each of four
        tasks.
        """
        host_names = NAMES[NAMES.index("host_image_s") :]
        image_s, *rates = (getattr(self, name) for name in host_names)
        return np.array([image_s, *(1 / rate for rate in rates)])


NAMES = tuple(field.name for field in fields(Constants))


@dataclass(frozen=True)
class Structure:
    """The parameters of this module's formula that depend on the kind of board.

    In contrast to `Constants`, they are not fitted.
    """

    overlap: float
    """Share of the shorter of compute and memory that is hidden behind the longer."""
    contention_exponent: float
    """Exponent q of the time (dpu^q + host^q)^(1/q) of an image: about 2 on boards where DPU and
    processor slow each other down, large on others.
    """

    @classmethod
    def of(cls, dpu: Dpu) -> Self:
        """Read the parameters that a board's profile states in [cost]."""
        return cls(*(dpu.value("cost", field.name) for field in fields(cls)))


@dataclass(frozen=True)
class Layers:
    """The n layers of one or several networks as arrays (n,), with the hardware that runs each.

    A map is a tensor between two layers.

    Attributes:
        array_s: time of the convolution array for one image at its peak, in s.
        lane_s: time of the element-wise engine for one image at its peak, in s.
        weight_bytes: bytes of the weights.
        map_bytes: bytes of maps that are loaded and stored for one image.
        launched: 1 for a layer with a start of its own, 0 for one that runs with the layer before.
        pl_clock_hz: clock of the programmable logic.
        memory_bytes_per_s: peak rate of the board's memory.
        handlers: number of batch handlers (images at once) of a core.
        cores: number of cores of the DPU.
        serial: 1 if the layer loads its maps only after the layer before, so that nothing hides the
            transfer; 0 otherwise.
    """

    array_s: Array
    lane_s: Array
    weight_bytes: Array
    map_bytes: Array
    launched: Array
    pl_clock_hz: Array
    memory_bytes_per_s: Array
    handlers: Array
    cores: Array
    serial: Array

    @classmethod
    def of(cls, works: Sequence[Work], dpu: Dpu) -> Self:
        """Collect the layers of one network, all of which run on `dpu`."""
        array = dpu.engine_ops_per_s
        clock_hz = dpu.value("array", "pl_clock_hz")
        # The element-wise engine in programmable logic computes additions, pools and depthwise
        # convolutions.
        channels = dpu.value("elementwise", "channels_per_cycle")
        lanes = channels * dpu.value("elementwise", "pixels_per_cycle") * clock_hz
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
        # The shape also keeps the fields of a network without layers.
        return cls(*np.array(rows, dtype=np.float64).reshape(-1, len(fields(cls))).T)

    def compute_s(self, constants: Constants) -> Array:
        """Return the time in s that each layer computes for a batch, shape (n,).

        The batch handlers compute their images at once, so it is the time of one image.
        """
        return self.array_s / constants.array_efficiency + self.lane_s

    def memory_s(self, constants: Constants, *, alone: bool = False) -> Array:
        """Return the time in s of each layer's transfers to and from memory, shape (n,).

        Args:
            constants: the fitted constants.
            alone: False if every core computes a batch, so that they share the memory; True if only
                one core does.
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
        """Return the time in s of each layer for a batch, shape (n,).

        Args:
            constants: the fitted constants.
            structure: the parameters that depend on the kind of the board.
            alone: True if only one core computes a batch, and the others rest.
        """
        times: Array = self.parts_s(constants, structure, alone=alone).sum(axis=1)
        return times

    def parts_s(self, constants: Constants, structure: Structure, *, alone: bool = False) -> Array:
        """Split the time in s of each layer for a batch into the first four of PARTS, shape (n, 4).

        Args:
            constants: the fitted constants.
            structure: the parameters that depend on the kind of the board.
            alone: True if only one core computes a batch, and the others rest.
        """
        compute = self.compute_s(constants)
        memory = self.memory_s(constants, alone=alone)
        # The part of the shorter time that the longer one hides counts for neither.
        exposed = 1 - structure.overlap
        compute_s = np.where(compute >= memory, compute, exposed * compute)
        memory_s = np.where(compute >= memory, exposed * memory, memory)
        on_array = self.array_s > 0
        start_s = constants.layer_s * self.launched
        return np.stack([compute_s * on_array, compute_s * ~on_array, memory_s, start_s], axis=1)


SERIAL_PORT = 2
SERIAL_DDR = 3
"""Factors of the time of a serial read through the port and from the DDR. They give 3.6 GB/s on a
ZCU104, where AMD's profile of its layers has 3.2 to 3.7.
"""

PARTS = ("array", "lanes", "memory", "start", "copies", "task")
"""The parts of the time of an image: on the DPU the convolution array, the element-wise engine,
transfers and starts of layers; on the host the copies and its task. Each part has an uncertainty of
its own.
"""


def shares_of(dpu_s: Array, host_s: Array, contention_exponent: float) -> Array:
    """Return the sensitivity of the frame rate to each part of the time, (n, 6).

    The rate falls by about s % if a part with the sensitivity s takes 1 % longer. The parts are
    those of PARTS: four of the DPU, then two of the host. The sensitivities of an image add up to
    1.

    Args:
        dpu_s: time of an image on the DPU in each of the first four parts, (n, 4) for n networks.
        host_s: time of an image on all cores of the host in each of the last two, (n, 2).
        contention_exponent: exponent of `frame_rate`.
    """
    dpu, host = (times.sum(axis=1, keepdims=True) for times in (dpu_s, host_s))
    q = contention_exponent
    follows_host = host**q / (host**q + dpu**q)
    # Published rates of the DPU alone include no time of the host.
    host_shares = np.divide(host_s, host, out=np.zeros_like(host_s), where=host > 0)
    parts = [(1 - follows_host) * dpu_s / dpu, follows_host * host_shares]
    return np.concatenate(parts, axis=1)


def frame_rate(dpu_s: float, host_s: float, contention_exponent: float) -> float:
    """Compute the images per second of a DPU and a host that work in parallel.

    It is 1 / (dpu^q + host^q)^(1 / q).

    Args:
        dpu_s: time of the DPU for one image, in s.
        host_s: time of all cores of the host for one image, in s.
        contention_exponent: q; the larger, the less the two slow each other down.
    """
    longer = max(dpu_s, host_s)
    shorter = min(dpu_s, host_s)
    q = contention_exponent
    # (dpu^q + host^q)^(1/q), divided by the longer time so that no power overflows.
    return float(1 / (longer * (1 + (shorter / longer) ** q) ** (1 / q)))


def between(interval: Interval) -> float:
    """Return the geometric mean of the two ends of an interval."""
    return math.sqrt(interval[0] * interval[1])
