"""Level the channels of tensors between two convolutions, one tensor after the other, at no cost in the network.

Between two convolutions each channel may be scaled by a factor of its own, as `quant.passes.equalise` does with a
stream: then one scale suits all channels, and because a factor is any number, the tensor's own scale and that of the
weights that read it are no longer bound to powers of two. Where there is a stream it is what counts, and levelling
the rest too made no network of dense convolutions better that is made for one sensor. Those with depthwise ones it
does, and those behind a bank: one file serves sensors of little noise and of much, and what lies inside a block is
then small in most channels.

All tensors are levelled together first, for what the worst of them errs hides the others; then one after the other
from the last, for what is rounded late reaches the result.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from beers_deploy.quant.ends import ONE_CHANNEL, Ends
from beers_deploy.quant.graph import Conv, Graph
from beers_deploy.quant.passes.equalise import (
    MOST_CHANNELS,
    QUANTILE,
    Best,
    Costs,
    Trial,
    above_dead,
    channel_sizes,
    equalise,
    first_guess,
    stepped,
)
from beers_deploy.quant.passes.stream import STREAM_FRAC_BITS, only

LEVELLING = (0.0, 0.25, 0.5, 1.0)
HEADROOM = (0.8, 1.0, 1.25, 1.6, 2.2)
"""First guesses tried, as in `quant.passes.equalise`; a range here is the largest of all tiles, so more may be
clipped."""
FEW_TENSORS = 4
"""Of a chain beside a stream, to be tried one by one."""

EVERY, CLEARLY = 8, 1.1
"""A guess is tried on one of so many crops first, and dropped where it costs so much more there."""


@dataclass(frozen=True)
class Channels:
    """What is known of channels (C,): the range of their values, and the largest of the weights that write each."""

    ranges: np.ndarray
    weights: np.ndarray

    def guess(self, levelling: float, headroom: float) -> np.ndarray:
        """Factors (C,) that level the ranges, but let no weak channel's weights outgrow those of the stronger half.

        A channel that is hardly ever on would else be blown up until its weights ruled the scale of all.
        """
        factors = first_guess(self.ranges, levelling, headroom)
        strong = self.ranges >= np.median(self.ranges)
        limit = (self.weights * factors)[strong].max()
        return np.asarray(np.minimum(factors, limit / np.maximum(self.weights, 1e-12)))


@dataclass(frozen=True)
class Chain:
    """Tensors that may be levelled, in the graph's order, and how many channels each has.

    Factors and ranges of all of them are one array (sum of the channels,), tensor behind tensor. Beside a stream
    `by_channel` is off: trying each channel buys nothing there, nor each tensor of a deep network.
    """

    tensors: tuple[str, ...]
    widths: tuple[int, ...]
    by_channel: bool = True

    @property
    def parts(self) -> list[slice]:
        """Where each tensor's channels stand."""
        ends = np.cumsum([0, *self.widths]).tolist()
        return [slice(first, end) for first, end in pairwise(ends)]

    @property
    def stepped(self) -> bool:
        """Whether each channel is tried: where that is wanted, and there are few enough."""
        return self.by_channel and sum(self.widths) <= MOST_CHANNELS

    @property
    def one_by_one(self) -> bool:
        """Whether each tensor is tried, once all were together."""
        return self.by_channel or len(self.tensors) <= FEW_TENSORS

    def scaled(self, graph: Graph, factors: np.ndarray) -> Graph:
        """The same network with each channel scaled by its factor."""
        for name, part in zip(self.tensors, self.parts, strict=True):
            graph = equalise(graph, only(name), factors[part])
        return graph

    def unscaled(self, frac_bits: Mapping[str, int]) -> np.ndarray:
        """The factors that leave every tensor the scale that it has by itself."""
        own = [2.0 ** (frac_bits[name] - STREAM_FRAC_BITS) for name in self.tensors]
        return np.repeat(own, self.widths)


def chain_ranges(
    graph: Graph, chain: Chain, images: Iterable[np.ndarray], ends: Ends = ONE_CHANNEL, quantile: float = QUANTILE
) -> np.ndarray:
    """The range of every channel over images (1, C, H, W), that of the tile where it is widest."""
    widest = [np.zeros(width) for width in chain.widths]
    for sizes in channel_sizes(graph, list(chain.tensors), images, ends, quantile):
        widest = [np.maximum(most, size) for most, size in zip(widest, sizes, strict=True)]
    return np.concatenate([above_dead(ranges) for ranges in widest])


def level(graph: Graph, chain: Chain, ranges: np.ndarray, start: np.ndarray, trial: Trial) -> np.ndarray:
    """The factors of least error that were found, never more than that of `start`."""
    written = {op.output: np.abs(op.weight).max((1, 2, 3)) for op in graph if isinstance(op, Conv)}
    known = [Channels(ranges[part], written[name]) for name, part in zip(chain.tensors, chain.parts, strict=True)]

    def costs_of(factors: np.ndarray) -> Costs:
        return trial(chain.scaled(graph, factors))

    def guessed(best: Best, own: list[tuple[Channels, slice]]) -> Best:
        """The best of the first guesses for these tensors, the others as they are."""
        for shape in product(LEVELLING, HEADROOM):
            tried = best.factors.copy()
            for channels, part in own:
                tried[part] = channels.guess(*shape)
            best = _better(tried, costs_of, best)
        return best

    placed = list(zip(known, chain.parts, strict=True))
    best = guessed(Best(start, costs_of(start)(None)), placed)
    for channels, part in reversed(placed) if chain.one_by_one else ():
        best = guessed(best, [(channels, part)])
        if chain.stepped:
            best = stepped(costs_of, range(part.start, part.stop), best)
    return best.factors


def _better(factors: np.ndarray, costs_of: Callable[[np.ndarray], Costs], best: Best) -> Best:
    """The better of two on all crops: so large a step may cost the hardest ones and be worth it.

    Given up where every eighth of the crops says that it is clearly worse.
    """
    cost, some = costs_of(factors), np.arange(0, len(best.costs), EVERY)
    if cost(some).sum() > CLEARLY * best.costs[some].sum():
        return best
    costs = cost(None)
    return Best(factors, costs) if costs.sum() < best.costs.sum() else best
