"""Each rule of numbers with a small QDQ file that breaks it alone, and the same file with the remedy followed."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deploy.dpu.board import load_dpu
from deploy.dpu.number_rules import AGAIN, MOVE
from deploy.dpu.placement import place
from deploy.dpu.reading import read_network
from tests.deploy.dpu.graphs import QdqSketch

DPU = load_dpu()
Draw = Callable[[QdqSketch, str], str]


def conv(**numbers: object) -> Draw:
    return lambda s, x: s.qdq_conv(x, **numbers)  # type: ignore[arg-type]


def added(one: float, other: float, output: float) -> Draw:
    return lambda s, x: s.pair(s.node("Add", s.qdq_conv(x, output=one), s.qdq_conv(x, output=other)), output)


def pooled(output: float) -> Draw:
    return lambda s, x: s.pair(s.node("MaxPool", x, kernel_shape=[2, 2]), output)


def joined(output: float) -> Draw:
    return lambda s, x: s.pair(s.node("Add", x, x), output)


CASES: dict[str, tuple[Draw, Draw]] = {
    "symmetric": (lambda s, x: s.pair(s.node("Add", x, x), 7, zero=3), joined(7)),
    "per tensor": (conv(weight=[7, 7, 6, 7]), conv(weight=7)),
    "power of two": (conv(weight=-math.log2(0.01)), conv(weight=7)),
    "int8 bias": (conv(bias_kind=np.int32, bias=14), conv(bias=14)),
    "shift cut": (conv(weight=17, bias=9), conv(weight=16, bias=9)),
    "shift bias": (conv(bias=-3), conv(bias=-2)),
    "shift read": (added(-2, 14, -2), added(-2, 13, -2)),
    "shift write": (added(7, 7, 23), added(7, 7, 22)),
    "same position": (pooled(6), pooled(7)),
}


def remedies(path: Path, draw: Draw) -> dict[str, str]:
    """Rules broken by what `draw` puts behind a convolution, with their remedies."""
    sketch = QdqSketch(4)
    end = draw(sketch, sketch.qdq_conv(sketch.pair("image")))
    nodes = place(read_network(sketch.save(path, end), 32), DPU).nodes
    return {b.rule: b.finding.remedy for node in nodes for b in node.broken}


@pytest.mark.parametrize("rule", CASES)
def test_each_rule_refuses_its_file_alone_and_names_a_remedy(tmp_path: Path, rule: str) -> None:
    found = remedies(tmp_path / "n.onnx", CASES[rule][0])
    assert list(found) == [rule]
    assert (MOVE if rule.startswith("shift") else AGAIN) in found[rule]


@pytest.mark.parametrize("rule", CASES)
def test_following_the_remedy_passes(tmp_path: Path, rule: str) -> None:
    assert remedies(tmp_path / "n.onnx", CASES[rule][1]) == {}
