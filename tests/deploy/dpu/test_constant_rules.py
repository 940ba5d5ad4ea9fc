"""Tests of the constants of integer kernels: which int32 bias the DPU can hold, and that a tensor
is read in the format in which it was written.
"""

from functools import cache

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from onnx import numpy_helper

from beers_deploy.dpu.checker import number_rules
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.graph import Operation
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.variants import Variant
from beers_deploy.quant.encodings import board_model
from beers_deploy.quant.graph.quantized import Scale
from beers_deploy.quant.quantize import Quantized, quantize_model
from tests.deploy.dpu.draws import DPU, placed, rules_of
from tests.deploy.dpu.graphs import IntegerSketch
from tests.model.networks import plain
from tests.quant.quick import copied, drawn

HALF = Scale((0.5,), (0,), "int8")


def rules(model: onnx.ModelProto) -> set[str]:
    """Return the rules that the nodes break, without the metadata that only our files have."""
    del model.metadata_props[:]
    return set(rules_of(place(sized_graph(model, 64), DPU).nodes))


@cache
def quantized(spread: float) -> Quantized:
    """Quantise a small network of random weights and of biases of standard deviation `spread`."""
    network = plain(Variant(blocks=1, features=4), seed=7)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("bias"):
                value.normal_(0, spread, generator=generator)
    return quantize_model(to_onnx(network, {}), drawn(2, seed=5), {})


def own_file() -> onnx.ModelProto:
    """Return a copy of the host's file, which a test may corrupt."""
    return copied(quantized(0.1).host)


def fits_int8(values: list[int]) -> bool:
    bias = {"bias": np.array(values, np.int32)}
    scales = dict.fromkeys(("input 0", "weight", "output"), HALF)
    op = Operation(
        "op", "QLinearConv", "conv", ("in",), ("out",), integer=True, scales=scales, constants=bias
    )
    return number_rules.int32_bias(op, DPU) is None


@given(
    st.one_of(st.lists(st.integers(-128, 127)), st.lists(st.integers(-300, 300))),
    st.integers(0, 18),
)
def test_a_bias_passes_where_some_shift_makes_it_int8(values: list[int], shift: int) -> None:
    values = [value << shift for value in values]
    # The DPU shifts by 0 to 16 bits.
    shifts = [k for k in range(17) if all(v % 2**k == 0 and -128 <= v >> k <= 127 for v in values)]
    assert fits_int8(values) == bool(shifts)


@pytest.mark.parametrize(
    ("bias", "expected"),
    [
        ([127 << 16, -128 << 16, 0, 0], set()),
        # A shift of 16 is the largest, and with it the value is 128.
        ([64 << 17, 0, 0, 0], {"int32 bias"}),
    ],
)
def test_the_bias_of_an_integer_kernel_is_checked(bias: list[int], expected: set[str]) -> None:
    s = IntegerSketch()
    inner = s.qconv(s.quantized("image"), (4, 1, 3, 3), bias=np.array(bias, np.int32))
    model = s.model(s.node("DequantizeLinear", inner, *s.numbers))
    nodes = placed(model, 20).failed
    assert set(rules_of(nodes)) == expected
    assert all("beers-deploy quantize" in node.broken[0].finding.remedy for node in nodes)


@pytest.mark.parametrize("spread", [0.1, 3.0])
def test_quantized_random_networks_keep_every_rule(spread: float) -> None:
    """The rules hold in both encodings, with biases small and large compared with the products."""
    network = quantized(spread)
    assert rules(network.host) == rules(board_model(network.core, {})) == set()


@pytest.mark.parametrize(
    ("op_type", "place"),
    [
        ("QLinearConv", 1),
        ("QLinearConv", 2),
        ("QLinearAdd", 1),
        ("QLinearAdd", 4),
        ("DequantizeLinear", 1),
    ],
)
def test_reading_a_tensor_in_another_format_than_it_was_written_is_refused(
    op_type: str, place: int
) -> None:
    """The last node of a kind reads with 4 times the scale, or with a zero point one less."""
    model = own_file()
    node = [n for n in model.graph.node if n.op_type == op_type][-1]
    value = numpy_helper.to_array(
        next(t for t in model.graph.initializer if t.name == node.input[place])
    )
    altered = value * 4 if value.dtype == np.float32 else value - 1
    model.graph.initializer.append(numpy_helper.from_array(altered.astype(value.dtype), "altered"))
    node.input[place] = "altered"
    assert "one format" in rules(model)
