"""Cheap guards against bits that are turned over: ReLU6, a limit of the correction, checksums, three copies.

    ReLU6        bounds a ReLU's result at 6 2^p = 96 / 2^k units; it is fused into the convolution (UG1414 3.5), and
                 any k can be had, for a power of two moves from one convolution's position to the next one's
    limit        bounds the correction on the host, where it is added to the image
    checksum     CRC-32 of each convolution's weights and bias; what differs is loaded again
    three copies of each shift, of which two must agree on a bit

Bounds are learnt: the next one above what calibration patches reach.
"""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from quant.core import IntConv, IntCore
from quant.integer import Faults, merged_correction, run_core
from quant.planes import MAX_DN
from quant.upsets import Shifts, with_ops

RELU6_UNITS = 96
"""6 at position 4; 192 would be above int8."""


@dataclass(frozen=True)
class Guards:
    """What a healthy network never exceeds, and what its weights sum to.

    Attributes:
        relu6: bound in units of each ReLU that has one, by its tensor.
        limit_dn: bound of the correction's size.
        checksums: of each convolution, by name.
    """

    relu6: Mapping[str, int]
    limit_dn: float
    checksums: Mapping[str, int]

    def clamp(self, name: str, tensor: np.ndarray) -> np.ndarray:
        """A tensor as the clamped network writes it."""
        return np.minimum(tensor, self.relu6[name]) if name in self.relu6 else tensor

    def limit(self, correction: np.ndarray) -> np.ndarray:
        """A correction, of full scale, within its bound."""
        bound = np.float32(self.limit_dn / MAX_DN)
        return np.asarray(np.clip(correction, -bound, bound), np.float32)


def learn_guards(core: IntCore, planes: Iterable[np.ndarray]) -> Guards:
    """Guards from what a healthy core reaches on calibration patches, planes (N, 3, H, W) each."""
    relus = {op.output: 0 for op in core.ops if isinstance(op, IntConv) and op.relu}
    largest_dn = 0.0
    for each in planes:
        tensors, _ = run_core(core, each)
        relus = {name: max(peak, int(tensors[name].max())) for name, peak in relus.items()}
        largest_dn = max(largest_dn, MAX_DN * float(np.abs(merged_correction(core, tensors)).max()))
    bounds = {name: _next_relu6(peak) for name, peak in relus.items() if peak <= RELU6_UNITS}
    return Guards(bounds, _next_power(largest_dn), checksums(core))


def checksums(core: IntCore) -> dict[str, int]:
    """CRC-32 of each convolution's weights and bias."""
    return {op.name: _checksum(op) for op in core.ops if isinstance(op, IntConv)}


def reloaded(core: IntCore, sound: IntCore, known: Mapping[str, int]) -> IntCore:
    """The core with every convolution whose checksum is not the known one taken from a sound copy."""
    safe = {op.name: op for op in sound.ops if isinstance(op, IntConv)}
    broken = {name: safe[name] for name, found in checksums(core).items() if found != known[name]}
    return with_ops(core, broken)


def voted(copies: tuple[Shifts, Shifts, Shifts]) -> dict[tuple[str, str], int]:
    """Each shift as two of its three copies have it, bit by bit."""
    a, b, c = copies
    return {key: (a[key] & b[key]) | (a[key] & c[key]) | (b[key] & c[key]) for key in a}


def guarded(faults: Faults, guards: Guards) -> Faults:
    """The same faults in a clamped network: a result is bounded before memory can spoil it."""

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        return faults.touch(name, guards.clamp(name, tensor))

    return Faults(faults.shifts, touch)


def _checksum(op: IntConv) -> int:
    return zlib.crc32(op.bias.tobytes(), zlib.crc32(np.ascontiguousarray(op.weight).tobytes()))


def _next_relu6(peak: int) -> int:
    """The smallest of 96, 48, 24, 12, 6 and 3 that is not below."""
    return min(RELU6_UNITS >> k for k in range(6) if RELU6_UNITS >> k >= peak)


def _next_power(value: float) -> float:
    """The smallest power of two that is not below, 1 at least."""
    return float(2 ** int(np.ceil(np.log2(max(value, 1.0)))))
