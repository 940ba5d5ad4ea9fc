"""Tests that invalid graphs are refused, and that odd ones lose no more than others."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import pytest

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import build_core, shift_faults
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import (
    PLANES,
    Conv,
    Graph,
    SplitNetwork,
    check_split,
    correction_graph,
    read_planes,
)
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session
from tests.quant.quick import changed, one_guess, patches_of, quickly


@pytest.fixture
def graph(float_onnx: onnx.ModelProto) -> Graph:
    return correction_graph(float_onnx)


def with_conv(graph: Graph, name: str, **changes: Callable[[Any], Any]) -> Graph:
    """Return the graph with other arrays, or another input, of one convolution."""
    operator = next(op for op in graph if op.name == name)
    assert isinstance(operator, Conv)
    other = replace(
        operator, **{key: change(getattr(operator, key)) for key, change in changes.items()}
    )
    return tuple(other if op is operator else op for op in graph)


def twice(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values] * 2)


@pytest.mark.parametrize(
    ("corrupt", "message"),
    [
        (lambda _: (), "does not exist"),
        (
            lambda g: with_conv(g, "head", weight=lambda w: np.repeat(w, 3, axis=1)),
            "head needs 3 channels, got 1",
        ),
        (lambda g: g[:-1], "last operation must write the network's result, but it is "),
        (lambda g: with_conv(g, "head", bias=lambda b: b * np.nan), "head contain NaN or infinity"),
        (
            lambda g: with_conv(g, "body.0.second", weight=twice, bias=twice),
            "one number of channels, got ",
        ),
        (
            lambda g: with_conv(g, "body.0.second", input=lambda _: "before the relu"),
            "reads 'before the relu' before it is computed",
        ),
    ],
)
def test_graphs_that_cannot_be_quantized_are_refused(
    corrupt: Callable[[Graph], Graph], message: str, graph: Graph
) -> None:
    check_split(SplitNetwork(graph))
    with pytest.raises(ModelError, match=message):
        check_split(SplitNetwork(corrupt(graph)))


def test_a_layer_that_never_fires_costs_nothing(
    float_onnx: onnx.ModelProto, patches: Patches, unseen: Patches
) -> None:
    """Weights that read only zeros cannot be fitted. The bias behind them still counts."""
    dead = changed(float_onnx, "body.0.first.bias", lambda bias: bias - 50)
    dead = changed(dead, "body.0.second.bias", lambda bias: bias + 0.05)

    def mae(model: onnx.ModelProto) -> float:
        with one_guess():
            int8 = quantize_model(model, patches, {}).host
        return compare(open_session(model), open_session(int8), unseen).mae

    assert mae(dead) < 1.5 * mae(float_onnx)


@pytest.mark.parametrize("share", [1e-5, 1e-9, 0.0])
def test_a_branch_of_tiny_values_stays_legal(
    share: float, float_onnx: onnx.ModelProto, patches: Patches
) -> None:
    """The add moves the branch to the stream's scale, after its weights got their own."""
    tiny = changed(float_onnx, "body.0.second.weight", lambda weight: weight * share)
    tiny = changed(tiny, "body.0.second.bias", lambda bias: bias * share)
    few = patches_of(list(patches.degraded)[:2])
    assert shift_faults(quickly(tiny, few).core) == []


def test_sizes_beyond_all_shifts_are_refused(graph: Graph) -> None:
    huge = with_conv(
        read_planes(graph), "body.0.second", weight=lambda weight: weight * np.float32(1e30)
    )
    frac_bits = {PLANES: 7, **{op.output: 8 for op in huge}}
    with pytest.raises(ModelError, match="shifts do not reach"):
        build_core(huge, frac_bits)
