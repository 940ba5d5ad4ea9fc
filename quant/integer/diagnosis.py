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
        seen = self.seen
        if shifted:
            rows, columns = (slice(side // 4, side - side // 4) for side in seen.shape[2:])
            made = made[..., rows, columns]
            seen = seen[..., rows, columns]
        return int((made != seen).sum()) if made.shape == seen.shape else seen.size


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
        else faults.of_tensor(PLANES, lambda known: known[PLANES], worst)
    )
    for words, compute in chain(alone, faults.before(ops) if len(ops) > 1 else ()):
        shifted = words.startswith(SHIFTED)
        if worst.unlike(compute(worst.tensors), shifted) > MOST_LEFT * max(counts):
            continue
        left = sum(case.unlike(compute(case.tensors), shifted) for case in cases)
        if not left:
            return words
        best = min(best, (left / sum(counts), words))
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
        return lambda known: change(*layer_sums(self.core, op, known)[:2])

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
        cut = self._summed(op, lambda sums, shift: saturated(sums >> max(shift, 0)))
        yield "results are cut off instead of rounded", cut
        away = self._summed(
            op, lambda sums, by: saturated(np.sign(sums) * rounded(np.abs(sums), by, False)[0])
        )
        yield "ties are rounded away from zero", away
        wrap = self._summed(
            op, lambda sums, by: ((self._whole(sums, by) + 128) % 256 - 128).astype(np.int16)
        )
        yield "results beyond int8 wrap around instead of saturating", wrap
        short = self._summed(
            op, lambda sums, by: np.clip(self._whole(sums, by), -INT8_MAX, INT8_MAX)
        )
        yield "results saturate at -127 instead of -128", short
        for by, name in product((1, -1, 2, -2), dict.fromkeys((op.output, *op.inputs))):
            moved = replace(
                self.core, frac_bits={**self.core.frac_bits, name: self.core.frac_bits[name] + by}
            )
            yield (
                f"the scale of {name} is taken as 2^{-by} times what it is",
                replace(self, core=moved).sound(op),
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
        of = [
            _channel_like(worst.tensors[name], worst.seen[:, k], k)
            for k in range(worst.seen.shape[1])
        ]
        if None not in of:
            moved = ", ".join(f"{each} at {k}" for k, each in enumerate(of) if each != k)
            sources = np.array(of)
            yield (
                f"channels stand in another order: {moved}",
                lambda known: meant(known)[:, sources],
            )
        yield "rows and columns changed places", lambda known: meant(known).swapaxes(2, 3)
        yield from _shifted(meant)

    def _bits(self, op: IntConv, worst: Seen) -> Iterator[Explanation]:
        """One bit of one bias or one weight that is not what it should be."""
        channels = (worst.seen != worst.tensors[op.output]).any((0, 2, 3)).nonzero()[0]
        for channel, bit in product(
            map(int, channels[: len(channels) <= MOST_CHANNELS and MOST_CHANNELS]), range(8)
        ):
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
            def compute(known: Tensors) -> np.ndarray:
                made = dict(known)
                for op in ops:
                    made[op.output] = wrong.get(op.output, self.sound(op))(made)
                return made[ops[-1].output]

            return compute

        kinds = {
            f"every {kind}": [op for op in ops if _kind(op) == kind] for kind in map(_kind, ops)
        }
        for place, chosen in {"every layer": ops, **kinds, **{op.name: [op] for op in ops}}.items():
            for words in dict.fromkeys(words for op in chosen for words in faults[op.output]):
                wrong = {
                    op.output: faults[op.output][words]
                    for op in chosen
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

    def compute(known: Tensors) -> np.ndarray:
        wide = np.pad(known[op.input], sizes, mode, **(more if mode == "constant" else {}))  # type: ignore[call-overload]
        return inside({**known, op.input: wide})

    return compute


def _halo(meant: Compute) -> Iterator[Explanation]:
    """What surrounds a tile is zeros where the planes come in."""
    for (side, ends), width in product(SIDES.items(), range(1, HALO_MAX_PX + 1)):

        def compute(
            known: Tensors, pads: tuple[int, ...] = tuple(width * end for end in ends)
        ) -> np.ndarray:
            bare, (height, across) = np.zeros_like(known[PLANES]), known[PLANES].shape[2:]
            inside = ..., slice(pads[0], height - pads[2]), slice(pads[1], across - pads[3])
            bare[inside] = known[PLANES][inside]
            return meant({**known, PLANES: bare})

        yield (
            f"the {side} {width} px of the planes are zeros instead of the tile's surroundings",
            compute,
        )


def _shifted(meant: Compute) -> Iterator[Explanation]:
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

        def compute(known: Tensors, by: tuple[int, int] = (down, across)) -> np.ndarray:
            return np.roll(meant(known), by, (2, 3))

        yield (
            SHIFTED
            + " and ".join(f"{n} px {way}" for n, way in ((down, "down"), (across, "right")) if n),
            compute,
        )


def _channel_like(right: np.ndarray, channel: np.ndarray, place: int) -> int | None:
    """The number of the channel of `right` (N, C, H, W) that is the same as one (N, H, W); `place`
    where it is.
    """
    same = (right == channel[:, None]).all((0, 2, 3))
    if same[place]:
        return place
    return int(same.argmax()) if same.any() else None


def _flipped(values: np.ndarray, place: tuple[int, ...], bit: int) -> np.ndarray:
    changed = values.copy()
    changed.view(np.uint8)[place] ^= np.uint8(1 << bit)
    return changed


def _likely_weights(op: IntConv, channel: int, worst: Seen) -> list[tuple[int, ...]]:
    """The weights of a channel with whose inputs the differences go up and down most."""
    difference = (worst.seen - worst.tensors[op.output])[:, channel].astype(np.float64).ravel()
    count, row = (
        (len(op.weight), channel) if op.groups > 1 else (1, 0)
    )  # kernels that are computed, and which counts
    alike: dict[tuple[int, ...], float] = {}
    for place in np.ndindex(*op.weight.shape[1:]):
        alone = np.zeros((count, *op.weight.shape[1:]), np.int8)
        alone[(row, *place)] = 1
        read = convolve(worst.tensors[op.input], alone, op.window, op.groups, op.transposed)[:, row]
        values = read.astype(np.float64).ravel()
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
    reach = int(np.minimum(at, np.array([height - 1, width - 1]) - at).min(1).max()) + 1
    if reach < min(height, width) // 4:
        return f"within {reach} px of the border{within}"
    for name, found, size in (("row", rows, height), ("column", columns, width)):
        if len(found) <= size // 4:
            return f"in {name}s {found[0]} to {found[-1]}{within}"
    return (
        f"everywhere{within}"
        if within
        else f"everywhere, in {len(channels)} of {seen.shape[1]} channels"
    )
