"""What may be wrong on a board: a layer's results computed again as a faulty board would compute them.

Each explanation is a computation. It is given where it makes the integers that the board wrote, in all cases that
were run; nothing is guessed from the size of a difference.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product

import numpy as np

from beers_deploy.quant.core import INT8_MIN, IntConv, IntCore
from beers_deploy.quant.graph import PLANES, Activation, Op, Window
from beers_deploy.quant.integer.arithmetic import convolve
from beers_deploy.quant.integer.reference import Faults, layer_sums, rounded, saturated

Tensors = Mapping[str, np.ndarray]
Compute = Callable[[Tensors], np.ndarray]
"""A layer's results (N, C, H, W) from the tensors that it reads."""


@dataclass(frozen=True)
class Explanation:
    """What a fault would make of a layer.

    Attributes:
        words: the fault, as a sentence names it.
        compute: the results with it.
        inside: whether the border is not compared, a quarter of the side: the fault brings in what nobody knows.
    """

    words: str
    compute: Compute
    inside: bool = False

    def left(self, case: "Seen") -> int:
        """How many values it makes that are not what the board wrote."""
        made, seen = self.compute(case.tensors), case.seen
        if self.inside:
            rows, columns = (slice(side // 4, side - side // 4) for side in seen.shape[2:])
            made, seen = made[..., rows, columns], seen[..., rows, columns]
        return int((made != seen).sum()) if made.shape == seen.shape else seen.size


@dataclass(frozen=True)
class Seen:
    """One layer on a board: every sound tensor of the case, and what the board wrote in place of one."""

    tensors: Tensors
    seen: np.ndarray


MOST_LEFT = 0.1
"""Of the differences, by a fault that explains the rest: there may be two at a time."""


def explain(core: IntCore, ops: Sequence[IntConv | Op], cases: Sequence[Seen], half_even: bool) -> str:
    """The fault that gives exactly what a board wrote of one layer; empty where none that is known does.

    Args:
        core: of the network.
        ops: the layers whose results nobody saw, in their order, and last the one that differs; none for the planes
            that the core reads.
        cases: in which its results differ.
        half_even: how a sound board rounds ties: to even, or else up.
    """
    output = ops[-1].output if ops else PLANES
    counts = [int((case.seen != case.tensors[output]).sum()) for case in cases]
    worst = cases[int(np.argmax(counts))]
    alone = _explanations(core, ops[-1] if ops else None, worst, half_even)
    best = MOST_LEFT, ""
    for each in chain(alone, _between(core, ops, half_even) if len(ops) > 1 else ()):
        if each.left(worst) > MOST_LEFT * max(counts):
            continue
        left = sum(map(each.left, cases))
        if not left:
            return each.words
        best = min(best, (left / sum(counts), each.words))
    return f"{best[1]}, which leaves {best[0]:.1%} of the differences" if best[1] else ""


def rule_faults(core: IntCore, op: IntConv | Op, half_even: bool) -> Iterator[Explanation]:
    """Faults of a board's rules, which may be the same in every layer: rounding, saturation, scales, padding."""
    yield from _rounding(core, op, half_even)
    yield from _scales(core, op, half_even)
    if isinstance(op, IntConv):
        yield from _convolution(core, op, half_even)


def sound(core: IntCore, op: IntConv | Op, half_even: bool, faults: Faults | None = None) -> Compute:
    """A layer as it should be computed, or with wrong shifts."""

    def compute(tensors: Tensors) -> np.ndarray:
        sums, shift, _, _ = layer_sums(core, op, tensors, faults or Faults())
        return saturated(rounded(sums, shift, half_even)[0])

    return compute


def _explanations(core: IntCore, op: IntConv | Op | None, worst: Seen, half_even: bool) -> Iterator[Explanation]:
    if op is None:
        meant: Compute = lambda tensors: tensors[PLANES]  # noqa: E731
        output = PLANES
    else:
        yield from rule_faults(core, op, half_even)
        meant, output = sound(core, op, half_even), op.output
    yield from _halo(op, meant)
    yield from _order(meant, worst.tensors[output], worst.seen)
    yield from _places(meant)
    if isinstance(op, IntConv):
        yield from _numbers(core, op, worst, half_even)


def _rounding(core: IntCore, op: IntConv | Op, half_even: bool) -> Iterator[Explanation]:
    def other(change: Callable[[np.ndarray, int], np.ndarray]) -> Compute:
        return lambda tensors: change(*layer_sums(core, op, tensors)[:2])

    def whole(sums: np.ndarray, shift: int) -> np.ndarray:
        return rounded(sums, shift, half_even)[0]

    rule = "up instead of to even" if half_even else "to even instead of up"
    yield Explanation(f"ties are rounded {rule}", sound(core, op, not half_even))
    yield Explanation(
        "results are cut off instead of rounded", other(lambda sums, shift: saturated(sums >> max(shift, 0)))
    )
    yield Explanation(
        "ties are rounded away from zero",
        other(lambda sums, shift: saturated(np.sign(sums) * rounded(np.abs(sums), shift, half_even=False)[0])),
    )
    yield Explanation(
        "results beyond int8 wrap around instead of saturating",
        other(lambda sums, shift: ((whole(sums, shift) - INT8_MIN) % 256 + INT8_MIN).astype(np.int16)),
    )
    yield Explanation(
        "results saturate at -127 instead of -128",
        other(lambda sums, shift: np.maximum(saturated(whole(sums, shift)), INT8_MIN + 1)),
    )


def _scales(core: IntCore, op: IntConv | Op, half_even: bool) -> Iterator[Explanation]:
    """Scales that are powers of two off: of the result, of an input, of the weights or the bias."""
    for by in (1, -1, 2, -2):
        for name in dict.fromkeys((op.output, *op.inputs)):
            moved = replace(core, frac_bits={**core.frac_bits, name: core.frac_bits[name] + by})
            words = f"the scale of {name} is taken as 2^{-by} times what it is"
            yield Explanation(words, sound(moved, op, half_even))
        if isinstance(op, IntConv):
            bias = replace(op, bias_frac_bits=op.bias_frac_bits - by)
            yield Explanation(f"its bias is taken as 2^{by} times what it is", sound(core, bias, half_even))


def _convolution(core: IntCore, op: IntConv, half_even: bool) -> Iterator[Explanation]:
    yield Explanation("its bias is not added", sound(core, replace(op, bias=np.zeros_like(op.bias)), half_even))
    if op.activation is not Activation.none:
        without = replace(op, activation=Activation.none)
        yield Explanation(f"its activation {op.activation} is missing", sound(core, without, half_even))
    turned = replace(op, weight=np.ascontiguousarray(op.weight[:, :, ::-1, ::-1]))
    yield Explanation("its kernels are turned by half a turn", sound(core, turned, half_even))
    if op.transposed or not any(op.window.pads):
        return
    inside = replace(op, window=Window(op.window.strides, dilations=op.window.dilations))
    for words, how in PADDINGS.items():
        yield Explanation(f"it is padded with {words} instead of zeros", _padded(core, inside, op, how, half_even))


PADDINGS: Mapping[str, Mapping[str, object]] = {
    "copies of the border": {"mode": "edge"},
    "a mirror image": {"mode": "reflect"},
    "-128": {"mode": "constant", "constant_values": INT8_MIN},
    "127": {"mode": "constant", "constant_values": -1 - INT8_MIN},
}


def _padded(core: IntCore, inside: IntConv, op: IntConv, how: Mapping[str, object], half_even: bool) -> Compute:
    top, left, bottom, right = op.window.pads
    sizes = ((0, 0), (0, 0), (top, bottom), (left, right))

    def compute(tensors: Tensors) -> np.ndarray:
        wide = np.pad(tensors[op.input], sizes, **how)  # type: ignore[call-overload]
        return sound(core, inside, half_even)({**tensors, op.input: wide})

    return compute


HALO_MAX_PX = 16
SIDES = {
    "outer": (1, 1, 1, 1),
    "upper": (1, 0, 0, 0),
    "left": (0, 1, 0, 0),
    "lower": (0, 0, 1, 0),
    "right": (0, 0, 0, 1),
}


def _halo(op: IntConv | Op | None, meant: Compute) -> Iterator[Explanation]:
    """What surrounds a tile is zeros where the planes come in."""
    if op is not None and PLANES not in op.inputs:
        return
    for (side, ends), width in product(SIDES.items(), range(1, HALO_MAX_PX + 1)):

        def compute(tensors: Tensors, pads: list[int] = [width * end for end in ends]) -> np.ndarray:  # noqa: B006
            bare = np.zeros_like(tensors[PLANES])
            height, across = bare.shape[2:]
            inside = ..., slice(pads[0], height - pads[2]), slice(pads[1], across - pads[3])
            bare[inside] = tensors[PLANES][inside]
            return meant({**tensors, PLANES: bare})

        words = f"the {side} {width} px of the planes are zeros instead of the tile's surroundings"
        yield Explanation(words, compute)


def _order(meant: Compute, right: np.ndarray, seen: np.ndarray) -> Iterator[Explanation]:
    """Channels that stand in another order, or axes that changed places."""
    of = [_channel_like(right, seen[:, k], k) for k in range(seen.shape[1])]
    if None not in of:
        words = ", ".join(f"{source} at {k}" for k, source in enumerate(of) if source != k)
        sources = np.array(of)
        yield Explanation(f"channels stand in another order: {words}", lambda tensors: meant(tensors)[:, sources])
    yield Explanation("rows and columns changed places", lambda tensors: meant(tensors).swapaxes(2, 3))
    yield Explanation(
        "the tensor is written with its channels last and read as if they came first",
        lambda tensors: np.moveaxis(meant(tensors), 1, -1).reshape(meant(tensors).shape),
    )


def _channel_like(right: np.ndarray, channel: np.ndarray, place: int) -> int | None:
    """The number of the channel of `right` (N, C, H, W) that is the same as one (N, H, W); `place` where it is."""
    same = (right == channel[:, None]).all((0, 2, 3))
    return place if same[place] else int(same.argmax()) if same.any() else None


def _places(meant: Compute) -> Iterator[Explanation]:
    """Pixels that lie beside their places."""
    for down, across in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (2, 0), (-2, 0), (0, 2), (0, -2)):

        def compute(tensors: Tensors, by: tuple[int, int] = (down, across)) -> np.ndarray:
            return np.roll(meant(tensors), by, (2, 3))

        words = " and ".join(f"{n} {axis}" for n, axis in ((down, "px down"), (across, "px to the right")) if n)
        yield Explanation(f"the tile is shifted by {words}", compute, inside=True)


MOST_CHANNELS = 4
"""That are looked through for a wrong weight or bias: a fault in one number shows in one channel."""


def _numbers(core: IntCore, op: IntConv, worst: Seen, half_even: bool) -> Iterator[Explanation]:
    """One bit of one bias or one weight that is not what it should be."""
    channels = (worst.seen != worst.tensors[op.output]).any((0, 2, 3)).nonzero()[0]
    if len(channels) > MOST_CHANNELS:
        return
    for channel in channels:
        for bit in range(8):
            bias = _flipped(op.bias, (int(channel),), bit)
            words = f"bit {bit} of the bias of channel {channel} is flipped"
            yield Explanation(words, sound(core, replace(op, bias=bias), half_even))
        for place in _likely_weights(op, int(channel), worst):
            for bit in range(8):
                weight = _flipped(op.weight, place, bit)
                words = f"bit {bit} of weight {list(place)} is flipped"
                yield Explanation(words, sound(core, replace(op, weight=weight), half_even))


def _flipped(values: np.ndarray, place: tuple[int, ...], bit: int) -> np.ndarray:
    changed = values.copy()
    changed.view(np.uint8)[place] ^= np.uint8(1 << bit)
    return changed


LIKELY = 12


def _likely_weights(op: IntConv, channel: int, worst: Seen) -> list[tuple[int, ...]]:
    """The weights of a channel with whose inputs the differences go up and down most."""
    difference = (worst.seen - worst.tensors[op.output])[:, channel].astype(np.float64).ravel()
    alike: dict[tuple[int, ...], float] = {}
    row = channel if op.groups > 1 else 0  # of the kernels that are computed
    for place in np.ndindex(*op.weight.shape[1:]):
        alone = np.zeros((len(op.weight) if op.groups > 1 else 1, *op.weight.shape[1:]), np.int8)
        alone[(row, *place)] = 1
        read = convolve(worst.tensors[op.input], alone, op.window, op.groups, op.transposed)[:, row]
        values = read.astype(np.float64).ravel()
        alike[(channel, *place)] = abs(float(difference @ values)) / (float(np.linalg.norm(values)) or 1.0)
    return sorted(alike, key=lambda place: -alike[place])[:LIKELY]


def where(seen: np.ndarray, meant: np.ndarray) -> str:
    """Where in tiles (N, C, H, W) results differ: in a channel, along the border, in some rows, or everywhere."""
    differing = seen != meant
    channels, rows, columns = (differing.any(axes).nonzero()[0] for axes in ((0, 2, 3), (0, 1, 3), (0, 1, 2)))
    height, width = seen.shape[2:]
    within = "" if len(channels) > 1 or seen.shape[1] == 1 else f" of channel {channels[0]}"
    at = np.argwhere(differing.any((0, 1)))
    reach = int(np.minimum(at, np.array([height - 1, width - 1]) - at).min(1).max()) + 1
    if reach < min(height, width) // 4:
        return f"within {reach} px of the border{within}"
    for name, found, size in (("row", rows, height), ("column", columns, width)):
        if len(found) <= size // 4:
            return f"in {name}s {found[0]} to {found[-1]}{within}"
    return f"everywhere{within}" if within else f"everywhere, in {len(channels)} of {seen.shape[1]} channels"


def _between(core: IntCore, ops: Sequence[IntConv | Op], half_even: bool) -> Iterator[Explanation]:
    """Faults of what came before a layer: of a rule in all layers or in one kind of them, in one layer, or ahead."""
    meant = {op.output: sound(core, op, half_even) for op in ops}
    faults = {op.output: {each.words: each.compute for each in rule_faults(core, op, half_even)} for op in ops}

    def through(wrong: Mapping[str, Compute]) -> Compute:
        def compute(tensors: Tensors) -> np.ndarray:
            made = dict(tensors)
            for op in ops:
                made[op.output] = wrong.get(op.output, meant[op.output])(made)
            return made[ops[-1].output]

        return compute

    for place, chosen in _places_of(ops):
        for words in dict.fromkeys(words for op in chosen for words in faults[op.output]):
            wrong = {op.output: faults[op.output][words] for op in chosen if words in faults[op.output]}
            yield Explanation(f"{words}, in {place}", through(wrong))
    if any(PLANES in op.inputs for op in ops):
        yield from _halo(None, through({}))
        yield from _places(through({}))


def _places_of(ops: Sequence[IntConv | Op]) -> Iterator[tuple[str, Sequence[IntConv | Op]]]:
    """Where a fault of a rule may be: in all layers, in all of a kind, in one."""
    yield "every layer", ops
    for kind in dict.fromkeys(map(_kind, ops)):
        yield f"every {kind}", [op for op in ops if _kind(op) == kind]
    yield from ((op.name, [op]) for op in ops)


def _kind(op: IntConv | Op) -> str:
    return "convolution" if isinstance(op, IntConv) else type(op).__name__
