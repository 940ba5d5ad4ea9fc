"""Bit flips (single-event upsets) in weights, shifts, feature maps and the image, and cheap guards
against them.

The guards are ReLU6 in place of ReLU, a limit of the correction, scrubbing of the weights by their
checksums, and triple modular redundancy of the shifts.
"""

import math
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.core import IntConv, IntCore, op_shifts
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import PLANES, Activation, channels_of
from beers_deploy.quant.integer.reference import NO_FAULTS, Faults, merged_correction, run_core

MEGABIT = 1e6
INT8_BITS = 8
PIXEL_BITS = 12
SHIFT_BITS = 6
ShiftValues = dict[tuple[str, str], int]
"""Shifts by operation and field, as `Faults` accepts them."""


def flip_count(bits: int, per_megabit: float, generator: np.random.Generator) -> int:
    """Draw how many bits of a memory flip, if each flips independently.

    Args:
        bits: the number of bits in the memory.
        per_megabit: the mean number of flips in 10^6 bits.
        generator: draws the number.
    """
    return int(generator.binomial(bits, min(per_megabit / MEGABIT, 1.0)))


def flip_bits(
    values: np.ndarray, count: int, generator: np.random.Generator, bits: int = INT8_BITS
) -> np.ndarray:
    """Return a copy of integers in which random bits are flipped.

    Args:
        values: integers of any shape. Those of signed types are in two's complement.
        count: the number of different bits to flip.
        generator: draws which bits flip.
        bits: the number of bits that one integer has in the simulated memory; 8 by default.
    """
    choices = values.size * bits
    # Without replacement: a bit that flips twice would not have flipped.
    drawn_bits = generator.choice(choices, min(count, choices), replace=False, shuffle=False)
    places, which = divmod(drawn_bits, bits)
    # As unsigned bits of the memory's width: the sign comes back at the end.
    raw = (values.ravel().astype(np.int64) & ((1 << bits) - 1)).copy()
    # `at`, because two flips may fall into one number, and plain indexing would keep the last
    # alone.
    np.bitwise_xor.at(raw, places, np.left_shift(1, which))
    if np.issubdtype(values.dtype, np.signedinteger):
        raw = np.where(raw >> (bits - 1) == 1, raw - (1 << bits), raw)
    return raw.astype(values.dtype).reshape(values.shape)


def as_stored(core: IntCore) -> IntCore:
    """Return an integer core with its values as the board stores them in memory: each bias in int8,
    at the finest scale that holds it.

    Raises:
        ModelError: a bias or a shift does not fit the memory of the board.
    """
    # A shift has six bits in memory, in two's complement.
    for (op, field), shift in shifts_of(core).items():
        if not -(1 << (SHIFT_BITS - 1)) <= shift < 1 << (SHIFT_BITS - 1):
            raise _refused(f"{field} {shift} at {op}")
    narrow = []
    for conv in core.convolutions:
        bias = conv.bias.astype(np.int64)
        shift = 0
        # Bits go from the low end as long as the bias is too large for int8.
        while (np.clip(bias >> shift, INT8_MIN, INT8_MAX) != bias >> shift).any():
            shift += 1
        if ((bias >> shift) << shift != bias).any():
            raise _refused(
                f"a bias of {int(np.abs(bias).max())} at {conv.name}, finer than its size allows"
            )
        stored = (bias >> shift).astype(np.int8)
        narrow.append(replace(conv, bias=stored, bias_frac_bits=conv.bias_frac_bits - shift))
    return with_ops(core, narrow)


def _refused(actual: str) -> ModelError:
    return ModelError(
        "The INT8 core must have bias and shifts as the board stores them, but it has "
        f"{actual}. Make it with 'beers-deploy quantize'."
    )


def weight_bits(core: IntCore) -> int:
    """Return the number of bits of memory that hold the weights and bias of an integer core."""
    return INT8_BITS * sum(op.weight.size + op.bias.size for op in core.convolutions)


