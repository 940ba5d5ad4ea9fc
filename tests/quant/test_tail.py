"""What a network does behind its last map stays on the host, as it is: decoding of boxes."""

import base64
from collections.abc import Callable
from functools import cache

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import network_of
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.encodings import as_on_board, encoding_faults, read_core
from beers_deploy.quant.encodings.description import KEY
from beers_deploy.quant.graph import CORRECTION, read_network
from beers_deploy.quant.graph.tail import Tail
from beers_deploy.quant.integer.reference import agreement, integer_rows
from beers_deploy.quant.onnx_file import GraphWriter
from beers_deploy.quant.quantise import Quantised
from beers_deploy.quant.reading.folding import simplest
from beers_deploy.quant.session import open_session, result_of
from benchmarks.detector.network import DetectorNetwork, detector_to_onnx, initialise
from tests.quant.quick import behind_conv, copied, patches_of, quickly

SIDE_PX = 160


def detector() -> onnx.ModelProto:
    """Untrained, with statistics of its own, and a last layer whose boxes and scores differ from
    place to place.
    """
    network = DetectorNetwork(2)
    generator = torch.Generator().manual_seed(0)
    initialise(network, generator)
    with torch.no_grad():
        network.tail.weight.mul_(3)
    return simplest(
        detector_to_onnx(network.eval(), ("a", "b"), SIDE_PX, {"kept": "said"}), "detector"
    )


