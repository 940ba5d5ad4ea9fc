"""Nodes in any order are read as if they were sorted, and cycles are refused."""

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx.node_order import sort_nodes
from beers_deploy.quant.onnx_file import GraphWriter, make_model, parse_onnx
from tests.quant.quick import assert_same, copied, image


def network() -> onnx.ModelProto:
    """Build a chain of eight nodes that read the image again."""
    w = GraphWriter()
    last = "image"
    for number in range(4):
        factor = w.constant(f"factor{number}", np.array(number + 0.5, np.float32))
        scaled = w.node("Mul", f"scaled{number}", [last, factor])
        last = w.node("Add", f"sum{number}", [scaled, "image"])
    return make_model(
        w.graph("chain", [image_info("image", 1, None)], [image_info(last, 1, None)]), {}
    )


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
