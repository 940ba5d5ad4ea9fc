"""Sort the nodes of a file such that each reads only tensors that were written before.

ONNX requires such an order. Quantisers that insert nodes, such as AMD Quark, do not always preserve
it.
"""

from collections import deque
from collections.abc import Sequence

from onnx import GraphProto, NodeProto


def sort_nodes(graph: GraphProto) -> None:
    """Sort the nodes of a graph in place, if they are not sorted; those of a cycle stay last.

    Args:
        graph: of a file that has not been checked.
    """
    nodes = list(graph.node)
    order = _order(nodes)
    if order != list(range(len(nodes))):
        del graph.node[:]
        graph.node.extend(nodes[number] for number in order)


def _order(nodes: Sequence[NodeProto]) -> list[int]:
    """Return the numbers of the nodes, each behind those whose results it reads.

    The order of sorted nodes does not change.
    """
    writers: dict[str, int] = {}
    for number, node in enumerate(nodes):
        writers.update(dict.fromkeys(filter(None, node.output), number))
    n_missing = []
    readers: list[list[int]] = [[] for _ in nodes]
    is_sorted = True
    for number, node in enumerate(nodes):
        sources = {writers[name] for name in node.input if name in writers}
        is_sorted = is_sorted and all(source < number for source in sources)
        n_missing.append(len(sources))
        for source in sources:
            readers[source].append(number)
    if is_sorted:
        return list(range(len(nodes)))
    ready = deque(number for number, count in enumerate(n_missing) if count == 0)
    order = []
    while ready:
        number = ready.popleft()
        order.append(number)
        for reader in readers[number]:
            n_missing[reader] -= 1
            if n_missing[reader] == 0:
                ready.append(reader)
    # A cycle has no order: the checker of ONNX names it.
    in_cycle = [number for number, count in enumerate(n_missing) if count]
    return order + in_cycle
