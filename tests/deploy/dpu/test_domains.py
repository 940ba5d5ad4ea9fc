"""An operator of another domain, or of a function of the file, is refused whatever its name and
place.
"""

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
from tests.deploy.dpu.graphs import Sketch

BOARDS = [*board_names(), *npu_names()]
DOMAINS = ["my.ops", "com.microsoft", "com.microsoft.nchwc", "pkg.torch.local"]
PLACES = ["front", "behind a convolution", "between", "behind a host's node", "end"]


def network(path: Path, place: str, domain: str) -> Path:
    """Write a network of DPU operators and host parts, with `domain` for the one at `place`."""
    sketch = Sketch(8)

    def node(position: str, op_type: str, *inputs: str) -> str:
        return sketch.node(op_type, *inputs, domain=domain if position == place else "")

    scaled = node("front", "Mul", "image", sketch.constant(np.array(0.5, np.float32)))
    first = node("behind a convolution", "Relu", sketch.conv(scaled))
    deep = sketch.conv(node("between", "Add", first, sketch.conv(first)))
    limits = sketch.constant(np.array(0, np.float32)), sketch.constant(np.array(1, np.float32))
    back = sketch.node("Clip", deep, *limits)
    behind = node("behind a host's node", "Mul", back, limits[1])
    sketch.save(path, node("end", "Clip", behind, *limits))
    model = onnx.load_model(path)
    model.opset_import.append(helper.make_opsetid(domain, 1))
    onnx.save_model(model, path)
    return path


@given(
    place=st.sampled_from(PLACES), domain=st.sampled_from(DOMAINS), board=st.sampled_from(BOARDS)
)
def test_a_foreign_domain_is_not_legal_and_not_run(
    tmp_path_factory: pytest.TempPathFactory, place: str, domain: str, board: str
) -> None:
    path = network(tmp_path_factory.mktemp("foreign") / "a.onnx", place, domain)
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
