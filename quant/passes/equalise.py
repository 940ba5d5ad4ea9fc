"""Scale the channels of the residual stream so that one scale suits them all, at no cost in the
network.

Whatever writes the stream has its weights multiplied by k per channel, whatever reads it has them
divided: the float network stays the same, to rounding. A channel that uses a fraction of int8's
range is rounded finer for a larger k, one that overflows is clipped less for a smaller. The first
guess levels the ranges, k ~ range^-gamma; then each channel is tried larger and smaller on
calibration patches, because what counts is what a channel's rounding does to the output.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.quant.core import INT8_MAX
from beers_deploy.quant.graph import Activation, Conv, Graph
from beers_deploy.quant.host_part import ONE_CHANNEL, HostPart
from beers_deploy.quant.passes.stream import STREAM_FRAC_BITS, Stream
from beers_deploy.quant.session import values_of

QUANTILE = 0.9999
"""A channel's range: the mean over tiles of this quantile of its sizes.

The maximum would be ruled by outliers.
"""

LEVELLING = (0.5, 0.75, 1.0)
HEADROOM = (0.64, 0.8, 1.0, 1.25)
"""First guesses tried: gamma, and the largest range as a share of int8's.

Above 1 the largest values are clipped.
"""

FULL = INT8_MAX * 2.0**-STREAM_FRAC_BITS
"""Where int8 ends in tensors that are equalised."""

STEPS = (1.5, 1.2)
"""Factors by which each channel is tried larger and smaller, a sweep each."""

MOST_CHANNELS = 256
"""More are not tried one by one: each costs four runs of all crops at most, hours in a wide
network.
"""

FIRST_CROPS = 2
MARGIN = 0.003
"""A trial is given up once the crops that it was tried on cost that share more than with the best
factors so far.

