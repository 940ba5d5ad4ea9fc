"""Bound the search for equalisation factors, and estimate its time before it begins.

1. Count the work of a candidate: the multiply-accumulates of the operations that it runs again, and
   the work of rounding and loading its weights.
2. If the likely work is too much, try fewer groups of channels, then measure on fewer crops.
3. If the largest possible work is too much, continue until it is not.

Work is counted and not timed, because the same samples and seed must give the same file.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from beers_deploy.quant.graph import Activation, Conv, Graph, tensors
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.session import values_of


class Effort(StrEnum):
    """The effort of the search for equalisation factors.

    - `fast`: first guesses only.
    - `normal`: groups of channels with similar ranges, within a bound of work.
    - `best`: each channel separately, without a bound.
    """

    fast = "fast"
    normal = "normal"
    best = "best"


MOST_GROUPS = {Effort.fast: 0, Effort.normal: 16, Effort.best: 256}
"""The maximum number of groups into which the channels of a tensor or residual
group are divided.
"""
FEWEST_GROUPS = 8
FEWEST_CROPS = 24
"""With fewer groups or crops much of the gain was lost (measured). The likely work may therefore be
exceeded: a quarter of the gain with 4 groups in a U-Net, all of it with 12 crops of 64 pixels in a
residual network.
"""
LIKELY_WORK = 7e11
MOST_WORK = 2e12
"""Multiply-accumulates: the work that the search should need, and the work that it must not exceed.
On a processor without VNNI 1e10 took half a second to a second.
"""
LEAST_CROPS = 4

RESULT = 64
LEAKY_RESULT = 512
WEIGHT = 400
"""The numbers of multiply-accumulates that take as long as rounding a result, computing a LeakyReLU
in float64, and rounding and loading a weight (measured).
"""
TRIED = 0.35
"""The average share of the crops on which a candidate is run before it is rejected (measured)."""
TURNS = 4
"""The number of candidates for a group of channels: larger and smaller, in two sizes."""


def channel_groups(ranges: np.ndarray, most: int) -> list[np.ndarray]:
    """Divide channels into groups of similar range, each of which is tried with one common factor.

    Args:
        ranges: (C,) the ranges of the channels.
        most: the maximum number of groups; 0 for none. If it is at least C, each channel is a group
            of its own.

    Returns:
        The numbers of the channels in each group.
    """
    if most >= len(ranges):
        return list(np.arange(len(ranges))[:, None])
    return np.array_split(np.argsort(ranges, kind="stable"), most) if most else []


@dataclass(frozen=True)
class Stage:
    """One separate search for factors: of a residual group, of a tensor, or of all single tensors
    together.

    Attributes:
        tensors: the names of the tensors whose channels are scaled.
        guesses: the number of first guesses that are tried.
        channels: the number of channels that are tried with larger and smaller factors; 0 for first
            guesses alone.
    """

    tensors: Collection[str]
    guesses: int
    channels: int = 0

    def candidates(self, groups: int) -> int:
        """Return the largest number of networks that the search tries.

        Args:
            groups: the number of groups into which channels are divided, each of which has one
                factor.
        """
        return self.guesses + TURNS * min(groups, self.channels)


@dataclass(frozen=True)
class Bound:
    """The amount of work to which the search for equalisation factors is limited.

    Attributes:
        groups: the maximum number of groups into which the channels of a tensor or residual group
            are divided.
        crops: the number of crops of calibration images on which a candidate network is run.
        candidates: the maximum number of candidates.
        runs: the likely work of the whole search, over the work of running the first candidate on
            all crops.
    """

    groups: int
    crops: int
    candidates: int
    runs: float


def bound(
    stages: Sequence[Stage], graph: Graph, work: Sequence[int], crops: int, effort: Effort
) -> Bound:
    """Decide how many groups of channels and crops a search uses, so that its work stays within
    limits.

    Args:
        stages: the separate searches.
        graph: the float graph whose channels are scaled.
        work: the work of each operation on one crop, in multiply-accumulates, as `work_of` returns
            it.
        crops: the number of crops that is used if no limit applies.
        effort: the effort that the user allows. The limits do not apply to `best`.
    """

    def of_candidate(stage: Stage, crops: float) -> float:
        start, stop = span(graph, stage.tensors)
        weights = sum(op.weight.size for op in graph[start:stop] if isinstance(op, Conv))
        return WEIGHT * weights + crops * sum(work[start:])

    def total(groups: int, crops: float) -> float:
        return sum(stage.candidates(groups) * of_candidate(stage, crops) for stage in stages)

    groups = MOST_GROUPS[effort]
    if effort is not Effort.best:
        # 2.
        while groups > FEWEST_GROUPS and total(groups, TRIED * crops) > LIKELY_WORK:
            groups -= 1
        while crops // 2 >= FEWEST_CROPS and total(groups, TRIED * crops) > LIKELY_WORK:
            crops //= 2
        # 3.
        while crops > LEAST_CROPS and total(groups, crops) > MOST_WORK:
            crops //= 2
        while groups and total(groups, crops) > MOST_WORK:
            groups -= 1
    candidates = sum(stage.candidates(groups) for stage in stages)
    first = of_candidate(Stage(tensors(graph), 1), crops)
    return Bound(groups, crops, candidates, total(groups, TRIED * crops) / first)


def span(graph: Graph, names: Collection[str]) -> tuple[int, int]:
    """Return the range of the operations that write or read some tensors, and of all between them.

    Args:
        graph: the operations in order.
        names: the names of the tensors, at least one of which occurs.

    Returns:
        The place of the first such operation, and the place behind the last.
    """
    places = [k for k, op in enumerate(graph) if not {*op.inputs, op.output}.isdisjoint(names)]
    return places[0], places[-1] + 1


def work_of(graph: Graph, host_part: HostPart, crop: np.ndarray) -> list[int]:
    """Count the work of each operation on one crop, in multiply-accumulates.

    Rounding a result counts as the number of multiply-accumulates that take as long.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.
        host_part: the host's pre- and post-processing around the graph.
        crop: (1, C, h, w) a part of an image.

    Returns:
        The work of each operation, in the order of the graph.
    """
    # 1.
    (results,) = values_of(graph, tensors(graph), [crop], host_part)
    work = []
    for op, result in zip(graph, results, strict=True):
        of_value = RESULT
        if isinstance(op, Conv):
            rounding = LEAKY_RESULT if op.activation is Activation.leaky_relu else RESULT
            of_value = int(op.weight[0].size) + rounding
        work.append(result.size * of_value)
    return work
