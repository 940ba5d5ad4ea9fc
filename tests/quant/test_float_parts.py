"""A file that hides a float network around an integer core does not pass as INT8."""

import numpy as np
import onnx
import pytest
from numpy.typing import ArrayLike

from beers_deploy.quant.float_parts import float_layers_check, float_note
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.structure import structure_checks
from tests.quant.quick import quantized_freely
from tests.quant.simplify.networks import parsed
from tests.shipped import shipped_pair

HIDDEN = {
    "in front": "y = Conv(x, w)",
    "behind": "y = Conv(dq, w)",
    "a product of matrices": "y = MatMul(x, m)",
}
CONSTANTS: dict[str, ArrayLike] = {
    "unit": 2.0**-7,
    "zero": np.int8(0),
    "w": np.full((1, 1, 1, 1), 0.5),
    "m": np.eye(8),
    "none": 0.0,
}


def decoy(hidden: str) -> onnx.ModelProto:
    """Return a float layer, next to a quantised one whose result has no effect."""
    nodes = f"""
        q = QuantizeLinear(x, unit, zero)
        dq = DequantizeLinear(q, unit, zero)
        {HIDDEN[hidden]}
        nothing = Mul(dq, none)
        z = Add(y, nothing)
    """
    return parsed(nodes, "float[1,1,8,8] x => float[1,1,8,8] z", constants=CONSTANTS)


@pytest.mark.parametrize("hidden", HIDDEN)
def test_a_float_layer_is_counted(hidden: str) -> None:
    check = float_layers_check(decoy(hidden))
    assert (check.value, check.passed) == (1, False)
    (note,) = float_note(decoy(hidden))
    assert "Add" in note


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-half-xs"])
def test_a_file_of_ours_has_none(name: str) -> None:
    model = load_onnx(shipped_pair(name)[1])
    assert float_layers_check(model).passed
    assert float_note(model) == []


@pytest.mark.parametrize("per_channel", [False, True])
def test_a_file_of_another_quantizer_has_none(
    per_channel: bool, float_onnx: onnx.ModelProto
) -> None:
    assert float_layers_check(quantized_freely(float_onnx, per_channel=per_channel)).passed


def test_one_float_layer_is_reported() -> None:
    generator = np.random.default_rng(0)
    shapes = {"first": (4, 1, 3, 3), "second": (1, 4, 3, 3)}
    model = parsed(
        """[kept] a = Conv<pads=[1,1,1,1]>(image, first)
        b = Relu(a)
        y = Conv<pads=[1,1,1,1]>(b, second)""",
        "float[N,1,H,W] image => float[N,1,H,W] y",
        constants={name: generator.normal(0, 0.2, shape) for name, shape in shapes.items()},
    )
    partly = quantized_freely(model, nodes_to_exclude=["kept"])
    checks = {check.name: check for check in structure_checks(model, partly)}
    assert not checks["layers computed in float"].passed
