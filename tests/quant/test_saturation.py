"""Tests that values clipped at the ends of 8 bits are counted in any encoding."""

from collections.abc import Callable

import numpy as np
import onnx
import pytest

from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.graph import CORRECTION
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.structure import rounded_tensors, saturated_shares
from tests.quant.quick import uniform
from tests.quant.simplify.networks import parsed
from tests.shipped import shipped_pair

IMAGE = uniform(2, 1, 37, 43, seed=3)
Lost = Callable[[np.ndarray], np.ndarray]
ENDS = "float[N,1,H,W] image => float[N,1,H,W] restored"


QDQ = "whole = QuantizeLinear(image, {0}) restored = DequantizeLinear(whole, {0})"
RELU = """whole = QuantizeLinear(image, {0})
    positive = Max(whole, zero)
    restored = DequantizeLinear(positive, {0})"""
TWICE = """whole = QuantizeLinear(image, {0})
    float = DequantizeLinear(whole, {0})
    positive = Relu(float)
    again = QuantizeLinear(positive, {0})
    restored = DequantizeLinear(again, {0})"""


def rounded(nodes: str, scale: float, zero_point: np.ndarray | None) -> onnx.ModelProto:
    """Return a network that rounds the image to 8 bits and back."""
    names = "scale" if zero_point is None else "scale, zero"
    constants = {"scale": np.float32(scale), "zero": zero_point}
    return parsed(nodes.format(names), ENDS, constants=constants)


@pytest.mark.parametrize(
    ("zero_point", "nodes", "expected_lost"),
    [
        (np.array(0, np.int8), QDQ, lambda v: (v >= 126.5) | (v <= -127.5)),
        (np.array(128, np.uint8), QDQ, lambda v: (v >= 126.5) | (v <= -127.5)),
        (np.array(0, np.uint8), QDQ, lambda v: v >= 254.5),
        (None, QDQ, lambda v: v >= 254.5),
        (np.array(0, np.int8), RELU, lambda v: v >= 126.5),
    ],
    ids=["int8", "uint8 around 128", "uint8 from 0", "no zero point", "a ReLU reads it"],
)
def test_shares_are_those_of_the_clipped_values(
    zero_point: np.ndarray | None, nodes: str, expected_lost: Lost
) -> None:
    signed = (IMAGE - 0.5) * 2
    shares = saturated_shares(rounded(nodes, 1 / 400, zero_point), [signed[:1], signed[1:]])
    assert shares == {"whole": pytest.approx(expected_lost(400 * signed).mean(), abs=1e-3)}
    assert shares["whole"] > 0.1
    assert saturated_shares(rounded(nodes, 1 / 120, zero_point), [IMAGE]) == {"whole": 0.0}


def test_a_relu_between_two_roundings_reads_the_first() -> None:
    """Values below zero are no loss, because the Relu behind DequantizeLinear would clip them."""
    model = rounded(TWICE, 1 / 400, np.array(0, np.int8))
    signed = (IMAGE - 0.5) * 2
    shares = saturated_shares(model, [signed])
    lost_share = float((signed * 400 >= 126.5).mean())
    assert shares == {
        "whole": pytest.approx(lost_share, abs=1e-3),
        "again": pytest.approx(lost_share, abs=1e-3),
    }


def test_the_shipped_file_saturates_as_the_integer_reference_says() -> None:
    model = load_onnx(shipped_pair("convbeers-xs")[1])
    # Edges between 0 and 1 are the strongest that an image can have.
    harsh = np.where(IMAGE > 0.5, 1.0, 0.0).astype(np.float32)
    shares = saturated_shares(model, [harsh])
    core = read_core(model)
    _, reports = run_core(core, core.host_part.encode(harsh), half_even=True)
    outputs = {op.name: op.output for op in core.ops}
    expected = {outputs[r.name]: r.saturated for r in reports if outputs[r.name] != CORRECTION}
    plain = {name: share for name, share in shares.items() if name in expected}
    assert plain == {name: pytest.approx(expected[name]) for name in plain}
    assert len(plain) >= 12
    assert max(plain.values()) > 0.001


def test_a_float_network_has_nothing_to_saturate() -> None:
    model = parsed("restored = Relu(image)", ENDS)
    assert rounded_tensors(model) == []
    assert saturated_shares(model, [IMAGE]) == {}
