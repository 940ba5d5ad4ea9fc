"""Tests that harmful ONNX files are refused in a sentence before a runtime reads them."""

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.dpu.reading import sized_graph
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.onnx_file import load_onnx, parse_onnx
from beers_deploy.quant.session import open_session, result_of, run
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.quant.untrusted import FILE_BYTES
from tests.deploy.dpu.draws import placed
from tests.deploy.dpu.graphs import board_convbeers, float_convbeers, integer_convbeers
from tests.project_files import ROOT
from tests.quant.quick import fix_sizes
from tests.quant.simplify.networks import parsed

Change = Callable[[onnx.ModelProto], object]
IMAGE = np.full((1, 1, 12, 14), 0.25, np.float32)
ENDS = "float[N,1,H,W] image => float[N,1,P,Q] y"


@pytest.fixture
def model(tmp_path: Path) -> onnx.ModelProto:
    return onnx.load_model(float_convbeers(tmp_path / "sound.onnx", 1, 4))


def refusal(model: onnx.ModelProto, to_run: bool = True) -> str:
    """Return the message that refuses a model, and check that no runtime has read it."""
    with patch("onnxruntime.InferenceSession") as session, pytest.raises(ModelError) as caught:
        open_session(parse_onnx(model.SerializeToString(), "untrusted.onnx", to_run), 1)
    assert not session.called
    assert "untrusted.onnx" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("encoding", [float_convbeers, integer_convbeers, board_convbeers])
def test_valid_files_of_every_encoding_run(encoding: Callable[..., Path], tmp_path: Path) -> None:
    path = encoding(tmp_path / "a.onnx", blocks=1, features=4)
    assert run(open_session(path, 1), IMAGE).shape == IMAGE.shape


@pytest.mark.parametrize("external", [True, False], ids=["external", "next to stored weights"])
@pytest.mark.parametrize(
    "place", ["/etc/passwd", "../secret.bin", "beside.bin", "a/../../b", "link.bin", ""]
)
def test_weights_in_other_files_are_never_opened(
    place: str, external: bool, model: onnx.ModelProto
) -> None:
    tensor = model.graph.initializer[0]
    tensor.external_data.add(key="location", value=place)
    if external:
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
    with patch("onnx.checker.check_model") as checker:
        assert f"in another file, {place!r}" in refusal(model)
    assert not checker.called


def stating(*dims: int) -> Change:
    def change(model: onnx.ModelProto) -> None:
        del model.graph.initializer[0].dims[:]
        model.graph.initializer[0].dims.extend(dims)

    return change


def sized(*dims: int) -> Change:
    return lambda model: fix_sizes(model.graph.input[0], *dims)


def typed(kind: int) -> Change:
    return lambda model: setattr(model.graph.initializer[0], "data_type", kind)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (stating(10**6, 10**6, 10**6), "1000000 x 1000000 x 1000000"),
        (stating(-4, 1, 3, 3), "each 0 or more"),
        (stating(4, 1, 3, 4), "holds 36"),
        (stating(*[1] * 17), "at most 16 dimensions"),
        (sized(1, 1, 2**40, 2**40), "values"),
        (sized(1, 1, -5, 640), "-5"),
        (typed(TensorProto.STRING), "STRING"),
        (typed(TensorProto.INT4), "INT4"),
        (typed(0), "UNDEFINED"),
        (typed(12345), "12345"),
        (lambda m: m.graph.ClearField("input"), "an input and an output"),
        (lambda m: m.graph.ClearField("output"), "an input and an output"),
        (lambda m: m.ClearField("graph"), "an input and an output"),
    ],
)
def test_what_a_file_states_and_does_not_contain_is_refused(
    change: Change, words: str, model: onnx.ModelProto
) -> None:
    change(model)
    for to_run in (True, False):
        assert words in refusal(model, to_run)


def constant(name: str, *values: int) -> str:
    """Return a node of ONNX's text format that holds integers."""
    numbers = ", ".join(map(str, values))
    return f"{name} = Constant<value = int64[{len(values)}] {{{numbers}}}>() "


