"""Tests that exporters' operators are folded into a short list without changing the results."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike
from onnx import TensorProto, helper

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.domains import OPSET
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.session import open_session, tensors_of
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.quick import assert_same, uniform
from tests.quant.simplify.networks import CASES, CHANNELS, CONV, NORMAL, SAME, network_from
from tests.shipped import shipped_pair


def results(model: onnx.ModelProto, names: Sequence[str] | None = None) -> list[np.ndarray]:
    """Return a network's results for an image of odd size, without the runtime's optimisations."""
    image = np.random.default_rng(5).uniform(-1, 1, (2, CHANNELS, 9, 11)).astype(np.float32)
    return tensors_of(open_session(model, 1, optimise=False), list(names) if names else None, image)


def kinds(model: onnx.ModelProto) -> dict[str, int]:
    return dict(Counter(node.op_type for node in model.graph.node))


def folded(model: onnx.ModelProto, atol: float = 2e-5) -> dict[str, int]:
    """Simplify a network, check its validity and results, and count its operators by kind."""
    short = simplify(model, "a.onnx")
    onnx.checker.check_model(short)
    for before, after in zip(results(model), results(short), strict=True):
        assert_allclose(after, before, rtol=2e-5, atol=atol)
        assert before.std() > 0.01
    return kinds(short)


@pytest.mark.parametrize("case", CASES)
def test_operators_of_exporters_are_folded_and_compute_the_same(case: str) -> None:
    nodes, remaining = CASES[case]
    assert folded(network_from(nodes)) == remaining


@pytest.mark.parametrize(
    ("nodes", "remaining"),
    [
        (
            """n = Unsqueeze(c, one_int) o = Unsqueeze(x, one_int) s = Concat<axis=1>(n, o)
            p = Softmax<axis=1>(s) g = Gather<axis=1>(p, first) h = Gather<axis=1>(p, second)
            k = Mul(c, g) m = Mul(x, h) y = Add(k, m)""",
            {"Conv": 3, "Sigmoid": 2, "Mul": 2, "Add": 1, "Concat": 1},
        ),
        (
            """s = Reshape(c, of_two) p = Softmax<axis=-4>(s) m = Mul(s, p)
            y = ReduceSum<keepdims=0>(m, one_int)""",
            {"Conv": 3, "Sigmoid": 1, "Mul": 1},
        ),
        (
            """n = Unsqueeze(c, first_axis) o = Unsqueeze(x, first_axis) s = Concat<axis=-5>(n, o)
            y = ReduceMean<axes=[0], keepdims=0>(s)""",
            {"Conv": 2, "Concat": 1},
        ),
        (
            """n = Unsqueeze(c, last_axis) o = Unsqueeze(x, last_axis) r = Relu(x)
            p = Unsqueeze(r, last_axis) s = Concat<axis=-1>(n, o, p)
            y = ReduceMax<axes=[4], keepdims=0>(s)""",
            {"Conv": 5, "Relu": 3, "Add": 2, "Concat": 1},
        ),
        (
            """s = Reshape(c, of_two) m = Mul(s, shares)
            y = ReduceSum<keepdims=0>(m, one_int)""",
            {"Conv": 2},
        ),
        # Nothing replaces a Softmax of three branches.
        (
            """n = Unsqueeze(c, one_int) o = Unsqueeze(x, one_int) s = Concat<axis=1>(n, o, n)
            p = Softmax<axis=1>(s) m = Mul(s, p) y = ReduceSum<keepdims=0>(m, one_int)""",
            {"Conv": 1, "Unsqueeze": 2, "Concat": 1, "Softmax": 1, "Mul": 1, "ReduceSum": 1},
        ),
    ],
)
def test_branches_with_an_axis_of_their_own_are_channels(
    nodes: str, remaining: dict[str, int]
) -> None:
    """SKNet selects the branches that it chooses among, MIRNet adds them up, DRCN weights them, and
    others take the mean or maximum of stacked maps.
    """
    ends = "float[2,4,9,11] x => float[N,C,H,W] y"
    constants: dict[str, Any] = {"first_axis": [0], "last_axis": [-1]}
    constants["shares"] = np.reshape([0.3, 0.7], (1, 2, 1, 1, 1))
    assert folded(network_from(f"{CONV} {nodes}", ends=ends, **constants)) == remaining


SWAP = "Transpose<perm=[1,0,2,3]>"
OLD_WRITE = "y = ScatterND(c, places, p)"
NEW_WRITE = f"s = {SWAP}(c) t = {SWAP}(p) u = ScatterND(s, places, t) y = {SWAP}(u)"


@pytest.mark.parametrize(
    ("write", "places", "remaining"),
    [
        (OLD_WRITE, [[[0, 1], [0, 2]]], {"Conv": 4, "Concat": 1}),
        (NEW_WRITE, [[1], [2]], {"Conv": 4, "Concat": 1}),
        (NEW_WRITE, [[0], [1]], {"Conv": 3, "Concat": 1}),
        (NEW_WRITE, [[2], [1]], {"Conv": 2, "Transpose": 3, "ScatterND": 1}),
        (NEW_WRITE, [[-2], [-1]], {"Conv": 2, "Transpose": 3, "ScatterND": 1}),
    ],
)
def test_a_write_into_channels_is_a_concat(
    write: str, places: ArrayLike, remaining: dict[str, int]
) -> None:
    """PLKSR convolves some channels in place."""
    ends = "float[1,4,9,11] x => float[1,4,9,11] y"
    nodes = f"{CONV} p = Conv(c, narrow) {write}"
    narrow = np.full((2, 4, 1, 1), 0.3)
    model = network_from(nodes, ends=ends, narrow=narrow, places=places)
    short = simplify(model, "a.onnx")
    assert kinds(short) == remaining
    assert_same(model, short, uniform(1, 4, 9, 11))


CONVOLUTIONS = {"Conv", "ConvTranspose"}
PARTS = {
    "convolution": "Conv<pads=[1,1,1,1]>({}, w)",
    "unpadded": "Conv({}, w)",
    "depthwise": "Conv<pads=[1,1,1,1], group=4>({}, deep)",
    "transposed": "ConvTranspose<strides=[2,2], group=2>({}, up)",
    "normal": "BatchNormalization({}, gain, offset, mean, variance)",
    "groups": "Conv<pads=[1,1,1,1], group=2>({}, pairs)",
    "from six": "Sub(six, {})",
    "clipped": "Clip({}, half, three)",
    "at most six": "Min(six, {})",
    "Neg": "Neg({})",
    "Relu": "Relu({})",
    **{kind: f"{kind}({{}}, image)" for kind in ("Add", "Sub", "Mul", "Div")},
}
"""Operators on one tensor; the braces stand for its name."""


@settings(max_examples=60)
@given(st.lists(st.sampled_from(sorted(PARTS)), min_size=2, max_size=4))
def test_channelwise_operators_are_folded_into_convolutions(parts: list[str]) -> None:
    tensors = ["x", *(f"t{k}" for k in range(1, len(parts))), "y"]
    nodes = [
        f"{to} = {PARTS[part].format(x)}"
        for part, (x, to) in zip(parts, pairwise(tensors), strict=True)
    ]
    model = network_from(
        " ".join(nodes), pairs=np.random.default_rng(2).normal(0, 0.5, (4, 2, 3, 3))
    )
    short = simplify(model, "a.onnx")
    (before,) = results(model)
    (after,) = results(short)
    # A network without padding gets a mirrored border, which is cut off here.
    border_px = max((after.shape[2] - before.shape[2]) // 2, 0)
    after = after[:, :, border_px : after.shape[2] - border_px, border_px:]
    after = after[..., : before.shape[3]]
    assert_allclose(after, before, rtol=0, atol=1e-5 * max(np.abs(before).max(), 1))
    kind = dict[str, str]()
    for n in short.graph.node:
        kind |= dict.fromkeys(n.output, n.op_type)
    assert "BatchNormalization" not in kind.values()
    for n in short.graph.node:
        sources = CONVOLUTIONS.intersection(kind.get(name, "") for name in n.input)
        assert not sources or n.op_type in {"Clip", "Min", "Relu", *CONVOLUTIONS}
        # An offset cannot pass zero padding, so it stays in front of it. A factor can.
        is_scaled = n.op_type in CONVOLUTIONS and kind.get(n.input[0]) in ("Mul", "Div")
        assert not is_scaled


def test_shared_weights_are_folded_for_one_convolution_alone() -> None:
    short = simplify(network_from(f"{CONV} n {NORMAL} r = Relu(n) y = {SAME}(r, w)"), "a.onnx")
    first, second = (n.input[1] for n in short.graph.node if n.op_type == "Conv")
    assert first != second == "w"


@pytest.mark.parametrize("opset", [9, 11, 13, 18, 21, 23])
def test_operators_of_other_opsets_become_ours(opset: int) -> None:
    newer = opset > 10
    where = 'coordinate_transformation_mode="asymmetric"'
    enlarged = f'Resize<mode="linear", {where}>(c, none, twice)'
    clip = "Clip(e, zero, six)"
    if not newer:
        enlarged = 'Upsample<mode="linear">(c, twice)'
        clip = "Clip<min=0.0, max=6.0>(e)"
    model = network_from(f"{CONV} e = {enlarged} y = {clip}", opset)
    short = simplify(model, "a.onnx")
    assert [(o.domain, o.version) for o in short.opset_import] == [("", OPSET)]
    assert folded(model) == {"Conv": 1, "Resize": 1, "Clip": 1}
    assert all(n.op_type != "Clip" or len(n.input) == 3 for n in short.graph.node)


def test_attributes_that_our_opset_lacks_do_not_stop_folding() -> None:
    """A tool that converts to float16 leaves such a Cast of the result."""
    model = network_from(
        f"""f = Cast<to=10>(x) g = Cast<to=1>(f) {CONV}
        p = MaxPool<kernel_shape=[2,2], strides=[2,2]>(c) s = Shape(f) r = Resize(p, , , s)
        a = Add(r, g) y = Cast<to=1>(a)""",
        opset=20,
    )
    assert kinds(simplify(model, "a.onnx")) == {"Conv": 1, "MaxPool": 1, "Resize": 1, "Add": 1}


def test_an_operator_that_our_opset_lacks_stays_of_its_own() -> None:
    short = simplify(network_from(f"{CONV} n {NORMAL} y = Gelu(n)", 20), "a.onnx")
    assert kinds(short) == {"Conv": 1, "Gelu": 1}
    assert short.opset_import[0].version == 20


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "double"])
def test_weights_of_other_floats_become_float32(kind: str) -> None:
    model = network_from(f"{CONV} n {NORMAL} y = Relu(n)", kind=kind)
    short = simplify(model, "a.onnx")
    assert {t.data_type for t in short.graph.initializer} == {TensorProto.FLOAT}
    assert short.graph.input[0].type.tensor_type.elem_type == TensorProto.FLOAT
    assert np.abs(results(short)[0]).max() > 0.1


def test_names_and_metadata_of_a_network_stay() -> None:
    ends = "float[N,4,H,W] x => float[N,4,H,W] y, float[N,4,H,W] z"
    model = network_from(f"{CONV} i = Identity(c) y = Relu(i) z = {SAME}(c, w)", ends=ends)
    # A node without a name would get the name of its output, if another node did not have it.
    model.graph.node[0].name = ""
    model.graph.node[2].name = "c"
    helper.set_model_props(model, {"variant": "mine"})
    short = simplify(model, "a.onnx")
    assert [v.name for v in (*short.graph.input, *short.graph.output)] == ["x", "y", "z"]
    assert short.graph.input[0] == model.graph.input[0]
    assert [(p.key, p.value) for p in short.metadata_props] == [("variant", "mine")]
    assert all(n.name for n in short.graph.node)
    assert len({n.name for n in short.graph.node}) == len(short.graph.node)


def test_weights_that_are_inputs_too_are_weights() -> None:
    model = network_from(f"{CONV} y {NORMAL}")
    model.graph.input.extend(
        helper.make_tensor_value_info(t.name, t.data_type, t.dims) for t in model.graph.initializer
    )
    short = simplify(model, "a.onnx")
    assert [v.name for v in short.graph.input] == ["x"]
    assert kinds(short) == {"Conv": 1}


def test_the_same_file_gives_the_same_bytes_and_is_not_changed() -> None:
    model = network_from(
        f"v = Identity(w) c = {SAME}(x, v) n {NORMAL} d = {SAME}(n, w) y = Sub(x, d)"
    )
    before = model.SerializeToString()
    short = simplify(model, "a.onnx")
    assert short.SerializeToString() == simplify(model, "b.onnx").SerializeToString()
    assert model.SerializeToString() == before
    repeated = simplify(short, "a.onnx")
    assert repeated.SerializeToString() == short.SerializeToString()


def test_files_that_need_nothing_stay_as_they_are(tmp_path: Path) -> None:
    plain = tmp_path / "plain.onnx"
    save_onnx(to_onnx(ConvBEERS(Variant(blocks=1, features=4)), {}), plain)
    for path in (plain, shipped_pair("convbeers-xs")[1]):
        assert load_onnx(path).SerializeToString() == path.read_bytes()


def test_a_network_that_the_runtime_cannot_run_is_refused_in_one_sentence() -> None:
    model = network_from(f"c = Conv(x, b) y {NORMAL}")
    with pytest.raises(ModelError, match=r"onnxruntime cannot run a\.onnx"):
        simplify(model, "a.onnx")


def test_sizes_that_contradict_the_nodes_raise_no_foreign_error() -> None:
    """The fuzzer found that onnx's converter raises an error of its own class."""
    model = network_from("m = Sub(x, image) y = Conv(m, w)", 9)
    del model.graph.output[0].type.tensor_type.shape.dim[3]
    try:
        assert "Conv" in kinds(simplify(model, "a.onnx"))
    except ModelError as error:
        assert "a.onnx" in str(error)  # noqa: PT017 - either will do


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
@pytest.mark.parametrize(
    "front", ["f = Cast<to=1>(x)", "t = Transpose<perm=[0,1,2,3]>(x) f = Cast<to=1>(t)"]
)
def test_an_integer_image_input_becomes_float(front: str, kind: str) -> None:
    ends = f"{kind}[N,{CHANNELS},H,W] x => float[N,C,H2,W2] y"
    model = network_from(f"{front} d = Div(f, six) y = {SAME}(d, w)", ends=ends)
    short = simplify(model, "a.onnx")
    assert "Cast" not in kinds(short)
    image = np.random.default_rng(0).integers(0, 255, (1, CHANNELS, 9, 11))
    (before,) = open_session(model).run(None, {"x": image.astype(kind)})
    (after,) = open_session(short).run(None, {"x": image.astype(np.float32)})
    assert_allclose(after, before, rtol=2e-5, atol=1e-3)
