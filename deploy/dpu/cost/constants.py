"""The numbers of the cost model: what is fitted, which variant of the formula a board follows, regimes of its errors.

They stand in a target's [cost], where `docs/make/cost_model.py` writes what `fit` and `validation` find.
"""

from dataclasses import dataclass, fields
from itertools import product
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.board import Dpu

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Constants:
    """What is fitted. Hardware is never among it, so a board may be predicted with another's of the same kind.

    The first six are the DPU's. Rates of the host are those of one of its cores; a value is one number of a result.
    """

    array_efficiency: float
    """Share of the array's peak that a full layer reaches."""
    lane_efficiency: float
    """Pools, depthwise convolutions and adds, against the lanes that the file states."""
    port_bytes_per_cycle: float
    """What one batch handler moves in a cycle of the programmable logic."""
    memory_efficiency: float
    """Share of the memory's peak that all cores together reach."""
    layer_s: float
    """Start of a layer."""
    batch_s: float
    """Start of a batch."""
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
        """Those of a target profile."""
        return cls(*(dpu.value("cost", name) for name in NAMES))

    @classmethod
    def from_logs(cls, logs: Array) -> Self:
        """The inverse of `logs`."""
        return cls(*np.exp(logs).tolist())

    def rounded(self) -> Self:
        """Four significant digits: what a profile stores."""
        return type(self)(*(float(f"{getattr(self, name):.3e}") for name in NAMES))

    @property
    def logs(self) -> Array:
        """Natural logarithms, (13,): what the fit moves."""
        logs: Array = np.log(np.array([getattr(self, name) for name in NAMES]))
        return logs

    @property
    def host_s_per_unit(self) -> Array:
        """Time of an image, of a byte in, of a byte out and of a value of each task, (7,)."""
        values = np.array([getattr(self, name) for name in NAMES[DPU_CONSTANTS:]])
        return np.concatenate([values[:1], 1 / values[1:]])


DPU_CONSTANTS = 6
NAMES = tuple(field.name for field in fields(Constants))
UNITS = dict(
    zip(
        NAMES,
        ("1", "1", "B/cycle", "1", "s", "s", "s", "B/s", "B/s", *4 * ("1/s",)),
        strict=True,
    )
)


@dataclass(frozen=True)
class Structure:
    """Which of the formula's variants a board follows, chosen by cross-validation (`validation.nested`)."""

    serial: float
    """Share of the shorter of compute and memory that is not hidden behind the longer."""
    crowding: float
    """Exponent q of (dpu^q + host^q)^(1/q): 2 where the two get in each other's way, large where they do not."""
    bursts: float
    """1 where weights, which lie in one piece, cross the memory at its peak; 0 where no faster than maps."""

    @classmethod
    def of(cls, dpu: Dpu) -> Self:
        """That of a target profile."""
        return cls(*(dpu.value("cost", field.name) for field in fields(cls)))


STRUCTURES = tuple(Structure(*values) for values in product((0.5,), (2.0, 4.0), (0.0, 1.0)))
"""What the cross-validation chooses from; the rates do not tell how much is hidden, so `serial` is assumed."""


Regime = Literal["host", "small maps", "large maps"]
"""The host; or the DPU, on maps of at most LARGE_MAP_BYTES, or with larger ones."""
REGIMES: tuple[Regime, ...] = get_args(Regime)

LARGE_MAP_BYTES = 2 << 20


def regime_of(host_bound: bool, map_bytes: float) -> Regime:
    """The regime of a network, from its largest result."""
    if host_bound:
        return "host"
    return "large maps" if map_bytes > LARGE_MAP_BYTES else "small maps"
