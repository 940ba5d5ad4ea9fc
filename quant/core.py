"""The integer core: the graph with int8 weights and bias, and a position for every tensor, as the DPU demands."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from profiles.errors import ModelError
from quant.graph import Add, Conv, Graph
from quant.positions import SHIFTS, Shifts, best_position, clamp, coarsest_position, quantise

ROUNDS = 8
"""An add may move a tensor that was written long before, whose writer must then follow; two rounds do, if any."""


@dataclass(frozen=True)
class IntConv:
    """int8 convolution: sum of products, plus bias << shift_bias, ReLU, shifted right by shift_cut, clipped."""

    name: str
    input: str
    output: str
    weight: np.ndarray  # (O, I, kh, kw) int8
    weight_position: int
    bias: np.ndarray  # (O,) int8
    bias_position: int
    relu: bool

    @property
    def inputs(self) -> tuple[str, ...]:
        """The tensors it reads."""
        return (self.input,)

    @property
    def pad_px(self) -> int:
        """Zero padding on each side."""
        return int(self.weight.shape[2]) // 2


@dataclass(frozen=True)
class IntCore:
    """Operations in order, and the position of every activation tensor."""

    ops: tuple[IntConv | Add, ...]
    positions: Mapping[str, int]

    @property
    def output_channels(self) -> int:
        """Channels of the correction: 1, or 2 where it has two gains."""
        last = self.ops[-1]
        return len(last.weight) if isinstance(last, IntConv) else 1

    def scale(self, tensor: str) -> float:
        """The value of one unit of a tensor, 2^-position."""
        return float(2.0 ** -self.positions[tensor])


def build_core(graph: Graph, positions: Mapping[str, int], shifts: Shifts = SHIFTS) -> IntCore:
    """Quantise the weights of a graph, and move positions that the DPU's shifts cannot reach.

    Args:
        graph: a plane-reading graph.
        positions: the least-squares position of every activation.
        shifts: the windows of the target.

    Raises:
        ModelError: no positions are within reach: sizes of values that have nothing to do with each other.
    """
    legal = dict(positions)
    for _ in range(ROUNDS):
        core = _in_one_round(graph, legal, shifts)
        faults = shift_faults(core, shifts)
        if not faults:
            return core
    remedy = "look for weights that are far too large or small"
    raise ModelError("float model", expected="values that the DPU's shifts reach", got=faults[0], remedy=remedy)


def _in_one_round(graph: Graph, positions: dict[str, int], shifts: Shifts) -> IntCore:
    """Every operation within reach of the positions before it, which it may move."""
    ops: list[IntConv | Add] = []
    for op in graph:
        if isinstance(op, Conv):
            ops.append(_quantise_conv(op, positions, shifts))
        else:
            _move_add(op, positions, shifts)
            ops.append(op)
    return IntCore(tuple(ops), dict(positions))


def _quantise_conv(op: Conv, positions: dict[str, int], shifts: Shifts) -> IntConv:
    finest = shifts.cut[1] + positions[op.output] - positions[op.input]  # finer weights would make the result clip
    weight_position = min(best_position(op.weight), finest)
    product = weight_position + positions[op.input]
    cut = clamp(product - positions[op.output], shifts.cut)
    positions[op.output] = product - cut
    weight = quantise(op.weight, weight_position)
    return IntConv(
        op.name, op.input, op.output, weight, weight_position, *quantise_bias(op.bias, product, shifts), op.relu
    )


def quantise_bias(bias: np.ndarray, product: int, shifts: Shifts = SHIFTS) -> tuple[np.ndarray, int]:
    """An int8 bias (O,) and its position, within reach of the accumulator at position `product`."""
    wanted = best_position(bias) if bias.any() else product
    coarsest = min(wanted, coarsest_position(float(np.abs(bias).max(initial=0.0))) + 1)
    position = product - clamp(product - max(wanted, coarsest), shifts.bias)
    return quantise(bias, position), position


def _move_add(op: Add, positions: dict[str, int], shifts: Shifts) -> None:
    coarse = min(positions[i] for i in op.inputs)
    for name in op.inputs:
        positions[name] = coarse + clamp(positions[name] - coarse, shifts.read)
    positions[op.output] = coarse - clamp(coarse - positions[op.output], shifts.write)


def shift_faults(core: IntCore, shifts: Shifts = SHIFTS) -> list[str]:
    """Every shift outside its window, one sentence each; empty for a legal core."""
    faults = []
    for op in core.ops:
        for rule, value, window in op_shifts(op, core.positions, shifts):
            if not window[0] <= value <= window[1]:
                faults.append(f"{op.name}: {rule} is {value}, allowed {window[0]} to {window[1]}")
    return faults


def op_shifts(
    op: IntConv | Add, positions: Mapping[str, int], shifts: Shifts
) -> list[tuple[str, int, tuple[int, int]]]:
    """(name, value, window) of the shifts that one operation needs."""
    inputs, output = [positions[i] for i in op.inputs], positions[op.output]
    if isinstance(op, Add):
        read, write = max(inputs) - min(inputs), min(inputs) - output
        return [("shift_read", read, shifts.read), ("shift_write", write, shifts.write)]
    product = op.weight_position + inputs[0]
    return [
        ("shift_cut", product - output, shifts.cut),
        ("shift_bias", product - op.bias_position, shifts.bias),
    ]
