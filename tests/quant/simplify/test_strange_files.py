"""What stops other readers: each file is read right, or refused by one sentence that names the
node.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import read_network
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session, tensors_of
from tests.quant.simplify.networks import conv, made, node, normal

LIGHT = sorted((Path(onnx.__file__).parent / "backend" / "test" / "data" / "light").glob("*.onnx"))
SMALL = [path for path in LIGHT if path.stem.removeprefix("light_") in ("shufflenet", "squeezenet")]


def saved(model: onnx.ModelProto, folder: Path) -> Path:
    path = folder / "a.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def branch(name: str, value: float) -> onnx.GraphProto:
    constant = helper.make_tensor(name, TensorProto.FLOAT, [1], [value])
    result = helper.make_tensor_value_info(name, TensorProto.FLOAT, [1])
    return helper.make_graph(
        [helper.make_node("Constant", [], [name], value=constant)], name, [], [result]
    )


def chosen() -> onnx.ModelProto:
    """A network with an If, whose condition follows from the image."""
    either = {"then_branch": branch("a", 1), "else_branch": branch("b", 2)}
    light = [node("ReduceMax", "x", to="m", keepdims=0), node("Cast", "m", to="lit", to_=0)]
    light[1].attribute[0].CopyFrom(helper.make_attribute("to", TensorProto.BOOL))
    return made([*light, node("If", "lit", to="f", **either), node("Mul", "x", "f")])


def foreign() -> onnx.ModelProto:
    mystery = node("Mystery", "x")
    mystery.domain = "org.elsewhere"
    model = made([mystery])
    model.opset_import.append(helper.make_opsetid("org.elsewhere", 1))
    return model


@pytest.mark.parametrize(
    ("make", "words"), [(chosen, "If f in .* contains a graph"), (foreign, "Mystery y of")]
)
def test_what_no_runtime_of_ours_may_get_is_named_and_may_be_looked_at(
    make: Callable[[], onnx.ModelProto], words: str, tmp_path: Path
) -> None:
    path = saved(make(), tmp_path)
    with pytest.raises(ModelError, match=words):
        load_onnx(path)
    refused = [
        placement.op.op_type.rpartition("::")[2]
        for placement in place(read_network(path, 32), load_dpu("vck190")).failed
    ]
    assert words.split()[0] in refused


def test_an_operator_that_onnx_does_not_have_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="Mystery"):
        load_onnx(saved(made([node("Mystery", "x")]), tmp_path))


def test_both_outputs_are_kept(tmp_path: Path) -> None:
    model = made([conv(), normal("c", "n"), node("Relu", "n"), conv("n", "z")], outputs=("z", "y"))
    short = load_onnx(saved(model, tmp_path))
    assert [output.name for output in short.graph.output] == ["z", "y"]
    assert len(read_network(tmp_path / "a.onnx", 32).outputs) == 2


@pytest.mark.parametrize("batch", ["N", 1, 3])
def test_any_batch_is_read(batch: str | int, tmp_path: Path) -> None:
    model = made([conv(), normal("c", "n"), node("Relu", "n")])
    first = model.graph.input[0].type.tensor_type.shape.dim[0]
    first.CopyFrom(onnx.TensorShapeProto.Dimension())
    setattr(first, "dim_param" if isinstance(batch, str) else "dim_value", batch)
    short = load_onnx(saved(model, tmp_path))
    assert short.graph.input[0].type.tensor_type.shape.dim[0] == first
    count = 2 if isinstance(batch, str) else batch
    image = np.random.default_rng(1).random((count, 4, 5, 7)).astype(np.float32)
    before, after = (
        tensors_of(open_session(network, 1), None, image)[0] for network in (model, short)
    )
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5)


def test_five_sizes_are_named(tmp_path: Path) -> None:
    model = made([node("Relu", "x")])
    model.graph.input[0].type.tensor_type.shape.dim.add(dim_value=3)
    model.graph.output[0].type.tensor_type.shape.dim.add(dim_value=3)
    with pytest.raises(ModelError, match=r"must be \(N, C, H, W\), got x \[0, 4, 0, 0, 3\]"):
        read_network(saved(model, tmp_path), 32)


@pytest.mark.parametrize("path", SMALL, ids=lambda path: path.stem)
def test_known_architectures_are_read_and_judged(path: Path) -> None:
    """Of opset 9, weights filled by nodes: the smaller of the nine that onnx brings, the others as
    these.
    """
    result = CliRunner().invoke(app, ["check", str(path), "--tile", "224"])
    assert result.exit_code in (0, 1)
    assert "check passed" in result.output or "nodes the DPU refuses" in result.output
