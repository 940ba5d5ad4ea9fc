"""Tests of each rule of numbers, with a small QDQ file that breaks it alone, and the same file with
the remedy followed.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from beers_deploy.dpu.checker.number_rules import AGAIN, MOVE
from tests.deploy.dpu.draws import placed
from tests.deploy.dpu.graphs import QdqSketch, behind_qdq_conv

Draw = Callable[[QdqSketch, str], str]


def conv(**numbers: object) -> Draw:
    return lambda s, x: s.qdq_conv(x, **numbers)  # type: ignore[arg-type]


def added(first: float, second: float, output: float) -> Draw:
    return lambda s, x: s.pair(
        s.node("Add", s.qdq_conv(x, output=first), s.qdq_conv(x, output=second)), output
    )


def pooled(output: float) -> Draw:
    return lambda s, x: s.pair(s.node("MaxPool", x, kernel_shape=[2, 2]), output)


def joined(output: float) -> Draw:
    return lambda s, x: s.pair(s.node("Add", x, x), output)


def combined(op_type: str, kind: type, frac_bits: float = 7) -> Draw:
    """Draw an operator that combines the tensor with a constant for each channel."""
    return lambda s, x: s.pair(s.node(op_type, x, s.stored(np.ones((1, 4, 1, 1), kind), frac_bits)))


def read(frac_bits: float, zero: int = 0) -> Draw:
    return lambda s, x: s.qdq_conv(s.pair(s.node("Relu", x), 6, read=(frac_bits, zero)))


def twice(first: float, second: float) -> Draw:
    """Draw a sum that is quantised once for each of its two readers."""

    def draw(s: QdqSketch, x: str) -> str:
        total = s.node("Add", x, x)
        return s.pair(s.node("Add", s.pair(total, first), s.pair(total, second)))

    return draw


CASES: dict[str, tuple[Draw, Draw]] = {
    "symmetric": (lambda s, x: s.pair(s.node("Add", x, x), 7, zero=3), joined(7)),
    "per tensor": (conv(weight=[7, 7, 6, 7]), conv(weight=7)),
    "power of two": (conv(weight=-math.log2(0.01)), conv(weight=7)),
    "int8 bias": (conv(bias_kind=np.int32, bias=14), conv(bias=14)),
    "shift cut": (conv(weight=17, bias=9), conv(weight=16, bias=9)),
    "shift cut: to the finer": (conv(weight=0, output=8), conv(weight=0, output=7)),
    "shift bias": (conv(bias=-3), conv(bias=-2)),
    "shift bias: to the finer": (conv(bias=24), conv(bias=23)),
    "shift read": (added(-2, 14, -2), added(-2, 13, -2)),
    "shift write": (added(7, 7, 23), added(7, 7, 22)),
    "shift write: to the coarser": (added(7, 7, -9), added(7, 7, -8)),
    "same scale": (pooled(6), pooled(7)),
    "power of two: of an addend": (
        combined("Add", np.int8, -math.log2(0.01)),
        combined("Add", np.int8),
    ),
    "shift read: of an addend": (combined("Add", np.int8, 23), combined("Add", np.int8, 22)),
    "int8 constants: weights in float": (conv(weight_kind=np.float32), conv()),
    "int8 constants: weights of int32": (conv(weight_kind=np.int32), conv()),
    "int8 constants: an addend in float": (combined("Add", np.float32), combined("Add", np.int8)),
    "int8 constants: a factor in float": (combined("Mul", np.float32), combined("Mul", np.int8)),
    "int8 constants: an addend of int32": (combined("Add", np.int32), combined("Add", np.int8)),
    "int8 bias: in float": (conv(bias_kind=np.float32), conv()),
    "one format: read at another scale": (read(4), read(6)),
    "one format: read around another zero": (read(6, zero=3), read(6)),
    "one format: quantised twice": (twice(7, 5), twice(7, 7)),
}


def remedies(draw: Draw) -> dict[str, str]:
    """Return the rules that `draw` behind a convolution breaks, with their remedies."""
    by_rule: dict[str, str] = {}
    for node in placed(behind_qdq_conv(draw), 32).nodes:
        by_rule |= {violation.rule: violation.finding.remedy for violation in node.broken}
    return by_rule


@pytest.mark.parametrize("case", CASES)
def test_each_rule_refuses_its_file_alone_and_following_the_remedy_passes(case: str) -> None:
    breaking, remedied = CASES[case]
    rule = case.split(":")[0]
    by_rule = remedies(breaking)
    assert list(by_rule) == [rule]
    assert (MOVE if rule.startswith("shift") else AGAIN) in by_rule[rule]
    assert remedies(remedied) == {}


def computed_weights(s: QdqSketch, x: str) -> str:
    weight = s.pair(s.weight(4, 4, 3, 3))
    return s.pair(s.node("Conv", x, weight, kernel_shape=[3, 3], pads=[1] * 4))


def shared_weights(s: QdqSketch, x: str) -> str:
    """Draw two convolutions that read the same constant at two scales."""
    weight = s.constant(np.ones((4, 4, 3, 3), np.int8))
    bias = s.stored(np.zeros(4, np.int8))
    for frac_bits in (7, 5):
        dequantized = s.node("DequantizeLinear", weight, *s.scale(frac_bits))
        x = s.pair(s.node("Conv", x, dequantized, bias, pads=[1] * 4))
    return x


def test_weights_may_be_read_at_two_scales_but_not_computed_by_other_nodes() -> None:
    """An optimiser that stores equal bytes once shares constants. The board has two copies."""
    assert AGAIN in remedies(computed_weights)["int8 constants"]
    assert remedies(shared_weights) == {}
