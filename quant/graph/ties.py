"""Find the tensors that must share a scale, because an operation only passes values on."""

from collections.abc import Iterable

from beers_deploy.quant.graph.operations import (
    AveragePool,
    Concat,
    Graph,
    MaxPool,
    Op,
    Resize,
    Shuffle,
)

TYING = (Concat, MaxPool, AveragePool, Resize, Shuffle)


def ties_scales(op: Op) -> bool:
    """Return True if all inputs and the output of an operation must share one scale.

    The DPU requires that of operations that only pass values on.
    """
    return isinstance(op, TYING)


def united(links: Iterable[Iterable[str]]) -> dict[str, str]:
    """Map every name to the first name of the set of names that it is linked with, directly or
    indirectly.

    Args:
        links: groups of names; all names in a group are linked with each other.
    """
    leader: dict[str, str] = {}

    def find(name: str) -> str:
        while leader.setdefault(name, name) != name:
            name = leader[name]
        return name

    for link in links:
        first, *others = dict.fromkeys(map(find, link))
        leader.update(dict.fromkeys(others, first))
    return {name: find(name) for name in leader}


def tied(graph: Graph) -> dict[str, str]:
    """Map every tensor to the first of the tensors that must have the same scale as it.

    Concat, pooling, resizing and shuffling require one scale of their inputs and output.

    Args:
        graph: the operations of a network.

    Returns:
        A dict from tensor name to tensor name. A tensor with a scale of its own is mapped to
        itself.
    """
    links: list[tuple[str, ...]] = []
    # A link of one name lists each tensor, also those that share their scale with none.
    for op in graph:
        links += [(name,) for name in (*op.inputs, op.output)]
    links += [(*op.inputs, op.output) for op in graph if ties_scales(op)]
    return united(links)
