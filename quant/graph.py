"""The network as a short list of operations, convolutions and adds: what quantisation works on."""

from dataclasses import dataclass

import numpy as np

IMAGE, CORRECTION = "image", "correction"


@dataclass(frozen=True)
class Conv:
    """A 3 x 3-like convolution of stride 1 with zero padding, ReLU fused where one follows."""

    name: str
    input: str
    output: str
    weight: np.ndarray  # (O, I, kh, kw) float32
    bias: np.ndarray  # (O,) float32
    relu: bool = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """The tensors it reads."""
        return (self.input,)

    @property
    def pad_px(self) -> int:
        """Zero padding on each side."""
        return int(self.weight.shape[2]) // 2


@dataclass(frozen=True)
class Add:
    """An element-wise sum of two tensors of the stream."""

    name: str
    inputs: tuple[str, str]
    output: str


Op = Conv | Add
Graph = tuple[Op, ...]


def tensors(graph: Graph) -> list[str]:
    """The names of all results, in order."""
    return [op.output for op in graph]


def relu_count(graph: Graph) -> int:
    """How many convolutions carry a ReLU: quantisers have been seen to drop them without a word."""
    return sum(isinstance(op, Conv) and op.relu for op in graph)
