"""Two copies of the last stream tensor, rounded half a step apart: together they hold nine bits.

The tail reads head + body end, each rounded to eight bits, and these two roundings make nearly half of INT8's error.
Both are computed twice, with biases a quarter of a step down and a quarter up, and the tail reads both copies at half
weight. The two rounded values of x add up to x rounded at half the step (Hermite's identity:
floor(x) + floor(x + 1/2) = floor(2x)), so it is the same network with finer numbers there, for twice the work in one
of all convolutions. Nothing in it is against the DPU's rules: an int8 bias holds a quarter of a step.
"""

from dataclasses import replace

import numpy as np

from quant.graph import Add, Conv, Graph

OFFSETS = np.array([-0.25, 0.25])
"""Of a step; their mean is 0."""


def half_steps(graph: Graph, step: float) -> Graph:
    """The graph with two copies of what its last convolution reads, where that is the sum of two convolutions.

    Args:
        graph: that ends with an add and a convolution; any other is returned as it is.
        step: the value of one unit of the tensors that the add reads and writes.
    """
    writers = {op.output: op for op in graph if isinstance(op, Conv) and not op.relu}
    before, end = graph[:-2], graph[-2:]
    add, tail = end if len(end) == 2 else (None, None)
    if not (isinstance(add, Add) and isinstance(tail, Conv) and set(add.inputs) <= set(writers)):
        return graph
    left, right = (_twice(writers[name], step) for name in add.inputs)
    read = {name for op in before for name in op.inputs}
    kept = [op for op in before if op.output in read or op.output not in add.inputs]
    both = replace(add, inputs=(left.output, right.output))
    halved = replace(tail, weight=np.concatenate([tail.weight / 2] * len(OFFSETS), axis=1))
    return (*kept, left, right, both, halved)


def _twice(op: Conv, step: float) -> Conv:
    """Its output channels down, then up."""
    bias = np.concatenate([op.bias + np.float32(offset * step) for offset in OFFSETS])
    weight = np.concatenate([op.weight] * len(OFFSETS))
    return replace(op, name=f"{op.name}.twice", output=f"{op.output}.twice", weight=weight, bias=bias)
