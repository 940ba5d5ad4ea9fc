"""Find the residual groups: tensors that adds connect, and that share one scale in the core.

1. Group tensors that an add, a pool, an enlargement or a concat connects.
2. Place each tensor's channels among the group's factors: a concat puts them side by side.
3. Leave out groups with an operation that a factor per channel does not pass, or that the host
   writes or reads.
4. Find single tensors: those of no group that convolutions alone write and read.

One scale for a whole group makes its adds exact: nothing has to be aligned, so nothing is rounded.
Only a tensor of far smaller values has a finer scale. The sums of residual blocks grow, and a
normalisation behind the first tensor magnifies its steps: with one scale for all, a small GhostNet
lost 4.6 instead of 1.1 dB (measured).
"""

from collections.abc import Mapping, Sequence
from itertools import accumulate, chain, repeat

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
    channels_of,
)
from beers_deploy.quant.graph.ties import united

GROUP_FRAC_BITS = 8
"""The fractional bits of a group. Any value would do, because `equalize` scales the group to it."""


SPARE_BITS = 2
"""Unused bits from which on a tensor has a finer scale than its group."""

ResidualGroup = Mapping[str, slice]
"""Tensors that have the same factors, channel by channel, and the slice of the factors that belongs
to each. Each tensor is added to another one, or is such a sum, or is derived from them by a pool,
an enlargement or a concat.
"""
PASSING = (Concat, MaxPool, AveragePool, Resize)
"""Operations that pass channels on without mixing them."""


def only(name: str) -> ResidualGroup:
    """Return one tensor as a group by itself, so that functions for residual groups accept it."""
    return {name: slice(None)}


def residual_groups(graph: Graph) -> list[ResidualGroup]:
    """Find the residual groups: tensors that adds connect, and that can share one scale and be
    equalised.

    Only convolutions, adds and operations that pass channels on write and read them, with nothing
    in between that blocks a factor per channel. Groups that a product, a pixel shuffle or the
    network's end reads are excluded.

    Args:
        graph: a float graph.

    Returns:
        The groups in the order of the graph, each a dict from tensor name to the slice of the
        group's channels.
    """
    # 1.
    linking = [op for op in graph if isinstance(op, Add) or _passes_channels(op)]
    leader = united((*op.inputs, op.output) for op in linking)
    sums = {leader[op.output] for op in linking if isinstance(op, Add)}
    groups = [
        [name for name in leader if leader[name] == first]
        for first in dict.fromkeys(leader.values())
    ]
    # 2.
    placed = [_placed(linking, group, graph) for group in groups if leader[group[0]] in sums]
    # 3.
    return [group for group in placed if group and _passes_factors(graph, group)]


def _placed(linking: Sequence[Op], names: Sequence[str], graph: Graph) -> ResidualGroup:
    """Return the slices of the channels of these tensors; empty if one would need two slices."""
    writers = [op for op in linking if op.output in names]
    # Only a concat puts channels at other places than those of its inputs.
    if not any(isinstance(op, Concat) for op in writers):
        return dict.fromkeys(names, slice(None))
    planes = next(op.weight.shape[1] for op in graph if isinstance(op, Conv))
    widths = channels_of(graph, {PLANES: planes})
    # Each input, the output, and where the input's channels stand in the output.
    links = []
    for op in writers:
        before = accumulate((widths[name] for name in op.inputs[:-1]), initial=0)
        offsets = before if isinstance(op, Concat) else repeat(0, len(op.inputs))
        links += [(name, op.output, by) for name, by in zip(op.inputs, offsets, strict=True)]
    first = {names[0]: 0}
    # The tensors are linked to each other, so every sweep places at least one more.
    while len(first) < len(names):
        for part, result, by in links:
            if result in first:
                first.setdefault(part, first[result] + by)
            elif part in first:
                first[result] = first[part] - by
    # A channel at two places would need two factors.
    if any(first[part] != first[result] + by for part, result, by in links):
        return {}
    least = min(first.values())
    return {
        name: slice(start - least, start - least + widths[name]) for name, start in first.items()
    }


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
    return [name for name in outputs if name not in passing and _passes_factors(graph, only(name))]


def _passes_channels(op: Op) -> bool:
    """Return True if an operation computes each channel of its output from one channel of an input,
    in proportion to it.
    """
    if isinstance(op, Pointwise):
        return op.activation.homogeneous
    return isinstance(op, PASSING)


def _passes_factors(graph: Graph, group: ResidualGroup) -> bool:
    """Return True if all operations on a group's tensors allow a factor for each channel.

    ReLU6 allows it behind a convolution, where `equalize` can make the end of int8 its clip, but
    not behind an add.
    """
    touching = [op for op in graph if group.keys() & {*op.inputs, op.output}]
    # The host, which has no factors, writes the planes and reads the correction.
    if group.keys() & {PLANES, CORRECTION}:
        return False
    if not all(isinstance(op, Conv | Add) or _passes_channels(op) for op in touching):
        return False
    return all(
        op.activation.homogeneous or (isinstance(op, Conv) and op.activation is Activation.relu6)
        for op in touching
        if op.output in group and isinstance(op, Conv | Add)
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
