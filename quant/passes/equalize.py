"""Equalise the channels of a residual group, so that one scale suits them all, without changing the
float network.

1. Multiply the weights that write channel c of the group by k_c, and divide those that read it: the
   float network remains the same, to rounding. A channel that uses a fraction of int8's range is
   rounded more finely for a larger k, and one that overflows is clipped less for a smaller k.
2. Behind ReLU6 increase k until int8 ends at the six, so that its clip replaces that of ReLU6.
3. Guess k = range^-gamma for a few gammas, and a few shares of int8's range for the widest channel.
4. Try channels larger and smaller on crops of calibration images, because the effect of a channel's
   rounding on the output counts. Channels are tried separately, or in groups of similar range. A
   trial that is worse on the costliest crops is rejected.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.quant.frac_bits import INT8_MAX
from beers_deploy.quant.graph import Activation, Conv, Graph
from beers_deploy.quant.host_part import ONE_CHANNEL, HostPart
from beers_deploy.quant.passes.residual_groups import (
    GROUP_FRAC_BITS,
    ResidualGroup,
    n_factors,
)
from beers_deploy.quant.passes.trial import Costs, Trial
from beers_deploy.quant.session import values_of

QUANTILE = 0.9999
"""The range of a channel is the mean over tiles of this quantile of its absolute values.

Outliers would determine the maximum.
"""

GAMMAS = (0.5, 0.75, 1.0)
HEADROOM = (0.64, 0.8, 1.0, 1.25)
"""Candidates of the first guess: gamma, and the widest range as a share of int8's.

Above 1 the largest values are clipped.
"""

FIRST_GUESSES = len(GAMMAS) * len(HEADROOM)

FULL = INT8_MAX * 2.0**-GROUP_FRAC_BITS
"""The value at which int8 ends in tensors that are equalised."""

STEPS = (1.5, 1.2)
"""Factors by which each channel is tried larger and smaller, one sweep each."""

FIRST_CROPS = 2
MARGIN = 0.003
"""A trial is rejected once its error on the crops tried so far exceeds that of the best factors by
this share.

