"""A network in training mode is refused wherever it is run; the same nodes in use are folded as
before.
"""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile
from onnx import NodeProto, helper, numpy_helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx
from tests.deploy.command_line import refused
from tests.quant.simplify.networks import made

RATIO = numpy_helper.from_array(np.array(0.5, np.float32))


def constant(value: object, name: str) -> NodeProto:
    return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(value)))


def dropout(*mode: NodeProto, **about: Any) -> list[NodeProto]:
    inputs = ["c", "ratio", "mode"] if mode else ["c"]
    ratio = [helper.make_node("Constant", [], ["ratio"], value=RATIO)] if mode else []
    return [*ratio, *mode, helper.make_node("Dropout", inputs, ["d"], name="drop", **about)]


def normalisation(*more: str, **about: Any) -> list[NodeProto]:
    inputs = ["c", "gain", "offset", "mean", "variance"]
    return [helper.make_node("BatchNormalization", inputs, ["d", *more], name="normalise", **about)]


def network(nodes: list[NodeProto], opset: int = 17) -> onnx.ModelProto:
    first = helper.make_node("Conv", ["x", "w", "b"], ["c"], name="first", pads=[1, 1, 1, 1])
    return made([first, *nodes, helper.make_node("Relu", ["d"], ["y"], name="last")], opset)


TRAINING = {
    "dropout": network(dropout(constant(True, "mode"))),
    "dropout of a mode that is computed": network(
        dropout(constant(True, "on"), helper.make_node("Identity", ["on"], ["mode"]))
    ),
    "normalisation": network(normalisation("new mean", "new variance", training_mode=1)),
    "normalisation by its outputs": network(normalisation("m", "v", "sm", "sv"), 9),
    "old dropout": network(dropout(), 6),
}
IN_USE = {
    "dropout": network(dropout(constant(False, "mode"))),
    "dropout without a mode": network(dropout()),
    "normalisation": network(normalisation(training_mode=0)),
    "normalisation before modes": network(normalisation(), 9),
}


@pytest.mark.parametrize("name", TRAINING)
def test_training_mode_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    path = tmp_path / "network.onnx"
    path.write_bytes(TRAINING[name].SerializeToString())
    with pytest.raises(ModelError, match=r"in training mode.*model\.eval") as caught:
        load_onnx(path)
    assert str(caught.value).isprintable()
    load_onnx(path, to_run=False)


@pytest.mark.parametrize("name", IN_USE)
def test_the_same_nodes_in_use_are_folded(name: str, tmp_path: Path) -> None:
    path = tmp_path / "network.onnx"
    path.write_bytes(IN_USE[name].SerializeToString())
    assert [node.op_type for node in load_onnx(path).graph.node] == ["Conv", "Relu"]


@pytest.mark.parametrize("name", ["dropout", "normalisation"])
def test_no_command_runs_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "network.onnx"
    image = tmp_path / "image.tif"
    out = tmp_path / "out.tif"
    path.write_bytes(TRAINING[name].SerializeToString())
    tifffile.imwrite(
        image,
        np.full((4, 40, 50), 900, np.uint16),
        photometric="minisblack",
        planarconfig="separate",
    )
    int8 = tmp_path / "int8.onnx"
    for words in (
        ("quantize", path, "--out", int8),
        ("gate", path, path),
        ("restore", image, out, "--network", path),
    ):
        assert "in training mode" in refused(*words)
    assert not int8.exists()
    assert not out.exists()
