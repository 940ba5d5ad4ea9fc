"""Tests of the integer reference: its rounding of ties, saturation, biases and sums."""

from dataclasses import replace

import numpy as np

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, Add
from beers_deploy.quant.host_part import IMAGE_SLICES
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.quantize import Quantized
from tests.quant.quick import image


def test_under_the_dpu_s_rounding_it_differs_by_halves_alone(quantized: Quantized) -> None:
    """The first layer's differences are its ties, one unit up; later layers carry them on."""
    planes = IMAGE_SLICES.encode(image())
    up, reports = run_core(quantized.core, planes)
    even, _ = run_core(quantized.core, planes, half_even=True)
    first = quantized.core.ops[0].output
    difference = up[first] - even[first]
    assert set(np.unique(difference)) <= {0, 1}
    assert 0 < (difference == 1).mean() <= reports[0].ties
    assert np.abs(up[CORRECTION] - even[CORRECTION]).max() <= 8


def one_conv(weight: int, bias: int, cut: int, activation: Activation = Activation.none) -> IntCore:
    op = IntConv(
        "c",
        PLANES,
        CORRECTION,
        np.full((1, 1, 1, 1), weight, np.int8),
        0,
        np.array([bias], np.int8),
        0,
        activation,
    )
    return IntCore((op,), {PLANES: 0, CORRECTION: -cut})


def values(core: IntCore, inputs: list[int], half_even: bool = False) -> list[int]:
    planes = np.array(inputs, np.int8)[None, None, None]
    return [int(v) for v in run_core(core, planes, half_even)[0][CORRECTION].ravel()]


def test_halves_go_up_and_in_the_runtime_to_even() -> None:
    inputs = [-6, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 6]
    assert values(one_conv(1, 0, 2), inputs) == [-1, -1, -1, -1, 0, 0, 0, 0, 1, 1, 1, 1, 2]
    assert values(one_conv(1, 0, 2), inputs, half_even=True) == [
        -2,
        -1,
        -1,
        -1,
        0,
        0,
        0,
        0,
        0,
        1,
        1,
        1,
        2,
    ]


def test_products_saturate_at_int8_s_ends() -> None:
    assert values(one_conv(127, 0, 0), [-128, -1, 0, 1, 127]) == [-128, -127, 0, 127, 127]


def test_bias_is_aligned_and_relu_comes_before_the_shift() -> None:
    op = one_conv(1, 3, 1, Activation.relu).ops[0]
    assert isinstance(op, IntConv)
    # The bias is aligned to the product: 3 << 2 = 12.
    aligned = IntCore((replace(op, bias_frac_bits=-2),), {PLANES: 0, CORRECTION: -1})
    assert values(aligned, [-20, -12, -10, 0, 10]) == [0, 0, 1, 6, 11]


def test_an_add_aligns_to_the_finer_scale() -> None:
    add = Add("a", ("x", "y"), CORRECTION)
    ops = (
        IntConv("x", PLANES, "x", np.ones((1, 1, 1, 1), np.int8), 0, np.zeros(1, np.int8), 0),
        IntConv("y", PLANES, "y", np.ones((1, 1, 1, 1), np.int8), 1, np.zeros(1, np.int8), 0),
        add,
    )
    core = IntCore(ops, {PLANES: 0, "x": 0, "y": 1, CORRECTION: 0})
    # x is v without a fractional bit. y is v with one, which is v / 2. The sum is 1.5 v, rounded
    # half up.
    assert values(core, [-3, -1, 0, 1, 2, 3, 100]) == [-4, -1, 0, 2, 3, 5, 127]
