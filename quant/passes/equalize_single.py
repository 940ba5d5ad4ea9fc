"""Equalise the channels of single tensors, which only convolutions write and read, without changing
the float network.

Each channel may be scaled by a factor of its own, as in `quant.passes.equalize`. A factor is any
number, so the scale of the tensor, and that of the weights that read it, are no longer bound to
powers of two.

1. Take as a channel's range the one that most tiles stay within.
2. Guess k = range^-gamma, but do not let the weights of a weak channel exceed those of the stronger
   half, because the weights that write a tensor share one scale.
3. Try the guesses on all tensors jointly, because the error of the worst tensor hides the gain of
   the others.
4. Try them on one tensor after the other, from the last, because late roundings reach the result
   directly. Then try its channels larger and smaller, separately or in groups.

Next to a residual group of dense convolutions only the guesses of 3 are tried, and those of 4 if
there are few tensors, and the result is used only if it is clearly better: in a small MemNet, whose
blocks begin with a normalisation, INT8 then lost 0.17 instead of 1.75 dB (measured). Files for many
sensors get the same guesses: these have little noise or much, so that tensors inside a block are
small in most channels. With depthwise convolutions everything is tried.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.quant.graph import Conv, Graph
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.passes.effort import MOST_GROUPS, Effort, Stage, channel_groups
from beers_deploy.quant.passes.equalize import (
    QUANTILE,
    Best,
    above_dead,
    channel_sizes,
    equalize,
    first_guess,
    stepped,
)
from beers_deploy.quant.passes.residual_groups import GROUP_FRAC_BITS, only
from beers_deploy.quant.passes.trial import Costs, Trials

GAMMAS = (0.0, 0.25, 0.5, 1.0)
HEADROOM = (0.5, 0.75, 1.0, 1.4)
"""Candidates of the first guess, as in `quant.passes.equalize`; at 0.5 twice the range still
fits.
"""
TILE_QUANTILE = 0.85
"""The range of a channel is this quantile over the tiles.