def flip_weights(core: IntCore, count: int, generator: np.random.Generator) -> IntCore:
    """Return a core with `count` different random bits of its stored weights and bias flipped."""
    sizes = np.array([op.weight.size + op.bias.size for op in core.convolutions])
    # How many of the bits fall into each layer, as if all were drawn from one memory without
    # replacement.
    counts = generator.multivariate_hypergeometric(sizes * INT8_BITS, count).tolist()
    hit = (
        flip_conv(op, flips, generator)
        for op, flips in zip(core.convolutions, counts, strict=True)
        if flips
    )
    return with_ops(core, hit)


def flip_conv(op: IntConv, count: int, generator: np.random.Generator) -> IntConv:
    """Return a convolution with `count` different random bits of its weights and bias flipped."""
    values = flip_bits(np.concatenate([op.weight.ravel(), op.bias]), count, generator)
    return replace(
        op, weight=values[: op.weight.size].reshape(op.weight.shape), bias=values[op.weight.size :]
    )


def with_ops(core: IntCore, others: Iterable[IntConv]) -> IntCore:
    """Return an integer core in which the convolutions `others` replace those of the same name."""
    by_name = {op.name: op for op in others}
    return replace(core, ops=tuple(by_name.get(op.name, op) for op in core.ops))


def map_channels(core: IntCore) -> dict[str, int]:
    """Return the number of channels of every tensor of an integer core, by the tensor's name."""
    return channels_of(core.ops, {PLANES: core.host_part.planes})


def shifts_of(core: IntCore) -> ShiftValues:
    """Return the shifts, which scale sums by powers of two, by the names of operation and field.

    The field shift_read of an add is left out: it is 0, because a stream shares one scale.
    """
    shifts: ShiftValues = {}
    for op in core.ops:
        for field, value in op_shifts(op, core.frac_bits).items():
            if field != "shift_read":
                shifts[op.name, field] = value
    return shifts


def bits_apart(shifts: ShiftValues, others: ShiftValues) -> int:
    """Return the number of bits in which two sets of shifts differ, with six bits in each shift."""
    return sum(
        ((shifts[key] ^ others[key]) & ((1 << SHIFT_BITS) - 1)).bit_count() for key in shifts
    )


def flip_shifts(shifts: ShiftValues, count: int, generator: np.random.Generator) -> ShiftValues:
    """Return shifts with `count` different random bits of them flipped, of six bits in each."""
    raw = flip_bits(np.array(list(shifts.values()), np.int16), count, generator, SHIFT_BITS)
    return dict(zip(shifts, raw.tolist(), strict=True))


RELU6_UNITS = (96, 48, 24, 12, 6, 3)
"""The value 6 with 4 to -1 fractional bits. With 5 it would be 192, which exceeds int8."""


@dataclass(frozen=True)
class Guards:
    """Guards of one network against bit flips: bounds that it did not exceed without faults, and
    checksums of its weights.

    Attributes:
        relu6: the upper bounds of ReLUs' outputs in int8, by the tensor's name; some have none.
        limit_dn: the largest magnitude, in DN, of the correction that the network adds to an image.
        checksums: the CRC-32 of the weights and bias of each convolution, by the convolution's
            name.
    """

    relu6: Mapping[str, int]
    limit_dn: float
    checksums: Mapping[str, int]

    def limit(self, correction: np.ndarray) -> np.ndarray:
        """Clip the correction that the network adds to an image, in shares of full scale and of any
        shape, to `limit_dn` on both sides.
        """
        bound = np.float32(self.limit_dn / MAX_DN)
        return np.asarray(np.clip(correction, -bound, bound), np.float32)


