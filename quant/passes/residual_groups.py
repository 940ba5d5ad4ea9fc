"""Find the residual groups: tensors that adds connect, and that share one scale in the core.

1. Group tensors that an add, a pool, an enlargement, a pixel shuffle or a concat connects.
2. Find which channels have one factor: a concat puts its inputs' channels side by side, a pixel
   shuffle makes one channel from several.
3. Leave out groups with an operation that a factor per channel does not pass, or that the host
   writes or reads.
4. Find single tensors: those of no group that convolutions alone write and read.

One scale for a whole group makes its adds exact: nothing has to be aligned, so nothing is rounded.
Only a tensor of far smaller values has a finer scale. The sums of residual blocks grow, and a
normalisation behind the first tensor magnifies its steps: with one scale for all, a small GhostNet
lost 4.6 instead of 1.1 dB (measured).
"""

from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from beers_deploy.quant.frac_bits import INT8_MAX
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    SIX,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    channels_of,
)
from beers_deploy.quant.graph.ties import united

GROUP_FRAC_BITS = 8
"""The fractional bits of a group. Any value would do, because `equalize` scales the group to it."""


SPARE_BITS = 2
"""Unused bits from which on a tensor has a finer scale than its group."""

ResidualGroup = Mapping[str, np.ndarray]
"""Tensors that share factors, and for each of them the number of every channel's factor (C,). Each
tensor is added to another one, or is such a sum, or is derived from them by a pool, an enlargement,
a pixel shuffle or a concat.
"""
PASSING = (Concat, MaxPool, AveragePool, Resize, Shuffle)
"""Operations that pass channels on without mixing them."""


def only(name: str, channels: int) -> ResidualGroup:
    """Return one tensor as a group by itself, so that functions for residual groups accept it."""
    return {name: np.arange(channels)}


def n_factors(group: ResidualGroup) -> int:
    """Return the number of factors that the tensors of a group share."""
    return 1 + max(int(numbers.max()) for numbers in group.values())


def residual_groups(graph: Graph) -> list[ResidualGroup]:
    """Find the residual groups: tensors that adds connect, and that can share one scale and be
    equalised.

    Only convolutions, adds and operations that pass channels on write and read them, with nothing
    in between that blocks a factor per channel. Groups that a product or the network's end reads
    are excluded.

    Args:
        graph: a float graph.

    Returns:
        The groups in the order of the graph.
    """
    # 1.
    linking = [op for op in graph if isinstance(op, Add) or _passes_channels(op)]
    leader = united((*op.inputs, op.output) for op in linking)
    sums = {leader[op.output] for op in linking if isinstance(op, Add)}
    groups = [
        [name for name in leader if leader[name] == first]
        for first in dict.fromkeys(leader.values())
    ]
    # 3.
    named = [
        group for group in groups if leader[group[0]] in sums and _passes_factors(graph, group)
    ]
    planes = next((op.weight.shape[1] for op in graph if isinstance(op, Conv)), 0)
    widths = channels_of(graph, {PLANES: planes}) if named else {}
    # 2.
    return [_numbered(linking, group, widths) for group in named]


def _numbered(
    linking: Sequence[Op], names: Sequence[str], widths: Mapping[str, int]
) -> ResidualGroup:
    """Return the number of the factor of each channel of these tensors.

    Args:
        linking: the operations that connect tensors.
        names: the tensors of a group.
        widths: the number of channels of each tensor.
    """
    # The widest first, so that the factors have the order of a concat's channels.
    ordered = sorted(names, key=lambda name: -widths[name])
    ends = np.cumsum([0, *(widths[name] for name in ordered)])
    # Each channel of each tensor has a number.
    numbers = {name: np.arange(*ends[k : k + 2]) for k, name in enumerate(ordered)}
    edges = []
    for op in linking:
        if op.output not in numbers:
            continue
        after = numbers[op.output]
        inputs = [numbers[name] for name in op.inputs]
        if isinstance(op, Shuffle):
            # Each pixel of the result shows the channel that it comes from.
            before = op(np.tile(inputs[0][None, :, None, None], (op.block, op.block)))
            after = after[:, None, None]
        elif isinstance(op, Concat):
            before = np.concatenate(inputs)
        else:
            before = np.array(inputs)
        edges.append((before.ravel(), np.broadcast_to(after, before.shape).ravel()))
    first, second = map(np.concatenate, zip(*edges, strict=True))
    adjacency = coo_array((np.ones(len(first)), (first, second)), (ends[-1],) * 2)
    _, factors = connected_components(adjacency, directed=False)
    return {name: factors[each] for name, each in numbers.items()}