Each look doubles the crops. Some 30 % of the runs remain.
"""

Costs = Callable[[np.ndarray | None], np.ndarray]
"""What one graph costs in INT8 on the crops of given numbers, or on all of them: an error each."""

Trial = Callable[[Graph], Costs]


def equalise(graph: Graph, stream: Stream, factors: np.ndarray) -> Graph:
    """The same network with channel c of a stream scaled by factors[c], (C,) above 0.

    A channel behind ReLU6 is scaled until it can fill int8: the end of int8 is its clip then, and
    ReLU does.
    """
    factors = np.array(factors, np.float64)
    for op in graph:
        if isinstance(op, Conv) and op.output in stream and op.activation is Activation.relu6:
            part = stream[op.output]
            # Below this factor int8 would end beyond the six, and ReLU could not stand for ReLU6.
            factors[part] = np.maximum(factors[part], FULL / op.ceilings)
    return rescaled(graph, stream, factors)


def rescaled(graph: Graph, stream: Stream, factors: np.ndarray) -> Graph:
    """The same network with channel c of a stream scaled by factors[c], and of a ReLU6 there the
    six.
    """
    return tuple(_scaled(op, factors, stream) if isinstance(op, Conv) else op for op in graph)


def _scaled(op: Conv, factors: np.ndarray, stream: Stream) -> Conv:
    weight = op.weight.astype(np.float64)
    bias = op.bias.astype(np.float64)
    ceiling = op.ceiling
    if op.output in stream:
        scales = factors[stream[op.output]]
        weight = weight * scales[:, None, None, None]
        bias = bias * scales
        # ReLU passes a positive factor on; the six of ReLU6 has to be scaled with its channel.
        ceiling = op.ceilings * scales if op.activation is Activation.relu6 else None
    if op.input in stream:
        scales = factors[stream[op.input]]
        # A depthwise kernel reads the channel that it writes, and has no axis of inputs.
        if op.groups == 1:
            weight = weight / scales[None, :, None, None]
        else:
            weight = weight / scales[:, None, None, None]
    return replace(
        op, weight=weight.astype(np.float32), bias=bias.astype(np.float32), ceiling=ceiling
    )


def channel_ranges(
    graph: Graph, stream: Stream, images: Iterable[np.ndarray], host_part: HostPart = ONE_CHANNEL
) -> np.ndarray:
    """(C,) range of each stream channel over images (1, C', H, W), the widest of all the stream's
    tensors.
    """
    names = sorted(stream)
    tiles = channel_sizes(graph, names, images, host_part)
    means = {
        name: np.mean(sizes, axis=0)
        for name, sizes in zip(names, zip(*tiles, strict=True), strict=True)
    }
    ranges = np.zeros(max(stream[name].stop or len(mean) for name, mean in means.items()))
    # Tensors of a stream share their factors, so a channel's range is its widest in any of them.
    for name, mean in means.items():
        ranges[stream[name]] = np.maximum(ranges[stream[name]], mean)
    return above_dead(ranges)


def channel_sizes(
    graph: Graph,
    names: list[str],
    images: Iterable[np.ndarray],
    host_part: HostPart = ONE_CHANNEL,
    quantile: float = QUANTILE,
) -> Iterator[list[np.ndarray]]:
    """A quantile of each channel's sizes, (C,) of each of the named tensors, for every tile of the
    images.
    """
    for results in values_of(graph, names, images, host_part):
        sizes = [np.abs(r[0]).reshape(r.shape[1], -1) for r in results]
        yield [np.quantile(size, quantile, axis=1).astype(np.float64) for size in sizes]


def largest_sizes(
    graph: Graph,
    names: list[str],
    images: Iterable[np.ndarray],
    host_part: HostPart,
    quantile: float = 1.0,
) -> list[np.ndarray]:
    """As `channel_sizes`, of the tile where each channel is largest."""
    return [
        np.max(sizes, axis=0)
        for sizes in zip(*channel_sizes(graph, names, images, host_part, quantile), strict=True)
    ]


def above_dead(ranges: np.ndarray) -> np.ndarray:
    """Ranges (C,) of which none is next to nothing: a dead channel must not be blown up."""
    return np.asarray(np.maximum(ranges, 1e-3 * float(ranges.max()) + 1e-12))


def first_guess(ranges: np.ndarray, levelling: float, headroom: float) -> np.ndarray:
    """Factors that level the ranges, and fit the largest into int8 at the stream's scale."""
    factors = (ranges.max() / ranges) ** levelling
    return np.asarray(factors * headroom * FULL / (ranges * factors).max())


def search(graph: Graph, stream: Stream, ranges: np.ndarray, trial: Trial) -> np.ndarray:
    """The factors of least error: the best first guess, then channel by channel."""

    def costs_of(factors: np.ndarray) -> Costs:
        return trial(equalise(graph, stream, factors))

    first, *others = (first_guess(ranges, *shape) for shape in product(LEVELLING, HEADROOM))
    # Without factors to compare with, the first guess has to be run on all crops.
    best = Best(first, costs_of(first)(None))
    with steps("first guesses", len(others)) as bar:
        for guess in others:
            best = race(costs_of(guess), guess, best)
            bar.advance()
    # One channel after the other takes hours in a wide network.
    channels = range(len(ranges)) if len(ranges) <= MOST_CHANNELS else ()
    return stepped(costs_of, channels, best).factors


def stepped(
    costs_of: Callable[[np.ndarray], Costs], channels: Iterable[int], best: "Best"
) -> "Best":
    """The best factors once each of these channels has been tried larger and smaller."""
    trials = list(product(STEPS, channels))
    with steps("channels", len(trials)) as bar:
        for size, channel in trials:
            for factor in (size, 1 / size):
                candidate = best.factors.copy()
                candidate[channel] *= factor
                winner = race(costs_of(candidate), candidate, best)
                if winner is not best:
                    best = winner
                    # The inverse factor would lead back to where the channel came from.
                    break
            bar.advance()
    return best


@dataclass(frozen=True)
class Best:
    """The best factors so far, (C,), and what they cost on each crop, (N,)."""

    factors: np.ndarray
    costs: np.ndarray


def race(costs_of: Costs, factors: np.ndarray, best: Best) -> Best:
    """The better of two, the costliest crops first: six of seven trials fail, and most of them show
    it on two.
    """
    order = np.argsort(-best.costs, kind="stable")
    costs = np.zeros(len(order))
    count = 0
    while count < len(order):
        crops = order[count : max(2 * count, FIRST_CROPS)]
        costs[crops] = costs_of(crops)
        count += len(crops)
        # Crops not yet run may make up for a little; once all have, only a lower cost wins.
        margin = MARGIN if count < len(order) else 0.0
        if costs.sum() >= best.costs[order[:count]].sum() * (1 + margin):
            return best
    return Best(factors, costs)
