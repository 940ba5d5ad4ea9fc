"""Test that reading and checking takes steps linear in the number of nodes of each kind."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from beers_deploy.verbs.check import check
from tests.deploy.dpu.graphs import IntegerSketch

TraceFunction = Callable[[FrameType, str, Any], Any]

FEWEST = 60
"""Number of nodes of the smallest network. It is doubled twice."""
QUADRATIC = 2.5
"""A linear step adds twice as many instructions in the second doubling as in the first, a quadratic
one four times as many.
"""
CHANNELS = 8
WEIGHT = np.random.default_rng(0).normal(0, 0.05, (CHANNELS, CHANNELS, 3, 3)).astype(np.float32)
SHUFFLED = ((0, 2, 2, 2, 64, 64), (0, 2, 128, 128))
"""The two shapes with which exporters write a pixel shuffle."""


def convolved(s: IntegerSketch, x: str) -> str:
    """Convolve with weights that are stored for this node alone."""
    return s.node("Conv", x, s.constant(WEIGHT), pads=[1] * 4)


def residual(s: IntegerSketch, x: str) -> str:
    """Add a convolution with a ReLU to what it reads."""
    return s.node("Add", x, s.node("Relu", convolved(s, x)))


def scaled(s: IntegerSketch, x: str) -> str:
    """Scale each channel in front of a convolution, which absorbs the scale."""
    factor = s.constant(np.full((1, CHANNELS, 1, 1), 0.9, np.float32))
    return convolved(s, s.node("Mul", s.node("Relu", x), factor))


def pointwise(s: IntegerSketch, x: str) -> str:
    """Add three element-wise nodes, one after the other."""
    factor = s.constant(np.array(0.99, np.float32))
    return s.node("Sigmoid", s.node("Mul", s.node("Relu", x), factor))


def shuffled(s: IntegerSketch, x: str) -> str:
    """Write a pixel shuffle as exporters do, and reverse it."""
    apart, whole = (s.constant(np.array(shape)) for shape in SHUFFLED)
    moved = s.node("Transpose", s.node("Reshape", x, apart), perm=[0, 1, 4, 2, 5, 3])
    back = s.node("SpaceToDepth", s.node("Reshape", moved, whole), blocksize=2)
    return convolved(s, back)


def integers(s: IntegerSketch, x: str) -> str:
    """Convolve, rectify and add on integers."""
    before = s.quantized(x) if x == "image" else x
    return s.qadd(before, s.node("Relu", s.qconv(before, WEIGHT.shape)))


KINDS = (residual, scaled, pointwise, shuffled, integers)


def network(kind: Callable[[IntegerSketch, str], str], nodes: int, path: Path) -> Path:
    """Write a chain of blocks of a kind, with at least `nodes` nodes."""
    sketch = IntegerSketch(CHANNELS)
    last = "image"
    while len(sketch.nodes) < nodes:
        last = kind(sketch, last)
    return sketch.save(path, last)


def steps(path: Path) -> int:
    """Count the Python instructions that this package executes. Time would depend on the
    machine.
    """
    count = 0

    def step(_frame: FrameType, event: str, _argument: object) -> TraceFunction:
        nonlocal count
        count += event == "opcode"
        return step

    def called(frame: FrameType, _event: str, _argument: object) -> TraceFunction | None:
        if not str(frame.f_globals.get("__name__")).startswith("beers_deploy"):
            return None
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False
        return step

    before = sys.gettrace()
    sys.settrace(called)
    try:
        check(path)
    finally:
        sys.settrace(before)
    return count


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_steps_grow_with_the_nodes(
    kind: Callable[[IntegerSketch, str], str], tmp_path: Path
) -> None:
    # The first call also counts what a process reads only once.
    check(network(kind, FEWEST, tmp_path / "a.onnx"))
    few, more, most = (
        steps(network(kind, FEWEST * times, tmp_path / "a.onnx")) for times in (1, 2, 4)
    )
    assert most - more < QUADRATIC * (more - few)
