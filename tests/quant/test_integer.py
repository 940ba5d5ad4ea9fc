"""The integer reference: the documented arithmetic, equal to the runtime bit for bit but for tie
rounding.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import board_model
from beers_deploy.quant.graph import CORRECTION, PLANES, PLANES_FRAC_BITS, Activation, Add
from beers_deploy.quant.host_part import IMAGE_SLICES
from beers_deploy.quant.integer.reference import correction, run_core
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.session import open_session
from tests.quant.quick import image


def by_runtime(quantized: Quantized, planes: np.ndarray) -> np.ndarray:
    feed = {PLANES: planes.astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)}
    return np.asarray(open_session(board_model(quantized.core, {})).run(None, feed)[0])


@pytest.mark.parametrize("shape", [(37, 53), (1, 1), (1, 40), (64, 33)])
def test_it_equals_the_runtime_bit_for_bit_under_the_runtime_s_rounding(
    shape: tuple[int, int], quantized: Quantized
) -> None:
    for seed in range(3):
        planes = IMAGE_SLICES.encode(image(*shape, seed))
        np.testing.assert_array_equal(
            correction(quantized.core, planes, half_even=True), by_runtime(quantized, planes)
        )


def one_conv(weight: int, bias: int, cut: int, activation: Activation = Activation.none) -> IntCore:
    weights = np.full((1, 1, 1, 1), weight, np.int8)
    biases = np.array([bias], np.int8)
    op = IntConv("c", PLANES, CORRECTION, weights, 0, biases, 0, activation)
    return IntCore((op,), {PLANES: 0, CORRECTION: -cut})


def values(core: IntCore, inputs: ArrayLike, half_even: bool = False) -> np.ndarray:
    planes = np.array(inputs, np.int8)[None, None, None]
    return run_core(core, planes, half_even)[0][CORRECTION].ravel()


@pytest.mark.parametrize(("weight", "cut"), [(1, 2), (3, 1), (127, 0)])
def test_halves_go_up_and_in_the_runtime_to_even_within_int8(weight: int, cut: int) -> None:
    inputs = np.arange(-128, 128)
    exact = inputs * weight / 2**cut
    core = one_conv(weight, 0, cut)
    half_up = np.floor(exact + 0.5).clip(-128, 127)
    np.testing.assert_array_equal(values(core, inputs), half_up)
    to_even = np.rint(exact).clip(-128, 127)
    np.testing.assert_array_equal(values(core, inputs, half_even=True), to_even)


def test_bias_is_aligned_and_relu_comes_before_the_shift() -> None:
    (op,) = one_conv(1, 3, 1, Activation.relu).convolutions
    # The bias is aligned to the product: 3 << 2 = 12.
    aligned = IntCore((replace(op, bias_frac_bits=-2),), {PLANES: 0, CORRECTION: -1})
    assert values(aligned, [-20, -12, -10, 0, 10]).tolist() == [0, 0, 1, 6, 11]


def test_an_add_aligns_to_the_finer_scale() -> None:
    (op,) = one_conv(1, 0, 0).convolutions
    whole = replace(op, output="x")
    halved = replace(op, output="y", weight_frac_bits=1)
    ops = (whole, halved, Add("a", ("x", "y"), CORRECTION))
    core = IntCore(ops, {PLANES: 0, "x": 0, "y": 1, CORRECTION: 0})
    # The sum of v and v / 2 is 1.5 v, rounded half up.
    assert values(core, [-3, -1, 0, 1, 2, 3, 100]).tolist() == [-4, -1, 0, 2, 3, 5, 127]