The widest tile would determine the step of all others: with the brightest ground among the patches,
a DnCNN lost 1.4 dB instead of 0.6 (measured on photographs).
"""
FEW_TENSORS = 4
"""The number of tensors of a deep network with a residual group that are tried one by one."""

SUBSET_STEP = 8
CLEAR_FACTOR = 1.1
"""A guess is first tried on every SUBSET_STEP-th crop, and rejected if its error there is larger by
the factor CLEAR_FACTOR.
"""


@dataclass(frozen=True)
class SingleTensors:
    """Tensors that only convolutions write and read, so that each may be equalised by itself.

    They are no members of a residual group. Factors and ranges of all of them are stored in one
    array (sum of the channels,), one tensor behind the other.

    Attributes:
        tensors: the names of the tensors, in the order of the graph.
        widths: the number of channels of each tensor.
        by_channel: True if the search also tries larger and smaller factors for groups of channels.
    """

    tensors: tuple[str, ...]
    widths: tuple[int, ...]
    by_channel: bool = True

    @property
    def parts(self) -> dict[str, slice]:
        """The slice of each tensor's channels in the arrays of factors and ranges, by the tensor's
        name.
        """
        ends = np.cumsum([0, *self.widths]).tolist()
        return dict(zip(self.tensors, map(slice, ends, ends[1:]), strict=True))

    def tried_alone(self, most_groups: int) -> tuple[str, ...]:
        """Return the names of the tensors whose factors are also searched one tensor at a time.

        Args:
            most_groups: the maximum number of groups into which the channels of one tensor are
                divided; with 0 no tensor is tried alone.
        """
        few = self.by_channel or len(self.tensors) <= FEW_TENSORS
        return self.tensors if few and most_groups else ()

    def guesses_alone(self, effort: Effort) -> bool:
        """Return True if the first guesses are also tried on one tensor at a time, not only on all
        jointly.

        Where groups of channels are tried, this gained nothing (measured).
        """
        return not self.by_channel or effort is Effort.best

    def stages(self, effort: Effort) -> list[Stage]:
        """Return the separate searches for factors: one of all tensors jointly, then one for each
        tensor tried alone.

        Args:
            effort: the effort that the user allows.
        """
        guesses = len(GAMMAS) * len(HEADROOM)
        alone = guesses if self.guesses_alone(effort) else 0
        widths = dict(zip(self.tensors, self.widths, strict=True))
        return [
            Stage(self.tensors, 1 + guesses),
            *(
                Stage([name], alone, widths[name] if self.by_channel else 0)
                for name in self.tried_alone(MOST_GROUPS[effort])
            ),
        ]

    def scaled(self, graph: Graph, factors: np.ndarray, names: Sequence[str] = ()) -> Graph:
        """Scale channels by their factors, without changing the function of the float network.

        Args:
            graph: the float graph to which the tensors belong.
            factors: (sum of the channels,) the factors, above 0.
            names: the tensors to scale; empty for all.
        """
        parts = self.parts
        for name in names or self.tensors:
            own = factors[parts[name]]
            graph = equalize(graph, only(name, len(own)), own)
        return graph

    def unscaled(self, frac_bits: Mapping[str, int]) -> np.ndarray:
        """Return the factors with which int8 covers the same range of each tensor as at the
        tensor's own scale.

        In the core all equalised tensors have GROUP_FRAC_BITS fractional bits, so a power of two
        makes up for the difference.

        Args:
            frac_bits: the number of fractional bits of each tensor's own scale, by its name.

        Returns:
            (sum of the channels,) powers of two.
        """
        # In the core these tensors have the groups' scale, so the factor stands for their own.
        scales = [2.0 ** (frac_bits[name] - GROUP_FRAC_BITS) for name in self.tensors]
        return np.repeat(scales, self.widths)


def single_ranges(
    graph: Graph,
    singles: SingleTensors,
    images: Iterable[np.ndarray],
    host_part: HostPart,
    quantile: float = QUANTILE,
    tile_quantile: float = TILE_QUANTILE,
) -> np.ndarray:
    """Measure the range of every channel of the tensors: the one that most tiles of the images stay
    within.

    Args:
        graph: the float graph to which the tensors belong. It reads the int8 planes that an image
            is split into.
        singles: the tensors.
        images: calibration images (1, C, H, W), which are cut to tiles.
        host_part: the host's pre- and post-processing around the graph.
        quantile: the quantile of a channel's absolute values that is its range in one tile; 1 means
            the largest value.
        tile_quantile: the quantile of these ranges over the tiles.

    Returns:
        (sum of the channels,) the ranges, in the tensors' unit.
    """
    sizes = channel_sizes(graph, list(singles.tensors), images, host_part, quantile)
    by_tensor = zip(*sizes, strict=True)
    return np.concatenate(
        [above_dead(np.quantile(each, tile_quantile, axis=0)) for each in by_tensor]
    )


def equalize_single(
    graph: Graph,
    singles: SingleTensors,
    ranges: np.ndarray,
    trials: Trials,
    effort: Effort,
    most_groups: int,
) -> np.ndarray:
    """Search the factors of all channels with which the error of the INT8 network is least.

    Args:
        graph: the float graph to which the tensors belong.
        singles: the tensors whose channels are scaled.
        ranges: (sum of the channels,) the ranges of the channels.
        trials: measures the error of candidate graphs in INT8 on crops.
        effort: the effort that the user allows.
        most_groups: the maximum number of groups of channels in a tensor, each of which is tried
            larger and smaller; 0 tries only the guesses for all tensors jointly.

    Returns:
        (sum of the channels,) the best factors; 1 for all if nothing is better.
    """
    weights_of = {
        op.output: np.abs(op.weight).max((1, 2, 3)) for op in graph if isinstance(op, Conv)
    }
    parts = singles.parts

    def guessed(best: Best, names: Sequence[str], costs_of: Callable[[np.ndarray], Costs]) -> Best:
        """Return the best of the first guesses for these tensors, with the factors of the others
        unchanged.
        """
        shapes = list(product(GAMMAS, HEADROOM))
        with steps("first guesses", len(shapes)) as bar:
            for shape in shapes:
                candidate = best.factors.copy()
                for name in names:
                    part = parts[name]
                    # A convolution may have no weights but zeros.
                    weights = np.maximum(weights_of[name], 1e-12)
                    factors = first_guess(ranges[part], *shape)
                    # 2. The weights that write a tensor share one scale, which the largest of them
                    # sets. A channel that is rarely active would otherwise be amplified until its
                    # weights determined the scale of all.
                    stronger = ranges[part] >= np.median(ranges[part])
                    limit = (weights * factors)[stronger].max()
                    candidate[part] = np.minimum(factors, limit / weights)
                best = _better(candidate, costs_of, best)
                bar.advance()
        return best

    def costs_in(base: Graph, names: Sequence[str]) -> Callable[[np.ndarray], Costs]:
        """Return a function for the error with factors of these tensors in a graph."""
        trial = trials(base, names)
        return lambda factors: trial(singles.scaled(base, factors, names))

    # 3.
    costs_of = costs_in(graph, singles.tensors)
    start = np.ones(len(ranges))
    best = guessed(Best(start, costs_of(start)(None)), singles.tensors, costs_of)
    alone = singles.tried_alone(most_groups)
    with steps("tensors", len(alone)) as bar:
        # 4.
        for name in reversed(alone):
            part = parts[name]
            others = best.factors.copy()
            others[part] = 1.0
            costs_of = costs_in(singles.scaled(graph, others), [name])
            if singles.guesses_alone(effort):
                best = guessed(best, [name], costs_of)
            if singles.by_channel:
                groups = channel_groups(ranges[part], most_groups)
                best = stepped(costs_of, [group + part.start for group in groups], best)
            bar.advance()
    return best.factors


def _better(factors: np.ndarray, costs_of: Callable[[np.ndarray], Costs], best: Best) -> Best:
    """Return the better of two candidates on all crops.

    A step this large may be worth its cost even if the hardest crops get worse.
    """
    cost = costs_of(factors)
    # A few crops show which guesses are clearly worse.
    some = np.arange(0, len(best.costs), SUBSET_STEP)
    if cost(some).sum() > CLEAR_FACTOR * best.costs[some].sum():
        return best
    costs = cost(None)
    return Best(factors, costs) if costs.sum() < best.costs.sum() else best
