"""Bit flips (single-event upsets) in weights, shifts, feature maps and the image, and cheap guards against them.

The guards: ReLU6 in place of ReLU, a limit of the correction, scrubbing of the weights by their checksums, triple
modular redundancy of the shifts.
"""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from model.io.images import MAX_DN
from profiles.errors import ModelError
from quant.core import INT8_MAX, INT8_MIN, SHIFTS, IntConv, IntCore, op_shifts
from quant.graph import PLANES, Activation, channels_of
from quant.integer import Faults, merged_correction, run_core

MEGABIT = 1e6
INT8_BITS, PIXEL_BITS, SHIFT_BITS = 8, 12, 6
Shifts = dict[tuple[str, str], int]
"""By operation and field, as `quant.integer.Faults` takes them."""


def flip_count(bits: int, per_megabit: float, generator: np.random.Generator) -> int:
    """How many of `bits` bits flip, each on its own with probability `per_megabit` / 10^6."""
    return int(generator.binomial(bits, min(per_megabit / MEGABIT, 1.0)))


def flip_bits(values: np.ndarray, count: int, generator: np.random.Generator, bits: int = INT8_BITS) -> np.ndarray:
    """A copy of whole numbers, two's complement where their type is signed, with `count` bits flipped.

    Args:
        values: of any shape and integer type that holds them.
        count: how many different bits.
        generator: draws which.
        bits: how many one number has in memory.
    """
    choices = values.size * bits
    places, which = divmod(generator.choice(choices, min(count, choices), replace=False, shuffle=False), bits)
    # As unsigned bits of the memory's width: the sign comes back at the end.
    raw = (values.ravel().astype(np.int64) & ((1 << bits) - 1)).copy()
    # `at`, because two flips may fall into one number, and plain indexing would keep the last alone.
    np.bitwise_xor.at(raw, places, np.left_shift(1, which))
    if np.issubdtype(values.dtype, np.signedinteger):
        raw = np.where(raw >> (bits - 1) == 1, raw - (1 << bits), raw)
    return raw.astype(values.dtype).reshape(values.shape)


def as_stored(core: IntCore) -> IntCore:
    """The core with its bias in int8, at the finest scale that holds it: what the board keeps in memory.

    Raises:
        ModelError: a bias that int8 does not hold, or a shift of more than six bits.
    """
    for (op, field), shift in shifts_of(core).items():
        if not -(1 << (SHIFT_BITS - 1)) <= shift < 1 << (SHIFT_BITS - 1):
            raise _refuse(f"{field} {shift} at {op}")
    return replace(core, ops=tuple(_narrow(op) if isinstance(op, IntConv) else op for op in core.ops))


def _narrow(op: IntConv) -> IntConv:
    bias, shift = op.bias.astype(np.int64), 0
    # Bits go from the low end as long as the bias is too large for int8.
    while (np.clip(bias >> shift, INT8_MIN, INT8_MAX) != bias >> shift).any():
        shift += 1
    if ((bias >> shift) << shift != bias).any():
        raise _refuse(f"a bias of {int(np.abs(bias).max())} at {op.name}, finer than its size allows")
    return replace(op, bias=(bias >> shift).astype(np.int8), bias_frac_bits=op.bias_frac_bits - shift)


def _refuse(got: str) -> ModelError:
    remedy = "make it with 'beers-deploy quantize --regime legal'"
    return ModelError("INT8 core", expected="bias and shifts as the board stores them", got=got, remedy=remedy)


def weight_bits(core: IntCore) -> int:
    """How many bits all weights and bias take in memory."""
    return INT8_BITS * sum(op.weight.size + op.bias.size for op in core.ops if isinstance(op, IntConv))