def learn_guards(core: IntCore, planes: Iterable[np.ndarray]) -> Guards:
    """Learn the guards of a network from the values that it reaches on calibration patches without
    faults.

    Args:
        core: the integer core as the board stores it.
        planes: batches of patches, (N, P, H, W) int8 each, as the host encodes images for the core.
    """
    relus = {op.output: 0 for op in core.convolutions if op.activation is Activation.relu}
    largest_dn = 0.0
    for batch in planes:
        tensors, _ = run_core(core, batch)
        relus = {name: max(peak, int(tensors[name].max())) for name, peak in relus.items()}
        largest_dn = max(largest_dn, MAX_DN * float(np.abs(merged_correction(core, tensors)).max()))
    # The smallest bound that no calibration patch exceeds: fault-free values stay as they are.
    fitting = {
        name: [bound for bound in RELU6_UNITS if bound >= peak] for name, peak in relus.items()
    }
    bounds = {name: min(units) for name, units in fitting.items() if units}
    # The next power of two: the limit leaves room above what the patches reach.
    limit_dn = 2.0 ** math.ceil(math.log2(max(largest_dn, 1.0)))
    return Guards(bounds, limit_dn, checksums(core))


def checksums(core: IntCore) -> dict[str, int]:
    """Return the CRC-32 of each convolution's weights and bias, by the name of the convolution."""
    return {
        op.name: zlib.crc32(op.bias.tobytes(), zlib.crc32(op.weight.tobytes()))
        for op in core.convolutions
    }


def scrubbed(core: IntCore, intact: IntCore, checks: Mapping[str, int]) -> IntCore:
    """Repair the weights of an integer core by their checksums (scrubbing).

    Args:
        core: the core, whose weights may have flipped bits.
        intact: the core without faults.
        checks: the CRC-32 of each convolution without faults, by name.

    Returns:
        The core in which every convolution with another checksum is replaced by that of `intact`.
    """
    wrong = {name for name, _ in checksums(core).items() - checks.items()}
    return with_ops(core, (op for op in intact.convolutions if op.name in wrong))


def voted(copies: tuple[ShiftValues, ShiftValues, ShiftValues]) -> ShiftValues:
    """Return the majority of three copies of the shifts, bit by bit (triple modular redundancy)."""
    a, b, c = copies
    return {key: (a[key] & b[key]) | (a[key] & c[key]) | (b[key] & c[key]) for key in a}


def guarded(faults: Faults, guards: Guards) -> Faults:
    """Return the same faults for a network whose ReLUs are bounded.

    Each ReLU's output is clipped to its bound before it is stored, so that a flip in memory acts on
    the clipped value.
    """

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        clamped = np.minimum(tensor, guards.relu6[name]) if name in guards.relu6 else tensor
        return faults.touch(name, clamped)

    return Faults(faults.shifts, touch)


@dataclass(frozen=True)
class Injected:
    """A network and an image after an injection of bit flips into one kind of memory.

    Attributes:
        core: the integer core with its weights after the injection.
        faults: the faults in shifts and feature maps, which act while the core runs.
        image: the image (1, 1, H, W) in [0, 1] after the injection.
        flips: the number of flipped bits.
    """

    core: IntCore
    faults: Faults
    image: np.ndarray
    flips: int


def restored(injected: Injected, guards: Guards | None = None) -> np.ndarray:
    """Restore the image of an injection with the faulty network, by integer arithmetic.

    Args:
        injected: the network and the image after the injection.
        guards: the bounds of the ReLUs and of the correction, which are then applied; None applies
            none.

    Returns:
        The restored image (1, 1, H, W), float32 in [0, 1].
    """
    faults = guarded(injected.faults, guards) if guards else injected.faults
    core = injected.core
    tensors, _ = run_core(core, core.host_part.encode(injected.image), faults=faults)
    correction = merged_correction(core, tensors)
    correction = guards.limit(correction) if guards else correction
    return np.asarray(core.host_part.finish(injected.image, correction), np.float32)


def _weights(
    core: IntCore, image: np.ndarray, per_megabit: float, generator: np.random.Generator
) -> Injected:
    flips = flip_count(weight_bits(core), per_megabit, generator)
    return Injected(flip_weights(core, flips, generator), NO_FAULTS, image, flips)


