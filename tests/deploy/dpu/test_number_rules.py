from collections.abc import Mapping

import pytest

from deploy.dpu.board import load_dpu
from deploy.dpu.checker import number_rules
from deploy.dpu.checker.finding import Rule
from deploy.dpu.graph import Kind, Operation, Scale

DPU = load_dpu("vck190")


def at(frac_bits: int) -> Scale:
    return Scale((2.0**-frac_bits,), (0,), "int8")


def operation(kind: Kind, **frac_bits: int) -> Operation:
    scales: Mapping[str, Scale] = {role.replace("_", " "): at(p) for role, p in frac_bits.items()}
    inputs = tuple(role for role in scales if role.startswith("input"))
    return Operation("op", kind, kind, inputs, ("out",), integer=True, scales=scales)


@pytest.mark.parametrize(
    ("rule", "inside", "outside"),
    [
        (
            number_rules.shift_cut,
            {"input_0": 7, "weight": 16, "output": 7},
            {"input_0": 7, "weight": 17, "output": 7},
        ),
        (number_rules.shift_cut, {"input_0": 7, "weight": 0, "output": 7}, {"input_0": 7, "weight": 0, "output": 8}),
        (
            number_rules.shift_bias,
            {"input_0": 7, "weight": 7, "output": 7, "bias": 23},  # -9 with shift_cut 7: at least -9
            {"input_0": 7, "weight": 7, "output": 7, "bias": 24},
        ),
        (
            number_rules.shift_bias,
            {"input_0": 7, "weight": 7, "output": 7, "bias": -2},
            {"input_0": 7, "weight": 7, "output": 7, "bias": -3},
        ),
        (number_rules.shift_read, {"input_0": 15, "input_1": 0}, {"input_0": 16, "input_1": 0}),
        (number_rules.shift_write, {"input_0": 7, "output": -8}, {"input_0": 7, "output": -9}),
        (number_rules.shift_write, {"input_0": 7, "output": 22}, {"input_0": 7, "output": 23}),
        (number_rules.same_scale, {"input_0": 5, "output": 5}, {"input_0": 5, "output": 6}),
    ],
)
def test_windows_hold_at_their_ends(rule: Rule, inside: dict[str, int], outside: dict[str, int]) -> None:
    assert rule(operation("add", **inside), DPU) is None
    assert rule(operation("add", **outside), DPU) is not None


def test_only_a_bias_may_be_int32() -> None:
    for role, kept in (("bias", True), ("input 0", False), ("output", False)):
        op = Operation(
            "op", "Conv", "conv", ("in",), ("out",), integer=True, scales={role: Scale((0.5,), (0,), "int32")}
        )
        assert (number_rules.symmetric(op, DPU) is None) == kept


@pytest.mark.parametrize(
    ("rule", "scale", "kept"),
    [
        (number_rules.symmetric, Scale((0.5,), (128,), "uint8"), True),
        (number_rules.symmetric, Scale((0.5,), (0,), "uint8"), False),
        (number_rules.symmetric, Scale((0.5,), (3,), "int8"), False),
        (number_rules.symmetric, Scale((0.5,), (0,), "int16"), False),
        (number_rules.per_tensor, Scale((0.5, 0.25), (0, 0), "int8"), False),
        (number_rules.power_of_two, Scale((0.5,), (0,), "int8"), True),
        (number_rules.power_of_two, Scale((0.3,), (0,), "int8"), False),
        (number_rules.power_of_two, Scale((0.0,), (0,), "int8"), False),
        (number_rules.power_of_two, Scale((float("inf"),), (0,), "int8"), False),
        (number_rules.power_of_two, Scale((float("nan"),), (0,), "int8"), False),
    ],
)
def test_formats(rule: Rule, scale: Scale, kept: bool) -> None:
    op = Operation("op", "Conv", "conv", ("in",), ("out",), integer=True, scales={"weight": scale})
    assert (rule(op, DPU) is None) == kept
