"""Copies in dead channels: the network stays on what calibration saw, and rounding costs less."""

from dataclasses import replace

import numpy as np
import pytest

from beers_deploy.quant.ends import Ends
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, Add, Conv, Graph, same
from beers_deploy.quant.passes.copies import APART, ranges_apart, runs, with_copies
from beers_deploy.quant.passes.stream import lone_tensors
from tests.quant.quick import image, in_float

SEEN = [image(24, 31, seed) for seed in range(3)]


def network(dead: int, seed: int = 0) -> Graph:
    """A depthwise convolution between dense ones; so many of its seven channels are never above
    zero.
    """
    generator = np.random.default_rng(seed)
    graph = list[Conv]()
    source = PLANES
    for name, shape in {
        "a": (7, 3, 3, 3),
        "b": (7, 1, 3, 3),
        "c": (4, 7, 1, 1),
        CORRECTION: (2, 4, 3, 3),
    }.items():
        weight = generator.normal(0.1, 0.4, shape).astype(np.float32)
        bias = np.full(shape[0], 0.1, np.float32)
        activation = Activation.none if name == CORRECTION else Activation.relu
        groups = 7 if name == "b" else 1
        graph.append(
            Conv(f"{name}.conv", source, name, weight, bias, activation, same(weight), groups)
        )
        source = name
    bias = graph[1].bias.copy()
    bias[1 : 1 + dead] = -100
    graph[1] = replace(graph[1], bias=bias)
    return tuple(graph)


def results(graph: Graph, name: str = CORRECTION) -> np.ndarray:
    return np.concatenate([in_float(graph, view, name=name) for view in SEEN])


@pytest.mark.parametrize("dead", [1, 3, 5])
def test_the_network_stays_and_dead_channels_are_those_that_cost_most(dead: int) -> None:
    graph = network(dead)
    duplicated, copies = with_copies(graph, lone_tensors(graph), SEEN, Ends())
    np.testing.assert_allclose(results(duplicated), results(graph), atol=1e-5)
    count = min(dead, 7 - dead)
    assert {name: list(channels) for name, channels in copies.items() if name != "c"} == {
        name: list(range(1, 1 + count)) for name in "ab"
    }
    for name in "ab":
        values = results(duplicated, name)
        assert all(
            (values[:, [c]] == np.delete(values, c, 1)).all((0, 2, 3)).any() for c in copies[name]
        )
    size = results(graph, "b").max((0, 2, 3))
    weights = np.square(graph[2].weight).sum((0, 2, 3))  # type: ignore[attr-defined]
    most = int(np.argmax(np.square(size) * weights))
    np.testing.assert_allclose(duplicated[2].weight[:, most], graph[2].weight[:, most] / 2)  # type: ignore[attr-defined]


def test_without_dead_channels_nothing_changes() -> None:
    graph = network(0)
    graph = (*graph[:2], replace(graph[2], bias=np.full(4, 10, np.float32)), graph[3])  # type: ignore[type-var]
    duplicated, copies = with_copies(graph, lone_tensors(graph), SEEN, Ends())
    assert duplicated is graph
    assert copies == {}


def test_a_run_ends_at_dense_convolutions_that_alone_read_it() -> None:
    graph = network(1)
    assert runs(graph, ["a", "b", "c"]) == [["a", "b"], ["c"]]
    assert runs(graph, ["a", "c"]) == [["c"]]
    branched = *graph[:2], replace(graph[1], name="d.conv", output="d"), *graph[2:]  # type: ignore[type-var]
    assert runs((*branched, Add("sum", ("d", "d"), "e")), ["a", "b", "c"]) == [["c"]]


def test_copies_have_ranges_of_their_own() -> None:
    ranges = ranges_apart(np.ones(5), {"a": slice(0, 2), "b": slice(2, 5)}, {"b": np.array([0, 2])})
    np.testing.assert_allclose(ranges, [1, 1, 1 / APART, 1, 1 / APART])
