"""What a graph must be beyond its kinds of operations, so that quantisation need not ask again."""

import numpy as np

from profiles.errors import ModelError
from quant.graph import CORRECTION, IMAGE, Add, Conv, Graph


def check_graph(graph: Graph) -> None:
    """Refuse what cannot be quantised, before anything is computed.

    Raises:
        ModelError: ends other than convolutions of one channel, a tensor read that nobody wrote, widths that do not
            fit, or weights that are no numbers.
    """
    if not graph or not isinstance(graph[0], Conv) or graph[0].input != IMAGE or graph[0].weight.shape[1] != 1:
        raise refused_graph("a first convolution that reads an image of one channel", _kind(graph[:1]))
    if not isinstance(graph[-1], Conv) or graph[-1].output != CORRECTION or len(graph[-1].weight) != 1:
        raise refused_graph("a last convolution that writes a correction of one channel", _kind(graph[-1:]))
    widths = {IMAGE: 1}
    for op in graph:
        widths[op.output] = _conv_width(op, widths) if isinstance(op, Conv) else _add_width(op, widths)
    stream = {widths[name] for op in graph if isinstance(op, Add) for name in (*op.inputs, op.output)}
    if len(stream) > 1:
        raise refused_graph("adds of one width", f"widths {sorted(stream)}")


def _conv_width(op: Conv, widths: dict[str, int]) -> int:
    if _width(op, op.input, widths) != op.weight.shape[1]:
        raise refused_graph(f"{op.weight.shape[1]} channels for {op.name}", f"{widths[op.input]}")
    if not (np.isfinite(op.weight).all() and np.isfinite(op.bias).all()):
        raise refused_graph("finite weights", f"NaN or infinity in {op.name}")
    return len(op.weight)


def _add_width(op: Add, widths: dict[str, int]) -> int:
    left, right = (_width(op, name, widths) for name in op.inputs)
    if left != right:
        raise refused_graph(f"two tensors of one width for {op.name}", f"{left} and {right} channels")
    return left


def _width(op: Conv | Add, name: str, widths: dict[str, int]) -> int:
    if name not in widths:
        raise refused_graph(
            f"{op.name} behind what it reads, and a ReLU's convolution read behind the ReLU only", name
        )
    return widths[name]


def _kind(ops: Graph) -> str:
    if not ops:
        return "no operation"
    op = ops[0]
    return f"{op.name}, " + (f"a convolution of {op.weight.shape[:2]}" if isinstance(op, Conv) else "an add")


def refused_graph(expected: str, got: str) -> ModelError:
    """The sentence for a network that cannot be quantised."""
    remedy = "see docs/commands.md for what 'quantize' takes; other INT8 files can be checked and gated all the same"
    return ModelError("float model", expected=expected, got=got, remedy=remedy)
