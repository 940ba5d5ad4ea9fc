"""Tests that `adapt` chooses replacements, compares them with the original, and is quantised."""

from pathlib import Path

import numpy as np
import pytest

import beers_deploy as bd
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.quant.adapt.adaptation import ADAPTED, NEAR_DB, adapt
from beers_deploy.quant.graph import Resize, read_network
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.structure import structure_checks
from tests.quant.adapt.images import (
    BARE,
    HELD_OUT,
    SAMPLES,
    TO_ORIGINAL,
    assert_near,
    assert_same_on_any_size,
)
from tests.quant.adapt.networks import (
    REPLACED,
    attention_network,
    contrast_network,
    elu,
    leaky,
    network,
    silu_but_elu_third,
)
from tests.quant.quick import one_guess, quickly

DPU_SLOPE = 26 / 256
"""The one slope of a LeakyReLU that a DPU computes."""


def test_an_exact_replacement_is_chosen_where_the_other_loses_too_much() -> None:
    """A slope near the DPU's own is approximated, one far from it is replaced exactly.

    Exact replacements take more operations, so they are worth it for the second alone.
    """
    near = adapt(network(leaky(0.1)), BARE, BARE)
    assert "compensated" in near.record
    assert near.rows[-1].figures["PSNR lost, compensated"].mode == "unavailable"
    steep = network(leaky(-0.9))
    far = adapt(steep, BARE, BARE)
    assert "exactly" in far.record
    assert_same_on_any_size(steep, far.model)
    kind, together = (row.figures[TO_ORIGINAL] for row in far.rows)
    assert kind.value is not None
    assert kind.value < NEAR_DB
    assert together.value is None or together.value > 100


def test_activations_that_are_supported_or_irreplaceable_stay() -> None:
    """A network without anything to replace is returned as it is.

    An operator without a replacement is refused by its name before time is spent on a fit.
    """
    for act in (leaky(DPU_SLOPE), elu):
        model = network(act)
        assert adapt(model, SAMPLES, HELD_OUT).model is model
    with pytest.raises(ModelError, match="Elu first"):
        read_network(network(elu))
    # The refusal comes before any fit, even if other activations can be replaced.
    with pytest.raises(ModelError, match="Elu third"):
        adapt(network(silu_but_elu_third), BARE, BARE)


def batches(pairs: Patches) -> tuple[np.ndarray, np.ndarray]:
    """Return degraded images and references, each as one array (N, 1, H, W)."""
    degraded, references = zip(*pairs.pairs, strict=True)
    return np.concatenate(degraded), np.concatenate(references)


@pytest.mark.parametrize("name", ["SiLU", "LeakyReLU"])
def test_quantize_adapts_and_compares_with_the_original(name: str, tmp_path: Path) -> None:
    """`quantize` refuses the network without `adapt`, and with it reports what was replaced.

    The INT8 file is compared with the original and not with its replacement, so that no loss is
    hidden.
    """
    act, kind = REPLACED[name]
    original = network(act)
    samples = batches(SAMPLES)
    with pytest.raises(ModelError, match="adapt"):
        bd.quantize(original, samples=samples, progress=False)
    with one_guess():
        int8 = bd.quantize(original, samples=samples, adapt=True, progress=False)
    assert int8.origin is not None
    original_kinds = {node.op_type for node in int8.origin.model.graph.node}
    assert original_kinds & {"Sigmoid", "LeakyRelu"}
    assert name in metadata(int8.model)[ADAPTED]
    assert int8.table is not None
    rows = [row.name for row in int8.table.rows if row.table == ADAPTED]
    assert rows == [f"3 {kind}", "all"]
    path = int8.save(tmp_path / "int8.onnx")
    verdict = bd.compare(original, path, samples=batches(HELD_OUT), progress=False)
    assert verdict.result.psnr_between_db > 30


@pytest.mark.parametrize("free", [False, True])
def test_spatial_attention_is_aligned_and_compensated(free: bool) -> None:
    """The refusal names `adapt`, and the adapted network is near to the original.

    Its resize becomes two of powers of two, for images of one size and of any size.
    """
    model = attention_network(free)
    with pytest.raises(ModelError, match=r"no whole factor. 'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, SAMPLES, HELD_OUT)
    assert [row.name for row in adapted.rows] == ["1 spatial attention (ESA)", "1 Sigmoid", "all"]
    graph = read_network(adapted.model).graph
    assert [op.factor for op in graph if isinstance(op, Resize)] == [4, 2]
    strides = [node.attributes.get("strides") for node in OnnxGraph(adapted.model).nodes]
    assert [4, 4] in strides
    assert_near(adapted, 40)


@pytest.mark.parametrize("factor", [1, 4])
def test_a_standard_deviation_becomes_the_mean_absolute_deviation(factor: float) -> None:
    """The refusal names `adapt`, the network stays near, and the gate counts the ReLU for it."""
    model = contrast_network(48, factor)
    with pytest.raises(ModelError, match=r"standard deviation .* 'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, BARE, BARE)
    assert adapted.rows[0].name == "1 standard deviation over the image"
    assert_near(adapted, 50)
    int8 = quickly(adapted.model, BARE)
    assert structure_checks(model, int8.host)[0].value == 0


def test_nothing_to_replace_is_a_note_and_conditioned_weights_are_refused() -> None:
    """`adapt` without an effect is a note for a user's network, and an error for a shipped one."""
    samples, _ = batches(SAMPLES)
    with one_guess():
        int8 = bd.quantize(network(leaky(DPU_SLOPE)), samples=samples, adapt=True, progress=False)
    assert int8.table is not None
    assert any("replaced nothing" in note for note in int8.table.notes)
    with pytest.raises(OptionError, match="`adapt` has no effect"):
        bd.quantize("convbeers-xs", adapt=True)