def images(count: int = 3) -> list[np.ndarray]:
    generator = np.random.default_rng(1)
    blocks = generator.random((count, 1, 3, SIDE_PX // 8, SIDE_PX // 8), dtype=np.float32)
    return list(np.kron(blocks, np.ones((8, 8), np.float32)))


@cache
def quantised() -> Quantised:
    return quickly(detector(), patches_of(images()))


def test_the_tail_begins_behind_the_last_convolution() -> None:
    model = detector()
    network = read_network(model)
    assert network.tail is not None
    assert (
        network.graph[-1].name
        == [node for node in model.graph.node if node.op_type == "Conv"][-1].name
    )
    behind = {"Slice", "Exp", "Sigmoid", "Add", "Mul", "Concat", "Reshape"}
    assert {node.op_type for node in network.tail.graph.node} == behind
    # The reader fuses 10 ReLUs with the convolutions before them.
    assert len(network.tail.graph.node) + 10 + len(network.graph) == len(model.graph.node)


def test_the_tail_by_itself_is_what_the_runtime_computes() -> None:
    model = detector()
    image = images()[0]
    tail = read_network(model).tail
    assert tail is not None
    last = next(node for node in reversed(model.graph.node) if node.op_type == "Conv").output[0]
    expected = result_of(open_session(model), image)
    model.graph.output.append(helper.make_tensor_value_info(last, TensorProto.FLOAT, None))
    actual = open_session(model).run([last], {"images": image})[0]
    np.testing.assert_allclose(tail(np.asarray(actual)), expected, rtol=1e-5, atol=1e-5)


def test_int8_gives_boxes_and_scores_as_float_does() -> None:
    image = images()[1]
    expected, actual = (
        result_of(open_session(model), image) for model in (detector(), quantised().host)
    )
    assert actual.shape == expected.shape == (1, 6, (SIDE_PX // 4) ** 2)
    for row, spread in zip(np.abs(actual - expected)[0], expected[0].std(axis=1), strict=True):
        assert row.mean() < 0.15 * max(float(spread), 1e-6)


def test_the_file_is_read_back_with_its_tail() -> None:
    int8 = quantised()
    core = read_core(int8.host)
    assert encoding_faults(int8.host) == []
    assert core.ends == int8.core.ends
    image = images()[2]
    layers = agreement(core, int8.host, image)
    assert [layer.report.name for layer in layers.layers if layer.unequal] == []
    result = result_of(open_session(int8.host), image)
    np.testing.assert_allclose(core.ends.finished(image, layers.even), result, rtol=1e-5, atol=1e-5)
    assert {entry.key: entry.value for entry in int8.host.metadata_props}["kept"] == "said"


def test_a_network_of_one_size_is_looked_at_whole() -> None:
    int8 = quantised()
    *layers, _ = integer_rows(detector(), int8.core, int8.host, images())
    assert {row.figures["as onnxruntime"].value for row in layers} == {100.0}


@pytest.mark.parametrize("target", ["vck190", "zcu102", "kv260"])
def test_the_core_and_the_float_file_are_legal_on_the_dpu(target: str) -> None:
    dpu = load_dpu(target, None)
    for model in (detector(), as_on_board(quantised().host)):
        assert legality(place(network_of(model, SIDE_PX), dpu)).passed


def test_a_tail_that_was_changed_is_a_fault() -> None:
    corrupted = copied(quantised().host)
    node = next(candidate for candidate in corrupted.graph.node if candidate.op_type == "Exp")
    node.op_type = "Sqrt"
    assert encoding_faults(corrupted) == [f"node {node.name}"]


def graph_text(kind: str) -> str:
    map_info, result = (
        helper.make_tensor_value_info(n, TensorProto.FLOAT, None) for n in (CORRECTION, "restored")
    )
    node = helper.make_node(kind, [CORRECTION], ["restored"])
    return base64.b64encode(
        helper.make_graph([node], "t", [map_info], [result]).SerializeToString()
    ).decode()


@pytest.mark.parametrize(
    "text", [graph_text("Loop"), graph_text("Conv"), "bm8gZ3JhcGg=", "not base64"]
)
def test_a_description_with_another_tail_is_one_sentence(text: str) -> None:
    corrupted = copied(quantised().host)
    ends = quantised().core.ends
    entry = next(candidate for candidate in corrupted.metadata_props if candidate.key == KEY)
    assert ends.tail is not None
    entry.value = entry.value.replace(ends.tail.text, text)
    with pytest.raises(ModelError, match="contradict"):
        encoding_faults(corrupted)


def sigmoid_then_conv(w: GraphWriter) -> None:
    weight = w.constant("v", np.ones((1, 2, 1, 1), np.float32))
    w.node("Conv", "restored", [w.node("Sigmoid", "s", ["x"]), weight], "last")


def of_two_maps(w: GraphWriter) -> None:
    other = w.node("MaxPool", "y", ["x"], kernel_shape=[2, 2], strides=[2, 2])
    flat = [
        w.node("Flatten", f"{name}.flat", [w.node("Sigmoid", f"{name}.s", [name])])
        for name in ("x", other)
    ]
    w.node("Concat", "restored", flat, axis=1)


@pytest.mark.parametrize("write", [sigmoid_then_conv, of_two_maps])
def test_what_is_no_tail_is_refused_as_before(write: Callable[[GraphWriter], object]) -> None:
    with pytest.raises(ModelError, match="Sigmoid"):
        read_network(behind_conv(write))


def test_nothing_may_follow_a_global_add() -> None:
    def write(w: GraphWriter) -> None:
        weight = w.constant("v", np.ones((1, 2, 1, 1), np.float32))
        w.node("Add", "sum", ["image", w.node("Conv", "y", ["x", weight], "last")])
        w.node("Sigmoid", "restored", ["sum"])

    with pytest.raises(ModelError, match=r"nothing behind the global add.* but "):
        read_network(behind_conv(write))


def test_a_tail_of_a_single_sigmoid_is_the_hosts() -> None:
    network = read_network(behind_conv(lambda w: w.node("Sigmoid", "restored", ["x"])))
    assert isinstance(network.tail, Tail)
    values = np.linspace(-3, 3, 8, dtype=np.float32).reshape(1, 2, 2, 2)
    np.testing.assert_allclose(network.tail(values), 1 / (1 + np.exp(-values)), rtol=1e-6)