def flip_weights(core: IntCore, count: int, generator: np.random.Generator) -> IntCore:
    """The core with `count` bits of its weights and bias flipped, wherever they fall."""
    convs = [op for op in core.ops if isinstance(op, IntConv)]
    sizes = np.array([op.weight.size + op.bias.size for op in convs])
    # How many of the bits fall into each layer, as if all were drawn from one memory without replacement.
    share = generator.multivariate_hypergeometric(sizes * INT8_BITS, count)
    hit = {op.name: flip_conv(op, int(n), generator) for op, n in zip(convs, share, strict=True) if n}
    return with_ops(core, hit)


def flip_conv(op: IntConv, count: int, generator: np.random.Generator) -> IntConv:
    """The convolution with `count` bits of weights and bias flipped."""
    stored = flip_bits(np.concatenate([op.weight.ravel(), op.bias]), count, generator)
    return replace(op, weight=stored[: op.weight.size].reshape(op.weight.shape), bias=stored[op.weight.size :])


def with_ops(core: IntCore, others: Mapping[str, IntConv]) -> IntCore:
    """The core with other convolutions of these names."""
    return replace(core, ops=tuple(others.get(op.name, op) for op in core.ops))


def map_channels(core: IntCore) -> dict[str, int]:
    """Channels of every tensor that the core reads or writes."""
    return channels_of(core.ops, {PLANES: core.ends.planes * core.ends.channels})


def shifts_of(core: IntCore) -> Shifts:
    """The shifts of every operation, but for an add's shift_read: 0 where a stream shares one scale."""
    named = [(op.name, *shift) for op in core.ops for shift in op_shifts(op, core.frac_bits, SHIFTS)]
    return {(op, field): value for op, field, value, _ in named if field != "shift_read"}


def bits_apart(shifts: Shifts, others: Shifts) -> int:
    """In how many bits two sets of shifts differ, six bits a shift."""
    return sum(((shifts[key] ^ others[key]) & ((1 << SHIFT_BITS) - 1)).bit_count() for key in shifts)


def flip_shifts(shifts: Shifts, count: int, generator: np.random.Generator) -> Shifts:
    """The shifts with `count` of their bits flipped."""
    raw = flip_bits(np.array(list(shifts.values()), np.int16), count, generator, SHIFT_BITS)
    return dict(zip(shifts, raw.tolist(), strict=True))


RELU6_UNITS = 96
"""6 with 4 fractional bits; with 5 it would be 192, above int8."""


@dataclass(frozen=True)
class Guards:
    """What a fault-free network never exceeds, and what its weights sum to.

    Attributes:
        relu6: bound in units of each ReLU that has one, by its tensor.
        limit_dn: bound of the correction's size.
        checksums: of each convolution, by name.
    """

    relu6: Mapping[str, int]
    limit_dn: float
    checksums: Mapping[str, int]

    def clamp(self, name: str, tensor: np.ndarray) -> np.ndarray:
        """A tensor (N, C, H, W) as the clamped network writes it: int8 units, at most its ReLU6's bound."""
        return np.minimum(tensor, self.relu6[name]) if name in self.relu6 else tensor

    def limit(self, correction: np.ndarray) -> np.ndarray:
        """A correction, any shape, in shares of full scale, clipped to the bound on both sides."""
        bound = np.float32(self.limit_dn / MAX_DN)
        return np.asarray(np.clip(correction, -bound, bound), np.float32)


def learn_guards(core: IntCore, planes: Iterable[np.ndarray]) -> Guards:
    """Guards from what a fault-free core reaches on calibration patches, planes (N, 3, H, W) each."""
    relus = {op.output: 0 for op in core.ops if isinstance(op, IntConv) and op.activation is Activation.relu}
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


def scrubbed(core: IntCore, sound: IntCore, known: Mapping[str, int]) -> IntCore:
    """The core after scrubbing: every convolution whose checksum is not the known one comes from a sound copy."""
    safe = {op.name: op for op in sound.ops if isinstance(op, IntConv)}
    broken = {name: safe[name] for name, found in checksums(core).items() if found != known[name]}
    return with_ops(core, broken)


def voted(copies: tuple[Shifts, Shifts, Shifts]) -> Shifts:
    """The shifts by majority of three copies, bit by bit: triple modular redundancy."""
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
