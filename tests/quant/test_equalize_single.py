"""Tests that equalising single tensors keeps the float network and reduces the error."""

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.quant.core import build_core
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    PLANES_FRAC_BITS,
    Activation,
    Conv,
    Graph,
    channels_of,
    read_network,
    read_planes,
)
from beers_deploy.quant.host_part import IMAGE_SLICES, HostPart, Plain
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.passes.effort import Effort
from beers_deploy.quant.passes.equalize import FULL
from beers_deploy.quant.passes.equalize_single import SingleTensors, equalize_single, single_ranges
from beers_deploy.quant.passes.residual_groups import GROUP_FRAC_BITS, single_tensors
from beers_deploy.quant.passes.trial import Costs
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.session import open_session
from beers_deploy.quant.simplify.simplify import simplify
from examples.networks import build, to_onnx
from tests.quant.quick import in_float, patches_of, quickly, waves, with_relu6


def read(name: str) -> tuple[onnx.ModelProto, Graph, HostPart, SingleTensors]:
    model = simplify(to_onnx(name, build(name, torch.Generator().manual_seed(0))), name)
    network = read_network(model)
    graph = read_planes(network.graph)
    host_part = HostPart.of(network, Plain())
    widths = channels_of(graph, {PLANES: host_part.planes})
    names = single_tensors(graph)
    singles = SingleTensors(tuple(names), tuple(widths[name] for name in names))
    return model, graph, host_part, singles


def assert_same(graph: Graph, other: Graph, host_part: HostPart) -> None:
    actual, expected = (in_float(each, waves()[1], host_part) for each in (graph, other))
    np.testing.assert_allclose(actual, expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["dncnn", "espcn", "unet", "segment", "mobile"])
def test_equalizing_leaves_the_float_network_as_it_was(name: str) -> None:
    _, graph, host_part, singles = read(name)
    factors = np.random.default_rng(1).uniform(0.2, 5, sum(singles.widths))
    scaled = singles.scaled(graph, factors)
    assert_same(scaled, graph, host_part)
    place = next(k for k, op in enumerate(scaled) if op is not graph[k])
    one_alone = (*graph[:place], scaled[place], *graph[place + 1 :])
    with pytest.raises(AssertionError):
        assert_same(one_alone, graph, host_part)


def test_tensors_that_factors_cannot_pass_are_left_alone() -> None:
    _, graph, _, singles = read("unet")
    pooled = set[str]()
    for op in graph:
        if not isinstance(op, Conv):
            pooled |= {*op.inputs, op.output}
    assert pooled
    assert not pooled & set(singles.tensors)
    _, graph, _, singles = read("segment")
    curved = {op.output for op in graph if op.name.endswith("HardSwish") or "Hardswish" in op.name}
    assert not curved & set(singles.tensors)
    assert CORRECTION not in singles.tensors


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.0, 3.0]))
def test_relu6_becomes_the_end_of_int8_for_any_factors(seed: int, size: float) -> None:
    graph = with_relu6(size)
    host_part = HostPart()
    singles = SingleTensors(tuple(single_tensors(graph)), (5, 5, 4))
    assert singles.tensors == ("a", "b", "c")
    scaled = singles.scaled(graph, np.random.default_rng(seed).lognormal(-2, 1, 14))
    assert_same(scaled, graph, host_part)
    core = build_core(
        scaled, {PLANES: PLANES_FRAC_BITS, CORRECTION: 4} | dict.fromkeys("abc", GROUP_FRAC_BITS)
    )
    kinds = [op.activation for op in core.convolutions]
    assert kinds == [Activation.relu] * 3 + [Activation.none]
    tensors, _ = run_core(core, IMAGE_SLICES.encode(waves()[0]))
    for op in scaled[:-1]:
        assert isinstance(op, Conv)
        largest = tensors[op.output].max((0, 2, 3)) * core.scale(op.output)
        assert (largest <= op.ceilings * (1 + 1e-6)).all()


class Bowl:
    """A known cost on two crops: the distance of the first tensor's factors from given ones."""

    def __init__(self, graph: Graph) -> None:
        self.sizes = self._sizes(graph)
        self.lowest = np.geomspace(0.3, 3, len(self.sizes))

    @staticmethod
    def _sizes(graph: Graph) -> np.ndarray:
        return np.asarray(np.abs(graph[0].weight).sum((1, 2, 3)))  # type: ignore[attr-defined]

    def __call__(self, candidate: Graph) -> Costs:
        off = np.square(np.log(self._sizes(candidate) / self.sizes / self.lowest)).sum()
        return lambda crops: np.array([1.0, 2.0])[slice(None) if crops is None else crops] * off


@pytest.mark.parametrize(
    ("effort", "most_groups"), [(Effort.fast, 0), (Effort.normal, 3), (Effort.best, 256)]
)
def test_the_search_never_ends_above_its_start(effort: Effort, most_groups: int) -> None:
    _, graph, host_part, singles = read("espcn")
    ranges = single_ranges(graph, singles, waves(), host_part)
    trial = Bowl(graph)
    for first in (np.ones_like(trial.lowest), trial.lowest):
        start = np.concatenate([first, np.ones(singles.widths[1])])
        begun = singles.scaled(graph, start)
        factors = equalize_single(
            begun, singles, ranges * start, lambda *_: trial, effort, most_groups
        )
        assert trial(singles.scaled(begun, factors))(None).sum() <= trial(begun)(None).sum()


@pytest.mark.parametrize("size", [0.1, 20.0])
def test_calibration_images_are_not_clipped_without_a_global_add(
    size: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "beers_deploy.quant.plan.equalize_single",
        lambda _g, _c, ranges, *_: size * FULL / ranges,
    )
    model, _, _, singles = read("espcn")
    int8 = quickly(model, patches_of(waves()))
    assert int8.core.host_part.decoding.offsets
    largest = single_ranges(int8.graph, singles, waves(), int8.core.host_part, 1.0, 1.0)
    assert largest.max() <= FULL * (1 + 1e-5)


def test_unequal_channels_err_half_as_much_once_they_are_equalized(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Channels differ thirtyfold here, as training with batch normalisation leaves them."""
    network = build("dncnn", torch.Generator().manual_seed(0))
    kinds = torch.nn.Conv2d | torch.nn.BatchNorm2d
    layers = [layer for layer in network.modules() if isinstance(layer, kinds)]
    with torch.no_grad():
        for norm, conv in zip(layers[2::2], layers[3::2], strict=True):
            factors = torch.logspace(0, -1.5, norm.weight.numel())
            norm.weight.mul_(factors)
            norm.bias.mul_(factors)  # type: ignore[union-attr]
            conv.weight.div_(factors[:, None, None])
    model = simplify(to_onnx("dncnn", network), "dncnn")
    patches = patches_of(waves())

    def mae() -> float:
        int8 = quantize_model(model, patches, {}, effort=Effort.fast)
        return compare(open_session(model), open_session(int8.host), patches).mae

    equalized = mae()
    monkeypatch.setattr(
        "beers_deploy.quant.plan.equalize_single",
        lambda _graph, _singles, ranges, *_: np.ones_like(ranges),
    )
    assert equalized < 0.5 * mae()