def exceeds_six(graph: Graph, group: ResidualGroup, frac_bits: Mapping[str, int]) -> bool:
    """Return True if int8 cannot end at the value 6 in a group that a ReLU6 writes to.

    Equalisation would let the end of int8 replace the ReLU6's clip at 6. That fails if one of the
    tensors needs a scale at which int8 ends beyond 6.

    Args:
        graph: the float graph.
        group: the tensors of the group.
        frac_bits: the number of fractional bits of each tensor's own scale, by its name.
    """
    clipped = any(
        isinstance(op, Conv) and op.activation is Activation.relu6 and op.output in group
        for op in graph
    )
    # If int8 ends above six, there are larger sums, and its end cannot replace their clip.
    return clipped and any(INT8_MAX * 2.0 ** -frac_bits[name] > SIX for name in group)


def single_tensors(graph: Graph) -> list[str]:
    """Find the tensors that only convolutions write and read, and that belong to no residual group.

    Each of their channels may be scaled by a factor of its own.

    Args:
        graph: a float graph.

    Returns:
        The names of the tensors, in the order of the graph.
    """
    # 4.
    adds = [op for op in graph if isinstance(op, Add)]
    terms = set(chain.from_iterable((*op.inputs, op.output) for op in adds))
    outputs = [op.output for op in graph if isinstance(op, Conv) and op.output not in terms]
    passing = set(chain.from_iterable(op.inputs for op in graph if _passes_channels(op)))
    return [name for name in outputs if name not in passing and _passes_factors(graph, [name])]


def _passes_channels(op: Op) -> bool:
    """Return True if an operation computes each channel of its output from one channel of an input,
    in proportion to it.
    """
    if isinstance(op, Pointwise):
        return op.activation.homogeneous
    return isinstance(op, PASSING)


def _passes_factors(graph: Graph, names: Sequence[str]) -> bool:
    """Return True if all operations on these tensors allow a factor for each channel.

    ReLU6 allows it behind a convolution, where `equalize` can make the end of int8 its clip, but
    not behind an add.
    """
    touching = [op for op in graph if not {*op.inputs, op.output}.isdisjoint(names)]
    # The host, which has no factors, writes the planes and reads the correction.
    if not {PLANES, CORRECTION}.isdisjoint(names):
        return False
    if not all(isinstance(op, Conv | Add) or _passes_channels(op) for op in touching):
        return False
    return all(
        op.activation.homogeneous or (isinstance(op, Conv) and op.activation is Activation.relu6)
        for op in touching
        if op.output in names and isinstance(op, Conv | Add)
    )


def finer_members(
    graph: Graph, groups: Sequence[ResidualGroup], own: Mapping[str, int]
) -> dict[str, int]:
    """Return the fractional bits of the tensors that use far less of int8 than their groups, and
    that convolutions read.

    Args:
        graph: the float graph, whose groups are scaled to GROUP_FRAC_BITS.
        groups: residual groups.
        own: the fractional bits at which each tensor alone would fill int8 and clip nothing.
    """
    read = set(chain.from_iterable(op.inputs for op in graph if isinstance(op, Conv)))
    members = read.intersection(chain.from_iterable(groups))
    return {name: own[name] for name in members if own[name] >= GROUP_FRAC_BITS + SPARE_BITS}