Each check doubles the crops. Some 30 % of the runs remain.
"""


def equalize(graph: Graph, group: ResidualGroup, factors: np.ndarray) -> Graph:
    """Scale the channels of a residual group by factors, without changing the function of the float
    network.

    Weights that write a channel are multiplied by its factor, and weights that read it are divided.

    Args:
        graph: the float graph.
        group: the tensors whose channels are scaled.
        factors: (C,) the factor of each channel of the group, above 0. Channels of convolutions
            that are not scalable keep their scale.
    """
    factors = np.array(factors, np.float64)
    for op in graph:
        if not isinstance(op, Conv) or op.output not in group:
            continue
        part = group[op.output]
        if not op.scalable:
            factors[part] = 1.0
        if op.activation is Activation.relu6:
            # 2. Below this factor int8 would end above six, and ReLU could not replace ReLU6.
            np.maximum.at(factors, part, FULL / op.ceilings)
    return tuple(
        _scaled(op, factors, group)
        if isinstance(op, Conv) and group.keys() & {op.input, op.output}
        # It remains the same object, so that it is not rounded again.
        else op
        for op in graph
    )


def _scaled(op: Conv, factors: np.ndarray, group: ResidualGroup) -> Conv:
    """Apply step 1 to a convolution, in float64: a factor and its inverse must cancel."""
    weight = op.weight.astype(np.float64)
    bias = op.bias.astype(np.float64)
    ceiling = op.ceiling
    if op.output in group:
        scales = factors[group[op.output]]
        weight = weight * scales[:, None, None, None]
        bias = bias * scales
        # ReLU passes a positive factor on; the six of ReLU6 has to be scaled with its channel.
        ceiling = op.ceilings * scales if op.activation is Activation.relu6 else None
    if op.input in group:
        scales = factors[group[op.input]]
        # A depthwise kernel reads the channel that it writes, and has no axis of inputs.
        axes = np.s_[None, :] if op.groups == 1 else np.s_[:, None]
        weight = weight / scales[axes][..., None, None]
    return replace(
        op, weight=weight.astype(np.float32), bias=bias.astype(np.float32), ceiling=ceiling
    )


def channel_ranges(
    graph: Graph,
    group: ResidualGroup,
    images: Iterable[np.ndarray],
    host_part: HostPart = ONE_CHANNEL,
) -> np.ndarray:
    """Measure the range of each channel of a group: the largest of all the group's tensors.

    The range of a tensor's channel is the QUANTILE of its absolute values in a tile, as the mean
    over tiles.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.
        group: the tensors of the group.
        images: calibration images (1, C', H, W).
        host_part: the host's pre- and post-processing around the graph.

    Returns:
        (C,) the ranges, in the tensors' unit.
    """
    names = sorted(group)
    tiles = channel_sizes(graph, names, images, host_part)
    means = {
        name: np.mean(sizes, axis=0)
        for name, sizes in zip(names, zip(*tiles, strict=True), strict=True)
    }
    ranges = np.zeros(n_factors(group))
    # Channels that share a factor also share its range, the largest of any of them.
    for name, mean in means.items():
        np.maximum.at(ranges, group[name], mean)
    return above_dead(ranges)


def channel_sizes(
    graph: Graph,
    names: list[str],
    images: Iterable[np.ndarray],
    host_part: HostPart,
    quantile: float = QUANTILE,
) -> Iterator[list[np.ndarray]]:
    """Yield, for every tile of the images, a quantile of the absolute values of each channel.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.
        names: the names of the tensors.
        images: calibration images (1, C', H, W).
        host_part: the host's pre- and post-processing around the graph.
        quantile: the quantile, in [0, 1].

    Yields:
        One array (C,) per tensor, in the order of `names`.
    """
    for results in values_of(graph, names, images, host_part):
        sizes = [np.abs(r[0]).reshape(r.shape[1], -1) for r in results]
        yield [np.quantile(size, quantile, axis=1).astype(np.float64) for size in sizes]


def above_dead(ranges: np.ndarray) -> np.ndarray:
    """Raise ranges that are nearly zero to a minimum, so that channels that are never active are
    not amplified.

    Args:
        ranges: (C,) the ranges of the channels.
    """
    return np.asarray(np.maximum(ranges, 1e-3 * float(ranges.max()) + 1e-12))


def first_guess(ranges: np.ndarray, gamma: float, headroom: float) -> np.ndarray:
    """Return factors that make the ranges of channels more equal, and that fit the widest one into
    int8.

    The factor of a channel is proportional to range^-gamma.

    Args:
        ranges: (C,) the ranges of the channels.
        gamma: the exponent; 0 leaves the ratios of the ranges unchanged, 1 makes all equal.
        headroom: the widest range after scaling, as a share of int8's range. Above 1 the largest
            values are clipped.

    Returns:
        (C,) the factors.
    """
    factors = (ranges.max() / ranges) ** gamma
    return np.asarray(factors * headroom * FULL / (ranges * factors).max())


def search(
    graph: Graph,
    group: ResidualGroup,
    ranges: np.ndarray,
    trial: Trial,
    channels: Sequence[np.ndarray],
) -> np.ndarray:
    """Search the factors of a group's channels with which the INT8 network errs least.

    It tries the first guesses, then larger and smaller factors for each set of channels.

    Args:
        graph: the float graph.
        group: the residual group whose channels are scaled.
        ranges: (C,) the ranges of its channels.
        trial: measures the error of a candidate graph in INT8 on crops.
        channels: sets of channel numbers. The channels of a set are tried with one common factor.

    Returns:
        (C,) the best factors.
    """

    def costs_of(factors: np.ndarray) -> Costs:
        return trial(equalize(graph, group, factors))

    # 3.
    first, *others = (first_guess(ranges, *shape) for shape in product(GAMMAS, HEADROOM))
    # Without factors to compare with, the first guess has to be run on all crops.
    best = Best(first, costs_of(first)(None))
    with steps("first guesses", len(others)) as bar:
        for guess in others:
            best = race(costs_of(guess), guess, best)
            bar.advance()
    # 4.
    return stepped(costs_of, channels, best).factors


def stepped(
    costs_of: Callable[[np.ndarray], Costs], channels: Sequence[np.ndarray], best: "Best"
) -> "Best":
    """Try larger and smaller factors for one set of channels after the other, and return the best
    factors.

    Args:
        costs_of: returns, for factors (C,), the function that measures their error on crops.
        channels: sets of channel numbers. The channels of a set are multiplied by a common number.
        best: the factors to start from, with their error.
    """
    trials = list(product(STEPS, channels))
    with steps("groups of channels", len(trials)) as bar:
        for size, together in trials:
            for factor in (size, 1 / size):
                candidate = best.factors.copy()
                candidate[together] *= factor
                winner = race(costs_of(candidate), candidate, best)
                if winner is not best:
                    best = winner
                    # The inverse factor would lead back to where the channel came from.
                    break
            bar.advance()
    return best


@dataclass(frozen=True)
class Best:
    """The best equalisation factors found so far.

    Attributes:
        factors: (C,) the factor of each channel.
        costs: (N,) the error of the INT8 network with these factors, on each of the N crops.
    """

    factors: np.ndarray
    costs: np.ndarray


def race(costs_of: Costs, factors: np.ndarray, best: Best) -> Best:
    """Measure new factors on crop after crop, and return the better of them and the best so far.

    The crops on which the best so far errs most come first. Six of seven candidates fail, and most
    of them show it on two crops, so that the others need not be run.

    Args:
        costs_of: returns the error of the new factors on the crops of given numbers.
        factors: (C,) the new factors.
        best: the best factors so far.
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