FILLED = "a = ConstantOfShape(n) "
LOOP = "body (int64 i, bool go) => (bool again) { again = Identity(go) }"
LARGE = "s = Constant<value = float[4] {1, 1, 1000000, 1000000}>() "
REFUSED = [
    ("y = ai.foreign.Evil(image)", "Evil y of 'ai.foreign'"),
    ("y = com.microsoft.FusedConv(image)", "FusedConv"),
    (f"y = Loop<body = {LOOP}>(, )", "Loop y in untrusted.onnx contains a graph"),
    (constant("n", 2**20, 2**20) + FILLED, "values"),
    (
        constant("n", 2**27 + 1) + FILLED + "b = ConstantOfShape(n)",
        "'all filled constants' in untrusted.onnx has the size 268435458",
    ),
    (constant("n", 5000) + FILLED + "b = ConstantOfShape(a)", "a size that other nodes compute"),
    (
        constant("n", 3000) + FILLED + "b = Concat<axis=0>(a, a) c = Add(b, b)",
        "Concat b in untrusted.onnx reads constants only",
    ),
    (constant("n", 9, 9) + "y = CumSum(n, n)", "reads constants only"),
    (
        constant("n", *range(5000)) + constant("r", -1, 1) + "a = Reshape(n, r) b = Mul(a, n)",
        "Mul b in untrusted.onnx reads constants only",
    ),
    (
        constant("n", *range(5000)) + "a = Unsqueeze(n, n) b = MatMul(a, n)",
        "MatMul b in untrusted.onnx reads constants only",
    ),
    (
        constant("n", 9) + constant("r", 2**20, 2**10) + "y = Expand(n, r)",
        "1048576 x 1024, but a tensor may have at most",
    ),
    (
        constant("n", *range(9)) + constant("r", 999) + "b = Tile(n, r) y = Tile(b, r)",
        "a size that other nodes compute",
    ),
    (
        constant("n", 9, 9) + constant("i", 7) + "y = Gather(n, i)",
        "Gather y in untrusted.onnx reads constants only",
    ),
    ("y = RandomNormal<shape=[1048576,1048576]>()", "values"),
    (constant("n", 1, 1, 2**20, 2**20) + "y = Expand(image, n)", "Expand"),
    (
        constant("n", 1, 1, 2000, 1) + "y = Tile(image, n)",
        "Tile y in untrusted.onnx enlarges by",
    ),
    (LARGE + "y = Resize(image, , s)", "enlarges by 1 x 1 x 1000000 x 1000000"),
    (constant("a", 1, 1, 9, 9) + "b = Neg(a) y = Expand(image, b)", "-9"),
    (constant("a", 1, 1, 2**14, 2**14) + "b = Mul(a, a) y = Expand(image, b)", "268435456"),
    (
        constant("n", 5000) + FILLED + "y = Expand(image, a)",
        "Expand y in untrusted.onnx has a size that other nodes compute",
    ),
    (
        "y = MaxPool<kernel_shape=[3,3], pads=[1073741824,0,0,0]>(image)",
        "has pads of 1073741824",
    ),
    ("y = DepthToSpace<blocksize=1048576>(image)", "has blocksize of 1048576"),
]


@pytest.mark.parametrize(("nodes", "words"), REFUSED)
def test_nodes_that_could_harm_a_runtime_are_refused(
    nodes: str, words: str, model: onnx.ModelProto
) -> None:
    model.graph.node.extend(parsed(nodes, "float[1] image => float[1] y").graph.node)
    # ONNX's own checker would refuse some of these first, with other words.
    with patch("onnx.checker.check_model"):
        assert words in refusal(model)


def test_pads_that_torch_computes_from_a_fixed_size_are_known() -> None:
    """A network pads its image to a multiple: (8 - height % 8) % 8."""
    sizes = constant("a", 8, 8, 8, 8, 8, 8, 4, 2) + constant("b", 8) + "p = Mod(a, b) "
    model = parsed(sizes + "y = Pad(image, p)", ENDS)
    session = open_session(parse_onnx(model.SerializeToString(), "untrusted.onnx"), 1)
    assert result_of(session, IMAGE).shape == (1, 1, 16, 16)


def test_computed_weights_run_once_saved_as_the_message_says(tmp_path: Path) -> None:
    """The example are positive weights, as torch's older exporter writes them."""
    nodes = "e = Exp(w) y = Conv<pads=[1,1,1,1]>(image, e)"
    weights = {"w": np.ones((4, 4, 3, 3), np.float32)}
    model = parsed(nodes, "float[N,4,H,W] image => float[N,4,P,Q] y", constants=weights)
    assert "(optimized_model_filepath, ORT_ENABLE_BASIC)" in refusal(model)
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(tmp_path / "folded.onnx")
    ort.InferenceSession(model.SerializeToString(), options)
    assert [node.op_type for node in load_onnx(tmp_path / "folded.onnx").graph.node] == ["Conv"]


