"""Equalizing single tensors: the float network stays, the search only gains, most on unequal
channels.
"""

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
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
from beers_deploy.quant.passes import equalize_single as single
from beers_deploy.quant.passes.effort import Effort
from beers_deploy.quant.passes.equalize import FULL
from beers_deploy.quant.passes.equalize_single import SingleTensors, single_ranges
from beers_deploy.quant.passes.residual_groups import GROUP_FRAC_BITS, single_tensors
from beers_deploy.quant.passes.trial import Costs
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.session import open_session
from beers_deploy.quant.simplify.simplify import simplify
from examples.networks import build, to_onnx
from tests.quant.quick import in_float, patches_of, quickly, with_relu6


def read(name: str) -> tuple[onnx.ModelProto, Graph, HostPart, SingleTensors]:
    model = simplify(to_onnx(name, build(name, torch.Generator().manual_seed(0))), name)
    network = read_network(model)
    graph = read_planes(network.graph)
    host_part = HostPart.of(network, Plain())
    widths = channels_of(graph, {PLANES: host_part.planes})
    alone = single_tensors(graph)
    return (
        model,
        graph,
        host_part,
        SingleTensors(tuple(alone), tuple(widths[tensor] for tensor in alone)),
    )


def images(count: int = 3, side_px: int = 40) -> list[np.ndarray]:
    rows, columns = np.mgrid[:side_px, :side_px] / side_px
    waves = [0.4 + 0.3 * np.sin(9 * rows + k) * np.cos(7 * columns) for k in range(count)]
    return [wave.astype(np.float32)[None, None] for wave in waves]


def correction(graph: Graph, host_part: HostPart) -> np.ndarray:
    return in_float(graph, images()[1], host_part)


@pytest.mark.parametrize("name", ["dncnn", "espcn", "unet", "segment", "mobile"])
def test_equalizing_leaves_the_float_network_as_it_was(name: str) -> None:
    _, graph, host_part, singles = read(name)
    factors = np.random.default_rng(1).uniform(0.2, 5, sum(singles.widths))
    expected = correction(graph, host_part)
    np.testing.assert_allclose(
        correction(singles.scaled(graph, factors), host_part),
        expected,
        atol=2e-5 * np.abs(expected).max(),
    )
    pairs = zip(singles.scaled(graph, factors), graph, strict=True)
    assert any(isinstance(op, Conv) and not np.allclose(op.weight, was.weight) for op, was in pairs)  # type: ignore[attr-defined]


def test_what_others_read_or_factors_do_not_pass_is_left_alone() -> None:
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


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.0, 3.0]))
def test_relu6_is_the_end_of_int8_whatever_the_factors(seed: int, size: float) -> None:
    graph = with_relu6(size)
    host_part = HostPart()
    singles = SingleTensors(tuple(single_tensors(graph)), (5, 5, 4))
    assert singles.tensors == ("a", "b", "c")
    scaled = singles.scaled(graph, np.random.default_rng(seed).lognormal(-2, 1, 14))
    expected = correction(graph, host_part)
    np.testing.assert_allclose(
        correction(scaled, host_part), expected, atol=2e-5 * np.abs(expected).max()
    )
    core = build_core(
        scaled, {PLANES: PLANES_FRAC_BITS, CORRECTION: 4} | dict.fromkeys("abc", GROUP_FRAC_BITS)
    )
    kinds = [op.activation for op in core.convolutions]
    assert kinds == [Activation.relu] * 3 + [Activation.none]
    tensors, _ = run_core(core, IMAGE_SLICES.encode(images()[0]))
    for op in scaled[:-1]:
        assert isinstance(op, Conv)
        assert (
            tensors[op.output].max((0, 2, 3)) * core.scale(op.output) <= op.ceilings * (1 + 1e-6)
        ).all()


class Bowl:
    """A cost that is known: how far the channels of the first tensor are from factors of their own,
    on two crops.
    """

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
    ranges = single_ranges(graph, singles, images(), host_part)
    trial = Bowl(graph)
    for start in (
        np.ones(sum(singles.widths)),
        np.concatenate([trial.lowest, np.ones(singles.widths[1])]),
    ):
        factors = single.equalize_single(
            graph, singles, ranges, start, lambda *_: trial, effort, most_groups
        )
        before, after = (
            trial(singles.scaled(graph, trial_factors))(None).sum()
            for trial_factors in (start, factors)
        )
        assert after <= before


def test_the_start_leaves_each_tensor_the_scale_it_has() -> None:
    *_, singles = read("espcn")
    factors = singles.unscaled(dict.fromkeys(singles.tensors, GROUP_FRAC_BITS - 2))
    np.testing.assert_array_equal(factors, np.full(sum(singles.widths), 0.25))


@pytest.mark.parametrize("loud", [0.1, 20.0])
def test_what_calibration_sees_is_not_clipped_where_the_image_itself_passes(
    loud: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "beers_deploy.quant.quantize.equalize_single",
        lambda _g, _c, ranges, *_: loud * FULL / ranges,
    )
    model, _, _, singles = read("espcn")
    int8 = quickly(model, patches_of(images()))
    assert int8.core.host_part.decoding.offsets
    largest = single_ranges(int8.graph, singles, images(), int8.core.host_part, 1.0, 1.0)
    assert largest.max() <= FULL * (1 + 1e-5)


def test_unequal_channels_err_half_as_much_once_they_are_equalized(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A network whose channels differ thirtyfold, as training with batch
    normalisation leaves them.
    """
    network = build("dncnn", torch.Generator().manual_seed(0))
    layers = [
        layer
        for layer in network.modules()
        if isinstance(layer, torch.nn.Conv2d | torch.nn.BatchNorm2d)
    ]
    with torch.no_grad():
        for norm, conv in zip(layers[2::2], layers[3::2], strict=True):
            factors = torch.logspace(0, -1.5, norm.weight.numel())
            norm.weight.mul_(factors)
            norm.bias.mul_(factors)  # type: ignore[union-attr]
            conv.weight.div_(factors[:, None, None])
    model = simplify(to_onnx("dncnn", network), "dncnn")
    image_list = images()
    patches = patches_of(image_list)

    def mae() -> float:
        int8 = quantize_model(model, patches, {}, effort=Effort.fast)
        return compare(open_session(model), open_session(int8.host), patches).mae

    equalized = mae()
    monkeypatch.setattr(
        "beers_deploy.quant.quantize.equalize_single",
        lambda _graph, _chain, _ranges, start, *_: start,
    )
    assert equalized < 0.5 * mae()