def _shifts(
    core: IntCore, image: np.ndarray, per_megabit: float, generator: np.random.Generator
) -> Injected:
    wrong = _flip_copy(core, per_megabit, generator)
    return Injected(core, Faults(wrong), image, bits_apart(wrong, shifts_of(core)))


def _flip_copy(core: IntCore, per_megabit: float, generator: np.random.Generator) -> ShiftValues:
    shifts = shifts_of(core)
    count = flip_count(SHIFT_BITS * len(shifts), per_megabit, generator)
    return flip_shifts(shifts, count, generator)


def _maps(
    core: IntCore, image: np.ndarray, per_megabit: float, generator: np.random.Generator
) -> Injected:
    """Inject faults into every tensor once, between the operation that writes it and those that
    read it.
    """
    places = image[0, 0].size // core.host_part.place_px**2
    channels = map_channels(core)
    counts = {
        name: flip_count(INT8_BITS * places * n, per_megabit, generator)
        for name, n in channels.items()
    }
    seed = int(generator.integers(2**63))
    # The same bits whenever it runs, clamped or not.
    seeds = {name: [seed, number] for number, name in enumerate(counts)}

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        if not counts.get(name):
            return tensor
        return flip_bits(tensor, counts[name], np.random.default_rng(seeds[name]))

    return Injected(core, Faults({}, touch), image, sum(counts.values()))


def _image(
    core: IntCore, image: np.ndarray, per_megabit: float, generator: np.random.Generator
) -> Injected:
    flips = flip_count(PIXEL_BITS * image.size, per_megabit, generator)
    # A pixel has 12 bits in memory, whatever type holds it here.
    dn = flip_bits(np.rint(image * MAX_DN).astype(np.uint16), flips, generator, PIXEL_BITS)
    return Injected(core, NO_FAULTS, (dn / np.float32(MAX_DN)).astype(np.float32), flips)


@dataclass(frozen=True)
class Memory:
    """One kind of memory of the board, and how bit flips are injected into it.

    Attributes:
        inject: the function that flips bits, given a core as the board stores it, an image
            (1, 1, H, W), the rate of flips and a random generator.
        rates: the rates that are tried, in flips per megabit of 10^6 bits.
        times: the factor of the number of injections, because few of them hit a small memory.
        persistent: True if the memory lives longer than a tile, so that scrubbing and voting can
            repair it before the next image.
    """

    inject: Callable[[IntCore, np.ndarray, float, np.random.Generator], Injected]
    rates: tuple[float, ...] = (0.1, 1.0, 10.0, 100.0, 1000.0)
    times: int = 1
    persistent: bool = False


MEMORIES = {
    "weights": Memory(_weights, persistent=True),
    # There are too few shifts to be hit at rates that matter elsewhere.
    "shifts": Memory(_shifts, (10.0, 100.0, 1000.0, 10_000.0), 10, persistent=True),
    "maps": Memory(_maps),
    "image": Memory(_image, times=5),
}


def corrected(
    injected: Injected,
    intact: IntCore,
    guards: Guards,
    per_megabit: float,
    generator: np.random.Generator,
) -> Injected:
    """Repair a network after an injection, as the host does before the next image: the weights by
    their checksums, the shifts by a majority vote of three copies.

    Args:
        injected: the network after the injection, whose shifts are the first of the three copies.
        intact: the core without faults.
        guards: the guards of the network, with the checksums of its weights.
        per_megabit: the rate of flips in the other two copies of the shifts, independently.
        generator: draws which bits of these copies flip.
    """
    core = scrubbed(injected.core, intact, guards.checksums)
    own = {**shifts_of(intact), **injected.faults.shifts}
    second, third = (_flip_copy(intact, per_megabit, generator) for _ in range(2))
    shifts = voted((own, second, third)) if injected.faults.shifts else {}
    return replace(injected, core=core, faults=replace(injected.faults, shifts=shifts))
