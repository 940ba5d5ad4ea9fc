"""Nodes in any order are read as if they were sorted, and cycles are refused."""

import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx.node_order import sort_nodes
from beers_deploy.quant.onnx_file import parse_onnx
from tests.quant.quick import assert_same, copied, image
from tests.quant.simplify.networks import parsed


def network() -> onnx.ModelProto:
    """Build a chain of eight nodes that read the image again."""
    nodes = """
        a = Mul(image, half) b = Add(a, image) c = Mul(b, half) d = Add(c, image)
        e = Mul(d, half) f = Add(e, image) g = Mul(f, half) last = Add(g, image)
    """
    ends = "float[N,1,H,W] image => float[N,1,H,W] last"
    return parsed(nodes, ends, constants={"half": 0.5})


@settings(max_examples=30)
@given(st.permutations(range(8)))
def test_nodes_in_any_order_compute_the_same(order: list[int]) -> None:
    model = network()
    mixed = copied(model)
    nodes = [model.graph.node[number] for number in order]
    del mixed.graph.node[:]
    mixed.graph.node.extend(nodes)
    read = parse_onnx(mixed.SerializeToString(), "a.onnx")
    onnx.checker.check_model(read)
    assert_same(model, read, image())


def test_sorted_nodes_stay_as_they_are() -> None:
    model = network()
    before = model.SerializeToString(deterministic=True)
    sort_nodes(model.graph)
    assert model.SerializeToString(deterministic=True) == before


def test_a_cycle_is_refused() -> None:
    model = network()
    model.graph.node[0].input[0] = model.graph.node[-1].output[0]
    with pytest.raises(ModelError, match=r"a\.onnx is not an ONNX file"):
        parse_onnx(model.SerializeToString(), "a.onnx")
