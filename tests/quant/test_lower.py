"""Tensors stored from -128 on: the float network stays, the integers are those of every file, and
half is lost.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.quant.core import IntCore, build_core, shift_faults
from beers_deploy.quant.encodings import (
    board_model,
    encoding_faults,
    host_model,
    read_core,
    vint8_model,
)
from beers_deploy.quant.ends import Ends
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    PLANES_FRAC_BITS,
    Activation,
    Add,
    Conv,
    Graph,
    Window,
    same,
)
from beers_deploy.quant.integer.reference import agreement, correction, run_core
from beers_deploy.quant.integer.trainable import TrainableCore
from beers_deploy.quant.passes.fit_weights import fit_weights
from beers_deploy.quant.passes.lower import lower, lowerable, lowered
from beers_deploy.quant.samples import Remade
from beers_deploy.quant.sensitivity import layer_errors
from beers_deploy.quant.session import open_session, planes_of
from beers_deploy.quant.structure import count_relus, saturated_shares
from tests.quant.quick import image, in_float, with_relu6

STRIDED = Window(strides=(2, 3))
VALID = Window()
BITS = {PLANES: PLANES_FRAC_BITS, "a": 5, "b": 5, "c": 5, "d": 5, CORRECTION: 5}


def conv(
    source: str, output: str, shape: tuple[int, int, int, int], seed: int, **more: Any
) -> Conv:
    generator = np.random.default_rng(seed)
    weight = (0.3 * generator.standard_normal(shape)).astype(np.float32)
    bias = (0.2 * generator.standard_normal(shape[0])).astype(np.float32)
    return replace(
        Conv(f"{output}.conv", source, output, weight, bias, Activation.relu, same(weight)), **more
    )


def network(seed: int = 0) -> Graph:
    """Two tensors that only convolutions without padding read, one of them 2 x 3, and two that are
    padded.
    """
    first = conv(PLANES, "a", (5, 3, 3, 3), seed)
    depthwise = conv("a", "b", (5, 1, 3, 3), seed + 1, groups=5)
    point = conv("b", "c", (4, 5, 1, 1), seed + 2)
    large = conv("c", "d", (3, 4, 2, 3), seed + 3, window=VALID)
    return (
        first,
        depthwise,
        point,
        large,
        conv("d", CORRECTION, (1, 3, 3, 3), seed + 4, activation=Activation.none),
    )


def both_lowered(graph: Graph) -> Graph:
    return lowered(lowered(graph, "b", 6), "c", 6)


def core_of(graph: Graph) -> IntCore:
    return build_core(graph, BITS, ends=Ends(planes=3, adds_image=False))


def result(graph: Graph) -> np.ndarray:
    return in_float(graph, image())


def test_behind_relu_and_read_without_padding() -> None:
    graph = network()
    assert lowerable(graph) == ["b", "c"]
    leaky = tuple(
        replace(op, activation=Activation.leaky_relu) if op.output == "b" else op  # type: ignore[type-var]
        for op in graph
    )
    assert lowerable(leaky) == ["c"]
    up = replace(graph[2], transposed=True)  # type: ignore[type-var]
    assert lowerable((*graph[:2], up, *graph[3:])) == ["c"]
    added = *graph[:-1], Add("sum", ("c", "c"), "twice"), graph[-1]
    assert lowerable(added) == ["b"]


@given(st.integers(0, 99), st.integers(2, 9), st.sampled_from([0.3, 3.0]))
def test_the_float_network_stays(seed: int, frac_bits: int, size: float) -> None:
    for graph, name in ((network(seed), "c"), (with_relu6(size), "b")):
        expected = result(graph)
        actual = result(lowered(graph, name, frac_bits))
        np.testing.assert_allclose(
            actual, expected, atol=1e-4 * max(np.abs(expected).max(), 2.0**-frac_bits)
        )


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 99))
def test_every_file_holds_the_references_integers(seed: int) -> None:
    core = core_of(both_lowered(network(seed)))
    pixels = image(19, 19, seed)
    assert shift_faults(core) == []
    host = host_model(core, {})
    assert not any(layer.unequal for layer in agreement(core, host, pixels).layers)
    expected = correction(core, core.ends.split(pixels), half_even=True)
    for model in (board_model(core, {}), vint8_model(core, {}, 19)):
        (result,) = open_session(model).run(None, {PLANES: planes_of(pixels, core.ends)})
        np.testing.assert_array_equal(result, expected)
    tensors, _ = run_core(core, core.ends.split(pixels))
    trained = TrainableCore(core)
    result = trained.tensors(torch.from_numpy(core.ends.split(pixels).astype(np.float32)))[
        CORRECTION
    ]
    np.testing.assert_array_equal(result.detach().numpy(), tensors[CORRECTION])


def test_a_file_counts_its_relus_and_not_their_zeros_as_saturated() -> None:
    model, plain = (
        host_model(core_of(graph), {"precision": "int8 legal"})
        for graph in (both_lowered(network()), network())
    )
    assert encoding_faults(model) == []
    assert [op.activation for op in read_core(model).convolutions][1:3] == [
        Activation.saturated_relu
    ] * 2
    expected = count_relus(plain).explicit
    assert count_relus(model).off_by(expected) == 0
    assert count_relus(model).off_by(expected + 1) == 1
    shares = saturated_shares(model, [image()])
    _, reports = run_core(read_core(model), Ends().split(image()))
    assert max(shares["b"], shares["c"], *(report.saturated for report in reports[1:3])) < 0.05


@pytest.mark.parametrize("size", [0.3, 3.0])
def test_relu6_ends_where_int8_does(size: float) -> None:
    graph = lowered(with_relu6(size), "b", 5)
    writer = graph[1]
    assert isinstance(writer, Conv)
    assert (writer.ceilings >= 255 / 32).all()
    core = build_core(graph, {PLANES: PLANES_FRAC_BITS, "a": 4, "c": 4, CORRECTION: 3})
    assert core.frac_bits["b"] == 5
    np.testing.assert_allclose(result(graph), result(with_relu6(size)), atol=1e-3)


def crops(count: int) -> Remade[np.ndarray]:
    return Remade(lambda k: 0.3 + 0.1 * image(24, 24, k), count)


def test_the_layer_errs_half_as_much() -> None:
    graph = network()
    samples = crops(4)
    errors = []
    for variant in (graph, lowered(graph, "b", 6)):
        core = build_core(variant, BITS | {"b": 5}, ends=Ends(planes=3, adds_image=False))
        layers, _ = layer_errors(variant, core, samples)
        errors.append(layers[1].network.squared)
    assert errors[1] < 0.6 * errors[0]


def test_fitted_biases_give_back_what_was_taken() -> None:
    samples = crops(8)
    ends = Ends(planes=3, adds_image=False)
    expected = np.mean([in_float(network(), sample, ends) for sample in samples])
    graph = both_lowered(network())
    core = fit_weights(graph, build_core(graph, BITS, ends=ends), samples)
    actual = np.mean([correction(core, core.ends.split(sample)) for sample in samples])
    assert abs(actual - expected) < core.scale(CORRECTION)


@pytest.mark.parametrize(
    ("costs", "lowered_names"), [((3, 4, 4, 2), "bc"), ((3, 2, 4, 5), "b"), ((3, 4, 4, 3), "")]
)
def test_only_where_it_costs_less(costs: tuple[int, ...], lowered_names: str) -> None:
    """The costs of none of the two tensors lowered, of either, and of both."""

    def names(graph: Graph) -> str:
        return "".join(op.output for op in graph if isinstance(op, Conv) and op.offset)

    cost_by_names = dict(zip(("", "b", "c", "bc"), costs, strict=True))
    assert (
        names(
            lower(network(), BITS, lambda graph: lambda _: np.array([cost_by_names[names(graph)]]))
        )
        == lowered_names
    )
