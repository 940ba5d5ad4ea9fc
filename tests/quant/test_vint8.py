"""VINT8 says what the host's file says, to the bit, in the layout of AMD's quantiser."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.core import IntCore, build_core
from beers_deploy.quant.encodings import host_model, vint8_model
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    PLANES_FRAC_BITS,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    MaxPool,
    Window,
    split,
    tensors,
)
from beers_deploy.quant.integer import correction
from beers_deploy.quant.onnx_file import constants
from beers_deploy.quant.session import open_session, planes_of, run

ONE = Window(pads=(1, 1, 1, 1))
TWO = Window(strides=(2, 2), pads=(1, 1, 1, 1))


def conv(
    source: str,
    output: str,
    shape: tuple[int, int],
    activation: Activation = Activation.none,
    window: Window = ONE,
    up: bool = False,
) -> Conv:
    generator = np.random.default_rng(len(output))
    weight = generator.normal(0, 0.2, (*shape, 3, 3)).astype(np.float32)
    bias = generator.normal(0, 0.2, shape[0]).astype(np.float32)
    return Conv(f"{output}.conv", source, output, weight, bias, activation, window, 1, up)


def plain() -> Graph:
    first = conv(PLANES, "a", (5, 3), Activation.relu)
    return first, conv("a", "bb", (4, 5), Activation.leaky_relu), conv("bb", CORRECTION, (1, 4))


def residual() -> Graph:
    head, inner, outer = (
        conv(PLANES, "a", (4, 3)),
        conv("a", "bb", (4, 4), Activation.relu6),
        conv("bb", "ccc", (4, 4)),
    )
    added = Add("add", ("a", "ccc"), "sum", Activation.relu)
    return head, inner, outer, added, Add("twice", ("sum", "sum"), "double"), conv("double", CORRECTION, (1, 4))


def unet() -> Graph:
    skip, down = conv(PLANES, "a", (3, 3), Activation.relu), conv("a", "bb", (5, 3), Activation.relu, TWO)
    up = conv("bb", "ccc", (3, 5), Activation.relu, TWO, up=True)
    return skip, down, up, Concat("join", ("a", "ccc"), "both"), conv("both", CORRECTION, (1, 6))


def pools() -> Graph:
    first = conv(PLANES, "a", (4, 3))
    largest = MaxPool("max", "a", "bb", (3, 3), ONE)
    mean = AveragePool("mean", "a", "ccc", (2, 2), Window(pads=(0, 0, 1, 1)))
    return first, largest, mean, Concat("join", ("bb", "a", "ccc"), "both"), conv("both", CORRECTION, (1, 12))


NETWORKS: list[Callable[[], Graph]] = [plain, residual, unet, pools]


def drawn_core(data: st.DataObject, network: Callable[[], Graph]) -> IntCore:
    graph = network()
    bits = {name: data.draw(st.integers(2, 7)) for name in tensors(graph)}
    return build_core(graph, {PLANES: PLANES_FRAC_BITS, **bits})


@pytest.mark.parametrize("network", NETWORKS)
@settings(max_examples=8, deadline=None)
@given(data=st.data(), tile_px=st.sampled_from([5, 9, 17, 31]), seed=st.integers(0, 99))
def test_the_host_files_bits(network: Callable[[], Graph], data: st.DataObject, tile_px: int, seed: int) -> None:
    core = drawn_core(data, network)
    image = np.random.default_rng(seed).random((1, 1, tile_px, tile_px), np.float32)
    model, feed = vint8_model(core, {}, tile_px), {PLANES: planes_of(image)}
    for optimise in (True, False):
        found = open_session(model, optimise=optimise).run(None, feed)[0]
        np.testing.assert_array_equal(found, correction(core, split(image), half_even=True))
        by_host = run(open_session(host_model(core, {}), optimise=optimise), image)
        np.testing.assert_array_equal(core.ends.finished(image, found), by_host)


@pytest.mark.parametrize("network", NETWORKS)
def test_the_layout_of_amds_quantiser(network: Callable[[], Graph]) -> None:
    graph = network()
    core = build_core(graph, {PLANES: PLANES_FRAC_BITS, **dict.fromkeys(tensors(graph), 5)})
    model = vint8_model(core, {"sensor": "mine"}, 9)
    nodes, held = model.graph.node, constants(model)
    onnx.checker.check_model(model, full_check=True)
    assert [(each.domain, each.version) for each in model.opset_import] == [("", 17)]
    assert model.producer_name == "beers-deploy"
    assert all(d.dim_value for v in (*model.graph.input, *model.graph.output) for d in v.type.tensor_type.shape.dim)
    readers = Counter(name for node in nodes for name in node.input if name and name not in held)
    written = {name: node for node in nodes for name in node.output}
    for node in nodes:
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            assert readers[node.output[0]] == (node.output[0] != CORRECTION)
            assert held[node.input[1]].shape == ()
            assert held[node.input[2]].dtype == np.int8
        else:
            feeds = [written[name].op_type for name in node.input if name and name not in held]
            inner = node.op_type == "LeakyRelu"
            assert set(feeds) == ({"Conv"} if inner else {"DequantizeLinear"})
    scaled = {(node.input[1], node.input[0]) for node in nodes if node.op_type == "QuantizeLinear"}
    assert len({scale for scale, _ in scaled}) == len({tensor for _, tensor in scaled}) == len(scaled)
    assert {held[n.input[0]].dtype for n in nodes if n.op_type == "DequantizeLinear" and n.input[0] in held} == {
        np.dtype("int8")
    }


def test_a_file_without_a_tile_is_refused() -> None:
    core = build_core(plain(), {PLANES: PLANES_FRAC_BITS, "a": 5, "bb": 5, CORRECTION: 5})
    with pytest.raises(OptionError, match="640"):
        vint8_model(core, {}, None)
