"""Tests that unusual files are read correctly, or refused in a sentence that names the node."""

from pathlib import Path

import onnx
import pytest
from onnx import helper
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import read_sized_graph
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx, read_onnx
from tests.quant.quick import assert_same, uniform
from tests.quant.simplify.networks import CONV, NORMAL, network_from

LIGHT = sorted((Path(onnx.__file__).parent / "backend" / "test" / "data" / "light").glob("*.onnx"))
SMALL = [path for path in LIGHT if path.stem.removeprefix("light_") in ("shufflenet", "squeezenet")]


def saved(model: onnx.ModelProto, folder: Path) -> Path:
    path = folder / "a.onnx"
    path.write_bytes(model.SerializeToString())
    return path


# A network with an If, whose condition follows from the image.
CHOICE = """m = ReduceMax<keepdims=0>(x)
    lit = Cast<to=9>(m)
    f = If(lit)<
        then_branch = one () => (float[1] a) { a = Constant<value = float[1] {1}>() },
        else_branch = two () => (float[1] b) { b = Constant<value = float[1] {2}>() }
    >
    y = Mul(x, f)"""


def foreign() -> onnx.ModelProto:
    """Return a network with an operator of an unknown domain."""
    model = network_from("y = org.elsewhere.Mystery(x)")
    model.opset_import.append(helper.make_opsetid("org.elsewhere", 1))
    return model


@pytest.mark.parametrize(
    ("model", "words"),
    [(network_from(CHOICE), "If f in .* contains a graph"), (foreign(), "Mystery y of")],
)
def test_a_file_that_no_runtime_may_open_is_refused_and_can_be_inspected(
    model: onnx.ModelProto, words: str, tmp_path: Path
) -> None:
    path = saved(model, tmp_path)
    with pytest.raises(ModelError, match=words):
        load_onnx(path)
    refused = [
        placement.op.op_type.rpartition("::")[2]
        for placement in place(read_sized_graph(path, 32), load_dpu("vck190")).failed
    ]
    assert words.split()[0] in refused


@pytest.mark.parametrize("batch", ["N", 1, 3])
def test_any_batch_is_read(batch: str | int, tmp_path: Path) -> None:
    model = network_from(f"{CONV} n {NORMAL} y = Relu(n)")
    first = model.graph.input[0].type.tensor_type.shape.dim[0]
    first.CopyFrom(onnx.TensorShapeProto.Dimension())
    setattr(first, "dim_param" if isinstance(batch, str) else "dim_value", batch)
    short = load_onnx(saved(model, tmp_path))
    assert short.graph.input[0].type.tensor_type.shape.dim[0] == first
    count = 2 if isinstance(batch, str) else batch
    assert_same(model, short, uniform(count, 4, 5, 7), rtol=1e-5, atol=1e-5)


def test_a_result_may_have_no_sizes(tmp_path: Path) -> None:
    model = network_from(f"{CONV} y = Relu(c)")
    model.graph.output[0].type.tensor_type.ClearField("shape")
    assert_same(model, load_onnx(saved(model, tmp_path)), uniform(1, 4, 5, 7))


def test_check_and_quantize_refuse_a_file_that_cannot_be_simplified(tmp_path: Path) -> None:
    """onnxruntime runs no two nodes of one name."""
    model = network_from(f"{CONV} y = Relu(c)", opset=18)
    for node in model.graph.node:
        node.name = "node"
    with pytest.raises(ModelError, match="two nodes with same node name"):
        load_onnx(saved(model, tmp_path))
    result = CliRunner().invoke(app, ["check", str(saved(model, tmp_path))])
    assert (result.exit_code, "same node name" in result.output) == (1, True)


def test_an_operator_that_no_opset_has_is_named() -> None:
    model = network_from(f"{CONV} y = Relu(c)")
    model.graph.node[1].op_type = "Erfc"
    with pytest.raises(ModelError, match="Erfc Relu y, but ONNX has no such operator"):
        read_onnx(model.SerializeToString(), "a.onnx")


@pytest.mark.parametrize("path", SMALL, ids=lambda path: path.stem)
def test_known_architectures_are_read_and_judged(path: Path) -> None:
    """These are the smaller of onnx's nine light models: opset 9, weights filled by nodes.

    The others behave the same.
    """
    result = CliRunner().invoke(app, ["check", str(path), "--tile", "224"])
    assert result.exit_code in (0, 1)
    assert "check passed" in result.output or "nodes the DPU refuses" in result.output
