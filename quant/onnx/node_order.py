"""Sort the nodes of a file such that each reads only tensors that were written before.

ONNX requires such an order. Quantisers that insert nodes, such as AMD Quark, do not always preserve
it.
"""

from graphlib import CycleError, TopologicalSorter

from onnx import GraphProto

from beers_deploy.quant.onnx.messages import replace_all


def sort_nodes(graph: GraphProto) -> None:
    """Sort the nodes of a graph in place, so that each reads only tensors that were written before.

    Nothing is changed if they are sorted already, or if they form a cycle.

    Args:
        graph: the graph of a file that has not been checked.
    """
    nodes = list(graph.node)
    writers = dict[str, int]()
    for number, node in enumerate(nodes):
        writers |= dict.fromkeys(filter(None, node.output), number)
    sources = {
        number: {writers[name] for name in node.input if name in writers}
        for number, node in enumerate(nodes)
    }
    if all(max(places, default=-1) < number for number, places in sources.items()):
        return
    try:
        order = list(TopologicalSorter(sources).static_order())
    except CycleError:
        # A cycle has no order: the checker of ONNX names it.
        return
    replace_all(graph.node, [nodes[number] for number in order])
