"""One position for the whole residual stream, so that its adds are exact.

A block reads the stream, and adds its branch to it. With branch and stream at one position the sum of two whole
numbers is a whole number: nothing is rounded but the branch, once. With positions of their own, each the best for
its tensor, the sum is rounded again at every block, and those errors add up: they dominate what INT8 costs. On the
DPU the add then needs no shifts.
"""

from collections.abc import Mapping

from quant.graph import Add, Graph

STREAM_POSITION = 8
"""Any would do: `equalise` scales the stream to it."""


def stream_tensors(graph: Graph) -> set[str]:
    """The tensors that adds read and write."""
    return {name for op in graph if isinstance(op, Add) for name in (*op.inputs, op.output)}


def steady(graph: Graph, positions: Mapping[str, int], position: int) -> dict[str, int]:
    """The positions with one for the stream."""
    return {**positions, **dict.fromkeys(stream_tensors(graph), position)}


def common_position(graph: Graph, positions: Mapping[str, int]) -> int:
    """The coarsest least-squares position on the stream: what a stream that is not equalised takes."""
    return min((positions[name] for name in stream_tensors(graph)), default=STREAM_POSITION)
