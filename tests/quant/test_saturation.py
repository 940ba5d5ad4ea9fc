"""What comes to the ends of 8 bits is counted, in any encoding, and what is no loss is not."""

from collections.abc import Callable

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.graph import CORRECTION
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.onnx_file import image_info, load_onnx, make_model
from beers_deploy.quant.structure import rounded_tensors, saturated_shares
from tests.shipped import shipped_pair

IMAGE = np.random.default_rng(3).random((2, 1, 37, 43), dtype=np.float32)
Lost = Callable[[np.ndarray], np.ndarray]
RESTORED = image_info("restored", 1, None)


def qdq(scale: float, zero_point: np.ndarray | None, relu: bool = False) -> onnx.ModelProto:
    """The image, rounded to 8 bits and back."""
    stored = [numpy_helper.from_array(np.array(scale, np.float32), "scale")]
    names = ["scale"]
    if zero_point is not None:
        stored.append(numpy_helper.from_array(zero_point, "zero"))
        names.append("zero")
    nodes = [helper.make_node("QuantizeLinear", ["image", *names], ["whole"])]
    nodes += [helper.make_node("Max", ["whole", "zero"], ["positive"])] if relu else []
    nodes += [
        helper.make_node(
            "DequantizeLinear", ["positive" if relu else "whole", *names], ["restored"]
        )
    ]
    return make_model(
        helper.make_graph(nodes, "qdq", [image_info("image", 1, None)], [RESTORED], stored), {}
    )


@pytest.mark.parametrize(
    ("zero_point", "relu", "expected_lost"),
    [
        (np.array(0, np.int8), False, lambda v: (v >= 126.5) | (v <= -127.5)),
        (np.array(128, np.uint8), False, lambda v: (v >= 126.5) | (v <= -127.5)),
        (np.array(0, np.uint8), False, lambda v: v >= 254.5),
        (None, False, lambda v: v >= 254.5),
        (np.array(0, np.int8), True, lambda v: v >= 126.5),
    ],
    ids=["int8", "uint8 around 128", "uint8 from 0", "no zero point", "a ReLU reads it"],
)
def test_shares_are_those_of_the_values(
    zero_point: np.ndarray | None, relu: bool, expected_lost: Lost
) -> None:
    scale = 1 / 400
    signed = (IMAGE - 0.5) * 2
    shares = saturated_shares(qdq(scale, zero_point, relu), [signed[:1], signed[1:]])
    assert shares == {
        "whole": pytest.approx(expected_lost(signed / np.float32(scale)).mean(), abs=1e-3)
    }
    assert shares["whole"] > 0.1
    assert saturated_shares(qdq(1 / 120, zero_point, relu), [IMAGE]) == {"whole": 0.0}


def test_a_relu_between_two_roundings_reads_the_first() -> None:
    """QuantizeLinear, DequantizeLinear, Relu, QuantizeLinear: what is below
    zero was to be cut off.
    """
    model = qdq(1 / 400, np.array(0, np.int8))
    model.graph.node[1].output[0] = "float"
    model.graph.node.extend(
        [
            helper.make_node("Relu", ["float"], ["positive"]),
            helper.make_node("QuantizeLinear", ["positive", "scale", "zero"], ["again"]),
            helper.make_node("DequantizeLinear", ["again", "scale", "zero"], ["restored"]),
        ]
    )
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


def test_a_scale_that_fits_saturates_nothing_and_a_float_network_has_nothing_to_saturate() -> None:
    assert saturated_shares(qdq(1 / 120, np.array(0, np.int8)), [IMAGE]) == {"whole": 0.0}
    node = helper.make_node("Relu", ["image"], ["restored"])
    model = make_model(
        helper.make_graph([node], "float", [image_info("image", 1, None)], [RESTORED]), {}
    )
    assert rounded_tensors(model) == []
    assert saturated_shares(model, [IMAGE]) == {}
