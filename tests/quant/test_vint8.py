"""Tests that VINT8 computes the bits of the host's file, in the layout of AMD's quantiser."""

from collections import Counter
from itertools import chain
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from beers_deploy.quant import graph as ops
from beers_deploy.quant.core import build_core
from beers_deploy.quant.encodings import host_model, vint8_model
from beers_deploy.quant.graph import CORRECTION, PLANES, PLANES_FRAC_BITS, Activation, Graph, Window
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.onnx.messages import constants
from beers_deploy.quant.session import open_session, planes_of, run
from tests.quant.quick import uniform

ONE = Window(pads=(1, 1, 1, 1))
TWO = Window(strides=(2, 2), pads=(1, 1, 1, 1))
PAIR = ("QuantizeLinear", "DequantizeLinear")


def conv(
    source: str, output: str, shape: tuple[int, int], activation: str = "none", **more: Any
) -> ops.Conv:
    generator = np.random.default_rng(len(output))
    weight, bias = (
        generator.normal(0, 0.2, size).astype(np.float32) for size in ((*shape, 3, 3), shape[:1])
    )
    kind = {"window": ONE, "activation": Activation[activation], **more}
    return ops.Conv(f"{output}.conv", source, output, weight, bias, **kind)


def residual() -> Graph:
    return (
        conv(PLANES, "a", (4, 3), "leaky_relu"),
        conv("a", "bb", (4, 4), "relu6"),
        conv("bb", "ccc", (4, 4)),
        ops.Add("add", ("a", "ccc"), "sum", Activation.relu),
        ops.Add("twice", ("sum", "sum"), "double"),
        conv("double", CORRECTION, (1, 4)),
    )


def unet() -> Graph:
    return (
        conv(PLANES, "a", (3, 3), "relu"),
        conv("a", "bb", (5, 3), "relu", window=TWO),
        conv("bb", "ccc", (3, 5), "relu", window=TWO, transposed=True),
        ops.Concat("join", ("a", "ccc"), "both"),
        conv("both", CORRECTION, (1, 6)),
    )


def pools() -> Graph:
    return (
        conv(PLANES, "a", (4, 3)),
        ops.MaxPool("max", "a", "bb", (3, 3), ONE),
        ops.AveragePool("mean", "a", "ccc", (2, 2), Window(pads=(0, 0, 1, 1))),
        ops.Concat("join", ("bb", "a", "ccc"), "both"),
        conv("both", CORRECTION, (1, 12)),
    )


NETWORKS = pytest.mark.parametrize("graph", [residual(), unet(), pools()])


@NETWORKS
@settings(max_examples=8)
@given(data=st.data(), tile_px=st.sampled_from([5, 9, 17, 31]), seed=st.integers(0, 99))
def test_it_computes_the_bits_of_the_host_file(
    graph: Graph, data: st.DataObject, tile_px: int, seed: int
) -> None:
    bits = {name: data.draw(st.integers(2, 7)) for name in ops.tensors(graph)}
    core = build_core(graph, {PLANES: PLANES_FRAC_BITS, **bits})
    image = uniform(1, 1, tile_px, tile_px, seed=seed)
    model = vint8_model(core, {}, tile_px)
    host = host_model(core, {})
    tensors, _ = run_core(core, core.host_part.encode(image), half_even=True)
    for optimise in (True, False):
        result = open_session(model, optimise=optimise).run(None, {PLANES: planes_of(image)})[0]
        assert_array_equal(result, merged_correction(core, tensors))
        by_host = run(open_session(host, optimise=optimise), image)
        assert_array_equal(core.host_part.finish(image, result), by_host)


@NETWORKS
def test_it_has_the_layout_of_amds_quantizer(graph: Graph) -> None:
    bits = dict.fromkeys(ops.tensors(graph), 5)
    core = build_core(graph, {PLANES: PLANES_FRAC_BITS, **bits})
    model = vint8_model(core, {}, 9)
    onnx.checker.check_model(model, full_check=True)
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 17)]
    assert model.producer_name == "beers-deploy"
    for info in (*model.graph.input, *model.graph.output):
        assert all(side.dim_value for side in info.type.tensor_type.shape.dim)
    nodes = model.graph.node
    values = constants(model)
    readers = Counter(chain.from_iterable(node.input for node in nodes))
    writers = dict[str, str]()
    for node in nodes:
        writers |= dict.fromkeys(node.output, node.op_type)
    for node in nodes:
        # Each pair has one reader and one scale per tensor, symmetric around 0, as AMD's quantiser
        # writes them.
        if node.op_type in PAIR:
            assert readers[node.output[0]] == (node.output[0] != CORRECTION)
            assert values[node.input[1]].shape == ()
            assert values[node.input[2]].dtype == np.int8
            assert node.input[0] not in values or values[node.input[0]].dtype == np.int8
        else:
            feeds = {writers[name] for name in node.input if name in writers}
            assert feeds == {"Conv" if node.op_type == "LeakyRelu" else "DequantizeLinear"}
    scaled = {(node.input[1], node.input[0]) for node in nodes if node.op_type == "QuantizeLinear"}
    scales, tensors = map(set, zip(*scaled, strict=True))
    assert len(scales) == len(tensors) == len(scaled)
