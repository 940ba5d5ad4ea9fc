"""Tests that a board's file leaves nothing to a default, and that the rules find omissions."""

import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import board_model, implicit_parts
from tests.quant.c_code.drawn import KINDS, cores

ATTRIBUTES, SIZES, TEXTS, PRODUCER, OPERATORS = range(5)


def parts_of(model: onnx.ModelProto) -> list[list[str]]:
    """Return what a file leaves open, in a list for each rule."""
    return list(implicit_parts(model).values())


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(max_examples=3)
def test_the_file_for_one_tile_states_everything(kind: str, data: st.DataObject) -> None:
    """The file for a board states all attributes, sizes, texts and its producer, for each
    operation.

    A reader of it for a critical system must not have to know defaults of ONNX.
    """
    core, tile_px = data.draw(cores((kind,), 2))
    model = board_model(core, {}, tile_px)
    onnx.checker.check_model(model, full_check=True)
    attributes, sizes, texts, producer, operators = parts_of(model)
    assert [attributes, sizes, texts, producer] == [[], [], [], []]
    # The operators that quantise are not in the profile's list yet.
    assert {"DequantizeLinear", "QuantizeLinear"} <= set(operators)


@given(drawn=cores())
@settings(max_examples=3)
def test_each_omission_is_named(drawn: tuple[IntCore, int]) -> None:
    """Each thing that is removed from a file is reported by its name, under its own rule."""
    core, tile_px = drawn
    assert parts_of(board_model(core, {}))[SIZES]
    model = board_model(core, {}, tile_px)
    node = next(node for node in model.graph.node if node.op_type == "Conv")
    strides = next(k for k, each in enumerate(node.attribute) if each.name == "strides")
    del node.attribute[strides]
    assert parts_of(model)[ATTRIBUTES] == [f"{node.name}: strides"]
    gone = model.graph.value_info.pop()
    assert parts_of(model)[SIZES] == [gone.name]
    model.graph.input[0].doc_string = ""
    assert parts_of(model)[TEXTS] == ["planes"]
    model.producer_version = ""
    assert parts_of(model)[PRODUCER] == ["version"]


@pytest.mark.parametrize(
    ("domain", "operator"), [("com.example", "Own"), ("ai.onnx.ml", "Binarizer")]
)
@given(drawn=cores())
@settings(max_examples=1)
def test_operators_of_other_domains_are_named(
    domain: str, operator: str, drawn: tuple[IntCore, int]
) -> None:
    """An operator that ONNX itself does not define is reported, because its meaning is open."""
    model = board_model(drawn[0], {})
    model.graph.node[0].domain = domain
    model.graph.node[0].op_type = operator
    assert operator in parts_of(model)[OPERATORS]
