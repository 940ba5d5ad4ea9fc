"""What may be wrong on a board: a layer's results computed again as a faulty board would compute
them.

Each explanation is a computation. It is given where it makes the integers that the board wrote, in
all cases that were run; nothing is guessed from the size of a difference.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product

import numpy as np

from beers_deploy.quant.core import INT8_MAX, INT8_MIN, IntConv, IntCore
from beers_deploy.quant.graph import PLANES, Activation, Op, Window
from beers_deploy.quant.integer.arithmetic import convolve
from beers_deploy.quant.integer.reference import layer_sums, rounded, saturated

Layer = IntConv | Op
Tensors = Mapping[str, np.ndarray]
Compute = Callable[[Tensors], np.ndarray]
"""A layer's results (N, C, H, W) from the tensors that it reads."""
Explanation = tuple[str, Compute]
"""A fault in words, and what it would make of a layer."""


@dataclass(frozen=True)
class Seen:
    """One layer on a board: every sound tensor of the case, and what the board wrote in place of
    one.
    """

    tensors: Tensors
    seen: np.ndarray

    def unlike(self, made: np.ndarray, shifted: bool = False) -> int:
        """How many values are not those; of what is `shifted`, its border of a quarter of the side
        left out.
        """
        results = self.seen
        if shifted:
            # `np.roll` brings in the pixels of the far border, where a board has others.
            rows, columns = (slice(side // 4, side - side // 4) for side in results.shape[2:])
            made = made[..., rows, columns]
            results = results[..., rows, columns]
        return int((made != results).sum()) if made.shape == results.shape else results.size


MOST_LEFT = 0.1
"""Of the differences, by a fault that explains the rest: there may be two at a time."""
SHIFTED = "the tile is shifted by "
PADDINGS = {"copies of the border": "edge", "a mirror image": "reflect", "-128": "constant"}
MOST_CHANNELS = 4
LIKELY = 12
"""Channels that are looked through for a wrong bit, which shows in one; and weights of each that
are tried.
"""
HALO_MAX_PX = 16
SIDES = {"outer": (1, 1, 1, 1), "upper": (1, 0, 0, 0), "left": (0, 1, 0, 0), "lower": (0, 0, 1, 0)}
SIDES["right"] = (0, 0, 0, 1)


def explain(core: IntCore, ops: Sequence[Layer], cases: Sequence[Seen], half_even: bool) -> str:
    """The fault that gives exactly what a board wrote of one layer; empty where none that is known
    does.

    Args:
        core: of the network.
        ops: the layers whose results nobody saw, in their order, and last the one that differs;
            none for the planes that the core reads.
        cases: in which its results differ.
        half_even: how a sound board rounds ties: to even, or else up.
    """
    output = ops[-1].output if ops else PLANES
    faults = Faulty(core, half_even)
    best = (MOST_LEFT, "")
    counts = [case.unlike(case.tensors[output]) for case in cases]
    worst = cases[int(np.argmax(counts))]
    alone = (
        faults.of_layer(ops[-1], worst)
        if ops
        else faults.of_tensor(PLANES, lambda tensors: tensors[PLANES], worst)
    )
    for words, compute in chain(alone, faults.before(ops) if len(ops) > 1 else ()):
        shifted = words.startswith(SHIFTED)
        # One case refutes most faults; only what explains the worst one is run on all of them.
        if worst.unlike(compute(worst.tensors), shifted) > MOST_LEFT * max(counts):
            continue
        remainder = sum(case.unlike(compute(case.tensors), shifted) for case in cases)
        if not remainder:
            return words
        best = min(best, (remainder / sum(counts), words))
    return f"{best[1]}, which leaves {best[0]:.1%} of the differences" if best[1] else ""


@dataclass(frozen=True)
class Faulty:
    """A network's integers, and how a sound board rounds ties: what faulty boards make of its
    layers.
    """

    core: IntCore
    half_even: bool

    def sound(self, op: Layer, **other: object) -> Compute:
        """A layer as it should be computed, or with some of its numbers replaced."""
        changed = replace(op, **other) if other else op  # type: ignore[type-var]
        return self._summed(changed, lambda sums, shift: saturated(self._whole(sums, shift)))

    def _whole(self, sums: np.ndarray, shift: int) -> np.ndarray:
        return rounded(sums, shift, self.half_even)[0]

    def _summed(self, op: Layer, change: Callable[[np.ndarray, int], np.ndarray]) -> Compute:
        return lambda tensors: change(*layer_sums(self.core, op, tensors)[:2])

    def of_layer(self, op: Layer, worst: Seen) -> Iterator[Explanation]:
        """Every fault of a layer whose inputs are sound."""
        yield from self.of_rules(op)
        if PLANES in op.inputs:
            yield from _halo(self.sound(op))
        yield from self.of_tensor(op.output, self.sound(op), worst)
        if isinstance(op, IntConv):
            yield from self._bits(op, worst)

    def of_rules(self, op: Layer) -> Iterator[Explanation]:
        """Faults of a board's rules, which may be the same in every layer: rounding, saturation,
        scales, padding.
        """
        other = replace(self, half_even=not self.half_even).sound(op)
        yield (
            (
                "ties are rounded "
                f"{'up instead of to even' if self.half_even else 'to even instead of up'}"
            ),
            other,
        )
        # An arithmetic shift by itself rounds down, towards minus infinity.
        cut = self._summed(op, lambda sums, shift: saturated(sums >> max(shift, 0)))
        yield "results are cut off instead of rounded", cut
        # That is the rule of AMD's quantiser for weights, bias and input, not for activations.
        away = self._summed(
            op, lambda sums, by: saturated(np.sign(sums) * rounded(np.abs(sums), by, False)[0])
        )
        yield "ties are rounded away from zero", away
        # Two's complement keeps the lowest 8 bits of a sum.
        wrap = self._summed(
            op, lambda sums, by: ((self._whole(sums, by) + 128) % 256 - 128).astype(np.int16)
        )
        yield "results beyond int8 wrap around instead of saturating", wrap
        short = self._summed(
            op, lambda sums, by: np.clip(self._whole(sums, by), -INT8_MAX, INT8_MAX)
        )
        yield "results saturate at -127 instead of -128", short
        for by, name in product((1, -1, 2, -2), dict.fromkeys((op.output, *op.inputs))):
            # The integers stay: another scale of an input or of the result is another shift.
            frac_bits = {**self.core.frac_bits, name: self.core.frac_bits[name] + by}
            core = replace(self.core, frac_bits=frac_bits)
            yield (
                f"the scale of {name} is taken as 2^{-by} times what it is",
                replace(self, core=core).sound(op),
            )
        if isinstance(op, IntConv):
            yield from self._of_convolution(op)

    def _of_convolution(self, op: IntConv) -> Iterator[Explanation]:
        for by in (1, -1, 2, -2):
            yield (
                f"its bias is taken as 2^{by} times what it is",
                self.sound(op, bias_frac_bits=op.bias_frac_bits - by),
            )
        yield "its bias is not added", self.sound(op, bias=np.zeros_like(op.bias))
        if op.activation.written is not Activation.none:
            yield (
                f"its activation {op.activation} is missing",
                self.sound(op, activation=Activation.none),
            )
        yield (
            "its kernels are turned by half a turn",
            self.sound(op, weight=op.weight[:, :, ::-1, ::-1]),
        )
        # A transposed convolution's pads crop its result, so it has no border to fill otherwise.
        if not op.transposed and any(op.window.pads):
            inside = self.sound(op, window=Window(op.window.strides, dilations=op.window.dilations))
            for words, mode in PADDINGS.items():
                yield f"it is padded with {words} instead of zeros", _padded(op, inside, mode)

    def of_tensor(self, name: str, meant: Compute, worst: Seen) -> Iterator[Explanation]:
        """Values that are right, and stand in other channels or places; of the planes also a halo
        of zeros.
        """
        if name == PLANES:
            yield from _halo(meant)
        sources = [
            _channel_like(worst.tensors[name], worst.seen[:, k], k)
            for k in range(worst.seen.shape[1])
        ]
        if None not in sources:
            order = ", ".join(f"{source} at {k}" for k, source in enumerate(sources) if source != k)
            indices = np.array(sources)
            yield (
                f"channels stand in another order: {order}",
                lambda tensors: meant(tensors)[:, indices],
            )
        yield "rows and columns changed places", lambda tensors: meant(tensors).swapaxes(2, 3)
        yield from _shifted(meant)

    def _bits(self, op: IntConv, worst: Seen) -> Iterator[Explanation]:
        """One bit of one bias or one weight that is not what it should be."""
        channels = (worst.seen != worst.tensors[op.output]).any((0, 2, 3)).nonzero()[0]
        # A bias or a weight writes to one channel: where many differ, a single bit is no reason.
        if len(channels) > MOST_CHANNELS:
            return
        for channel, bit in product(map(int, channels), range(8)):
            words = f"bit {bit} of the bias of channel {channel} is flipped"
            yield words, self.sound(op, bias=_flipped(op.bias, (channel,), bit))
            for place in _likely_weights(op, channel, worst):
                words = f"bit {bit} of weight {list(place)} is flipped"
                yield words, self.sound(op, weight=_flipped(op.weight, place, bit))

    def before(self, ops: Sequence[Layer]) -> Iterator[Explanation]:
        """Faults of what came before a layer: of a rule in all layers, all of a kind or one; or
        ahead of all.
        """
        faults = {op.output: dict(self.of_rules(op)) for op in ops}

        def through(wrong: Mapping[str, Compute]) -> Compute:
            def compute(tensors: Tensors) -> np.ndarray:
                # Nobody saw the layers before the last, so a fault in one is carried through all.
                results = dict(tensors)
                for op in ops:
                    results[op.output] = wrong.get(op.output, self.sound(op))(results)
                return results[ops[-1].output]

            return compute

        kinds = {
            f"every {kind}": [op for op in ops if _kind(op) == kind] for kind in map(_kind, ops)
        }
        places = {"every layer": ops, **kinds, **{op.name: [op] for op in ops}}
        for place, layers in places.items():
            for words in dict.fromkeys(chain.from_iterable(faults[op.output] for op in layers)):
                wrong = {
                    op.output: faults[op.output][words]
                    for op in layers
                    if words in faults[op.output]
                }
                yield f"{words}, in {place}", through(wrong)
        if any(PLANES in op.inputs for op in ops):
            yield from chain(_halo(through({})), _shifted(through({})))


def _kind(op: Layer) -> str:
    return "convolution" if isinstance(op, IntConv) else type(op).__name__


def _padded(op: IntConv, inside: Compute, mode: str) -> Compute:
    top, left, bottom, right = op.window.pads
    sizes = ((0, 0), (0, 0), (top, bottom), (left, right))
    more = {"constant_values": INT8_MIN}

    def compute(tensors: Tensors) -> np.ndarray:
        wide = np.pad(tensors[op.input], sizes, mode, **(more if mode == "constant" else {}))  # type: ignore[call-overload]
        return inside({**tensors, op.input: wide})

    return compute


def _halo(sound: Compute) -> Iterator[Explanation]:
    """What surrounds a tile is zeros where the planes come in."""
    for (side, ends), width in product(SIDES.items(), range(1, HALO_MAX_PX + 1)):

        def compute(
            tensors: Tensors, pads: tuple[int, ...] = tuple(width * end for end in ends)
        ) -> np.ndarray:
            # `pads` is a default so that each function keeps its own turn of the loop.
            bare = np.zeros_like(tensors[PLANES])
            height, across = bare.shape[2:]
            inside = ..., slice(pads[0], height - pads[2]), slice(pads[1], across - pads[3])
            bare[inside] = tensors[PLANES][inside]
            return sound({**tensors, PLANES: bare})

        yield (
            f"the {side} {width} px of the planes are zeros instead of the tile's surroundings",
            compute,
        )


def _shifted(sound: Compute) -> Iterator[Explanation]:
    """Pixels that lie beside their places."""
    for down, across in (
        (1, 0),
        (-1, 0),
        (0, 1),
        (0, -1),
        (1, 1),
        (-1, -1),
        (2, 0),
        (-2, 0),
        (0, 2),
        (0, -2),
    ):

        def compute(tensors: Tensors, by: tuple[int, int] = (down, across)) -> np.ndarray:
            return np.roll(sound(tensors), by, (2, 3))

        moves = ((down, "down"), (across, "right"))
        yield SHIFTED + " and ".join(f"{n} px {way}" for n, way in moves if n), compute


def _channel_like(right: np.ndarray, channel: np.ndarray, place: int) -> int | None:
    """The number of the channel of `right` (N, C, H, W) that is the same as one (N, H, W); `place`
    where it is.
    """
    same = (right == channel[:, None]).all((0, 2, 3))
    # Equal channels, such as dead ones, must not count as moved.
    if same[place]:
        return place
    return int(same.argmax()) if same.any() else None


def _flipped(values: np.ndarray, place: tuple[int, ...], bit: int) -> np.ndarray:
    changed = values.copy()
    # As uint8 the sign bit can be flipped like any other.
    changed.view(np.uint8)[place] ^= np.uint8(1 << bit)
    return changed


def _likely_weights(op: IntConv, channel: int, worst: Seen) -> list[tuple[int, ...]]:
    """The weights of a channel with whose inputs the differences go up and down most."""
    difference = (worst.seen - worst.tensors[op.output])[:, channel].astype(np.float64).ravel()
    # A grouped convolution needs a kernel for every group, of which the channel's own counts.
    count = len(op.weight) if op.groups > 1 else 1
    row = channel if op.groups > 1 else 0
    alike: dict[tuple[int, ...], float] = {}
    for place in np.ndindex(*op.weight.shape[1:]):
        alone = np.zeros((count, *op.weight.shape[1:]), np.int8)
        alone[(row, *place)] = 1
        inputs = convolve(worst.tensors[op.input], alone, op.window, op.groups, op.transposed)
        values = inputs[:, row].astype(np.float64).ravel()
        # A wrong weight adds a multiple of what it meets, which the cosine finds at any size.
        alike[(channel, *place)] = abs(float(difference @ values)) / (
            float(np.linalg.norm(values)) or 1.0
        )
    return sorted(alike, key=lambda place: -alike[place])[:LIKELY]


def where(seen: np.ndarray, meant: np.ndarray) -> str:
    """Where in tiles (N, C, H, W) results differ: in a channel, along the border, in some rows, or
    everywhere.
    """
    differing = seen != meant
    channels, rows, columns = (
        differing.any(axes).nonzero()[0] for axes in ((0, 2, 3), (0, 1, 3), (0, 1, 2))
    )
    height, width = seen.shape[2:]
    within = "" if len(channels) > 1 or seen.shape[1] == 1 else f" of channel {channels[0]}"
    at = np.argwhere(differing.any((0, 1)))
    # The distance of the innermost difference from the nearest border.
    reach = int(np.minimum(at, np.array([height - 1, width - 1]) - at).min(1).max()) + 1
    if reach < min(height, width) // 4:
        return f"within {reach} px of the border{within}"
    for name, places, size in (("row", rows, height), ("column", columns, width)):
        if len(places) <= size // 4:
            return f"in {name}s {places[0]} to {places[-1]}{within}"
    return (
        f"everywhere{within}"
        if within
        else f"everywhere, in {len(channels)} of {seen.shape[1]} channels"
    )