def test_unknown_opsets_are_refused_and_batches_where_images_come_singly(
    model: onnx.ModelProto, tmp_path: Path
) -> None:
    old = deepcopy(model)
    four = deepcopy(model)
    old.opset_import[0].version = 99
    onnx.save(old, tmp_path / "opset.onnx")
    for to_run in (True, False):
        with pytest.raises(ModelError, match="opset"):
            load_onnx(tmp_path / "opset.onnx", to_run)
    four.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 4
    for reader in (tiling_of, partial(sized_graph, tile_px=64)):
        with pytest.raises(ModelError, match=r"4"):
            reader(four)


def test_functions_and_sparse_weights_are_refused(model: onnx.ModelProto) -> None:
    values, places = (
        numpy_helper.from_array(np.array([1], kind), name)
        for kind, name in ((np.float32, "v"), (int, "i"))
    )
    sparse = helper.make_sparse_tensor(values, places, [2**40])
    model.graph.sparse_initializer.append(sparse)
    assert "sparse" in refusal(model)
    del model.graph.sparse_initializer[:]
    opsets = [helper.make_opsetid("", 17)]
    body = [helper.make_node("Identity", ["x"], ["y"])]
    model.functions.append(helper.make_function("mine", "F", ["x"], ["y"], body, opsets))
    assert "functions" in refusal(model)


def test_a_file_of_absurd_size_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.onnx"
    with path.open("wb") as stream:
        # The file is sparse, so it takes no disk space.
        stream.truncate(FILE_BYTES + 1)
    with (
        patch.object(Path, "read_bytes", side_effect=AssertionError),
        pytest.raises(ModelError, match="more than"),
    ):
        load_onnx(path)


def test_every_truncation_of_a_file_is_refused_or_valid(model: onnx.ModelProto) -> None:
    content = model.SerializeToString()
    refused = 0
    for end in range(0, len(content), 37):
        try:
            parse_onnx(content[:end], "cut.onnx")
        except ModelError as error:
            refused += str(error).isprintable()
    assert refused >= len(content) // 37 - 5


@pytest.mark.parametrize(
    "nodes",
    ["y = Add(image, five)", "y = MaxPool<kernel_shape=[2,2], strides=[2,2]>(image)"],
)
def test_a_network_that_fails_on_an_image_raises_one_sentence(nodes: str) -> None:
    model = parsed(nodes, ENDS, constants={"five": np.zeros((1, 1, 5, 5))})
    with pytest.raises(ModelError, match="its own size"):
        run(open_session(model, 1), IMAGE)


def test_weights_without_a_shape_are_refused_in_one_sentence(tmp_path: Path) -> None:
    """Their shape is needed before the runtime reads the file, to add channels."""
    path = integer_convbeers(tmp_path / "a.onnx", 1, 4)
    model = onnx.load_model(path)
    weight = next(n.input[3] for n in model.graph.node if n.op_type == "QLinearConv")
    tensor = next(t for t in model.graph.initializer if t.name == weight)
    tensor.CopyFrom(numpy_helper.from_array(np.array(1, np.int8), weight))
    with pytest.raises(ModelError):
        open_session(parse_onnx(model.SerializeToString(), "flat.onnx"), 1)


def test_a_long_chain_of_activations_is_followed_quickly() -> None:
    """It once ended in a RecursionError: each Relu searched for a QuantizeLinear behind it."""
    relus = " ".join(f"r{k + 1} = Relu(r{k})" for k in range(1200))
    nodes = f"q = QuantizeLinear(image, half, zero) r0 = DequantizeLinear(q, half, zero) {relus}"
    constants = {"half": 0.5, "zero": np.int8(0)}
    placed(parsed(f"{nodes} y = Relu(r1200)", ENDS, constants=constants), 32)


def test_onnx_files_are_opened_in_few_places() -> None:
    """Only the modules that are listed here open an ONNX file or pass one to a runtime."""
    openers = {
        "onnx.load": set[str](),
        "ParseFromString(": set[str](),
        "InferenceSession(": set[str](),
    }
    for folder in ("deploy", "model", "profiles", "quant"):
        for path in (ROOT / folder).rglob("*.py"):
            for word, places in openers.items():
                if word in path.read_text(encoding="utf-8"):
                    places.add(str(path.relative_to(ROOT)))
    assert openers == {
        "onnx.load": set(),
        # A digest only reads the names of files with external weights.
        "ParseFromString(": {
            "quant/onnx/external_weights.py",
            "quant/simplify/simplify.py",
            "quant/onnx_file.py",
        },
        # The processor is tested with a model of our own, before any file is read.
        # The scripts that run alone on a board open the file that they are given.
        "InferenceSession(": {
            "deploy/kit/host.py",
            "deploy/kit/measure.py",
            "model/processor.py",
            "quant/simplify/simplify.py",
            "quant/session.py",
        },
    }
