"""An operator of another domain, or of a function of the file, is refused whatever its name and
place.
"""

from itertools import cycle, product
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.shipped import board_names, npu_names
from beers_deploy.quant.domains import INTEGER_OPERATORS, is_foreign, operator_name
from beers_deploy.quant.graph import refusal
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.verbs.check import check
from tests.deploy.dpu.graphs import SAME
from tests.quant.simplify.networks import parsed

BOARDS = [*board_names(), *npu_names()]
DOMAINS = ["my.ops", "com.microsoft", "com.microsoft.nchwc", "pkg.torch.local"]
PLACES = ["front", "behind a convolution", "between", "behind a host's node", "end"]


def network(path: Path, place: str, domain: str) -> Path:
    """Write a network of DPU operators and host parts, with `domain` for the one at `place`."""

    def kind(position: str, op_type: str) -> str:
        return f"{domain}.{op_type}" if position == place else op_type

    nodes = f"""
        scaled = {kind("front", "Mul")}(image, half)
        a = {SAME}(scaled, w) first = {kind("behind a convolution", "Relu")}(a)
        b = {SAME}(first, w) sum = {kind("between", "Add")}(first, b) deep = {SAME}(sum, w)
        back = Clip(deep, low, high) behind = {kind("behind a host's node", "Mul")}(back, high)
        y = {kind("end", "Clip")}(behind, low, high)
    """
    constants = {"w": np.zeros((8, 8, 3, 3)), "half": 0.5, "low": 0.0, "high": 1.0}
    model = parsed(nodes, "float[N,8,H,W] image => float[N,8,H,W] y", constants=constants)
    model.opset_import.append(helper.make_opsetid(domain, 1))
    onnx.save_model(model, path)
    return path


@pytest.mark.parametrize(
    ("case", "board"), [*zip(product(PLACES, DOMAINS), cycle(BOARDS), strict=False)]
)
def test_a_foreign_domain_is_not_legal_and_not_run(
    tmp_path: Path, case: tuple[str, str], board: str
) -> None:
    place, domain = case
    path = network(tmp_path / "a.onnx", place, domain)
    (node,) = (node for node in onnx.load_model(path).graph.node if node.domain == domain)
    result = check(path, target=board, tile=64)
    (refusing,) = (placed for placed in result.refused if placed.op.name == node.name)
    assert not result
    assert f"{domain}::{node.op_type}" in refusing.broken[0].finding.reason
    for message in (refusal(result.network.model), refused_by_load(path)):
        assert f"{node.op_type} {node.name} of {domain!r}" in message


def refused_by_load(path: Path) -> str:
    with pytest.raises(ModelError) as caught:
        load_onnx(path)
    return str(caught.value)


def test_the_same_network_without_another_domain_is_legal(tmp_path: Path) -> None:
    assert check(network(tmp_path / "a.onnx", "nowhere", "my.ops"), tile=64)


@given(
    st.sampled_from(sorted(INTEGER_OPERATORS)), st.sampled_from(["", "ai.onnx", "com.microsoft"])
)
def test_onnxruntimes_operators_on_integers_keep_their_names(op_type: str, domain: str) -> None:
    node = helper.make_node(op_type, ["x"], ["y"], domain=domain)
    assert operator_name(node) == op_type
    assert is_foreign(operator_name(node, {(domain, op_type)}))
    node.domain = "com.microsoft"
    node.attribute.append(helper.make_attribute("channels_last", 1))
    assert operator_name(node) == f"com.microsoft::{op_type}"
