"""Level the channels of tensors between two convolutions, one tensor after the other, at no cost in
the network.

Between two convolutions each channel may be scaled by a factor of its own, as
`quant.passes.equalise` does with a stream: then one scale suits all channels, and because a factor
is any number, the tensor's own scale and that of the weights that read it are no longer bound to
powers of two. Where there is a stream it is what counts, and levelling the rest too made no network
of dense convolutions better that is made for one sensor. Those with depthwise ones it does, and
those behind a bank: one file serves sensors of little noise and of much, and what lies inside a
block is then small in most channels.

All tensors are levelled together first, for what the worst of them errs hides the others; then one
after the other from the last, for what is rounded late reaches the result.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.quant.graph import Conv, Graph
from beers_deploy.quant.host_part import HostPart
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
    largest_sizes,
    stepped,
)
from beers_deploy.quant.passes.stream import STREAM_FRAC_BITS, only

LEVELLING = (0.0, 0.25, 0.5, 1.0)
HEADROOM = (0.5, 0.75, 1.0, 1.4)
"""First guesses tried, as in `quant.passes.equalise`; at 0.5 twice the range still fits."""
TILES = 0.85
"""A channel's range is this quantile over the tiles.

The widest tile would set the step of all others: with the brightest ground among the patches, a
DnCNN lost 1.4 dB by it instead of 0.6 (measured on photographs).
"""
FEW_TENSORS = 4
"""Of a chain beside a stream, to be tried one by one."""

EVERY = 8
CLEARLY = 1.1
"""A guess is tried on one of so many crops first, and dropped where it costs so much more there."""


def _guess(
    ranges: np.ndarray, weights: np.ndarray, levelling: float, headroom: float
) -> np.ndarray:
    """Factors (C,) that level the ranges, but let no weak channel's weights outgrow those of the
    stronger half.

    A channel that is hardly ever on would else be blown up until its weights, `weights` the largest
    of those that write each, ruled the scale of all.
    """
    factors = first_guess(ranges, levelling, headroom)
    # The weights that write a tensor share one scale, which the largest of them sets.
    limit = (weights * factors)[ranges >= np.median(ranges)].max()
    return np.asarray(np.minimum(factors, limit / np.maximum(weights, 1e-12)))


@dataclass(frozen=True)
class Chain:
    """Tensors that may be levelled, in the graph's order, and how many channels each has.

    Factors and ranges of all of them are one array (sum of the channels,), tensor behind tensor.
    Beside a stream `by_channel` is off: trying each channel buys nothing there, nor each tensor of
    a deep network.
    """

    tensors: tuple[str, ...]
    widths: tuple[int, ...]
    by_channel: bool = True

    @property
    def parts(self) -> dict[str, slice]:
        """Where each tensor's channels stand."""
        ends = np.cumsum([0, *self.widths]).tolist()
        return dict(zip(self.tensors, map(slice, ends, ends[1:]), strict=True))

    def scaled(self, graph: Graph, factors: np.ndarray) -> Graph:
        """The same network with each channel scaled by its factor."""
        for name, part in self.parts.items():
            graph = equalise(graph, only(name), factors[part])
        return graph

    def unscaled(self, frac_bits: Mapping[str, int]) -> np.ndarray:
        """The factors that leave every tensor the scale that it has by itself."""
        # In the core these tensors have the stream's scale, so the factor stands for their own.
        scales = [2.0 ** (frac_bits[name] - STREAM_FRAC_BITS) for name in self.tensors]
        return np.repeat(scales, self.widths)


def chain_ranges(
    graph: Graph,
    chain: Chain,
    images: Iterable[np.ndarray],
    host_part: HostPart,
    quantile: float = QUANTILE,
) -> np.ndarray:
    """Return the range of every channel over images (1, C, H, W), which most tiles keep."""
    tiles = channel_sizes(graph, list(chain.tensors), images, host_part, quantile)
    by_tensor = zip(*tiles, strict=True)
    # The widest tile would cost a DnCNN 1.4 dB instead of 0.6: see TILES.
    return np.concatenate([above_dead(np.quantile(sizes, TILES, axis=0)) for sizes in by_tensor])


def largest_values(
    graph: Graph, chain: Chain, images: Iterable[np.ndarray], host_part: HostPart
) -> np.ndarray:
    """Return the largest size of every channel over images (1, C, H, W)."""
    sizes = largest_sizes(graph, list(chain.tensors), images, host_part)
    return np.concatenate(list(map(above_dead, sizes)))


def level(
    graph: Graph, chain: Chain, ranges: np.ndarray, start: np.ndarray, trial: Trial
) -> np.ndarray:
    """The factors of least error that were found, never more than that of `start`."""
    weights_of = {
        op.output: np.abs(op.weight).max((1, 2, 3)) for op in graph if isinstance(op, Conv)
    }
    tensors = [(part, ranges[part], weights_of[name]) for name, part in chain.parts.items()]

    def costs_of(factors: np.ndarray) -> Costs:
        return trial(chain.scaled(graph, factors))

    def guessed(best: Best, group: list[tuple[slice, np.ndarray, np.ndarray]]) -> Best:
        """The best of the first guesses for these tensors, the others as they are."""
        for shape in product(LEVELLING, HEADROOM):
            candidate = best.factors.copy()
            for part, sizes, weights in group:
                candidate[part] = _guess(sizes, weights, *shape)
            best = _better(candidate, costs_of, best)
        return best

    # All jointly first: the error of the worst tensor would hide what the others gain.
    best = guessed(Best(start, costs_of(start)(None)), tensors)
    separately = chain.by_channel or len(tensors) <= FEW_TENSORS
    if not separately:
        return best.factors
    with steps("tensors", len(tensors)) as bar:
        # From the last one on, because what is rounded late reaches the result.
        for tensor in reversed(tensors):
            best = guessed(best, [tensor])
            if chain.by_channel and len(ranges) <= MOST_CHANNELS:
                best = stepped(costs_of, range(tensor[0].start, tensor[0].stop), best)
            bar.advance()
    return best.factors


def _better(factors: np.ndarray, costs_of: Callable[[np.ndarray], Costs], best: Best) -> Best:
    """The better of two on all crops: so large a step may cost the hardest ones and be worth it.

    Given up where every eighth of the crops says that it is clearly worse.
    """
    cost = costs_of(factors)
    # An eighth of the runs shows which guesses are clearly worse.
    some = np.arange(0, len(best.costs), EVERY)
    if cost(some).sum() > CLEARLY * best.costs[some].sum():
        return best
    costs = cost(None)
    return Best(factors, costs) if costs.sum() < best.costs.sum() else best
