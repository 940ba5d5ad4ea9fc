"""Tests that a network's error is attributed to its layers."""

import math
from dataclasses import replace

import numpy as np
import onnx
import pytest

from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import Add
from beers_deploy.quant.passes.selection import Passes
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.sensitivity import Loss, layer_error_rows, layer_errors, losses
from beers_deploy.quant.session import open_session, result_of, run
from beers_deploy.studies.stress.faults import with_ops
from tests.quant.quick import image, patches_of, quickly, without_references
from tests.quant.simplify.networks import parsed

CORRUPTED = "body.1.second"


@pytest.fixture(scope="module")
def crops(patches: Patches) -> list[np.ndarray]:
    """Return three crops of odd sides, which are no whole number of blocks."""
    return [image[..., :61, :53] for image in list(patches.degraded)[:3]]


def differences_of(
    int8: Quantized, float_onnx: onnx.ModelProto, crops: list[np.ndarray]
) -> list[np.ndarray]:
    """Return INT8 minus float for each crop, both clipped as `restore` clips them."""
    in_float = open_session(float_onnx)
    in_int8 = open_session(int8.host)
    # The INT8 file clips its result itself.
    return [run(in_int8, crop) - run(in_float, crop).clip(0, 1) for crop in crops]


def test_the_errors_of_layers_sum_to_that_of_the_int8_file_and_adds_hardly_err(
    float_onnx: onnx.ModelProto, quantized: Quantized, crops: list[np.ndarray]
) -> None:
    """Squared errors nearly add up. Adds of a shared residual scale err by saturation alone."""
    layers, together = layer_errors(quantized.graph, quantized.core, crops)
    differences = np.concatenate(differences_of(quantized, float_onnx, crops))
    assert together.mae == pytest.approx(float(np.abs(differences).mean()), rel=1e-3)
    squared_errors = {layer.name: layer.network.squared for layer in layers}
    assert sum(squared_errors.values()) == pytest.approx(together.squared, rel=0.4)
    adds = sum(squared_errors.pop(op.name) for op in quantized.core.ops if isinstance(op, Add))
    assert adds < 0.1 * sum(squared_errors.values())


def test_an_image_that_is_added_before_a_pixel_shuffle_is_no_error(
    crops: list[np.ndarray], patches: Patches
) -> None:
    """SESR adds it to each of the four phases, so that the result is larger than the image."""
    model = parsed(
        """c = Conv<pads=[1,1,1,1]>(x, w) a = Add(c, x)
        y = DepthToSpace<blocksize=2, mode="CRD">(a)""",
        "float[N,1,H,W] x => float[N,1,H2,W2] y",
        constants={"w": np.random.default_rng(0).normal(0, 0.1, (4, 1, 3, 3))},
    )
    int8 = quickly(model, patches)
    _, together = layer_errors(int8.graph, int8.core, crops)
    in_float, in_int8 = (open_session(each) for each in (model, int8.host))
    errors = [
        abs(result_of(in_int8, crop) - result_of(in_float, crop).clip(0, 1)).mean()
        for crop in crops
    ]
    assert together.mae == pytest.approx(np.mean(errors), rel=1e-3)
    assert together.sqnr_db > 20


def test_a_network_of_a_large_fixed_size_is_attributed_on_whole_images() -> None:
    """Images of more than 128 pixels a side are several tiles for other networks."""
    model = parsed(
        "y = Conv<pads=[1,1,1,1]>(x, w)",
        "float[1,1,132,132] x => float[1,1,132,132] y",
        constants={"w": np.random.default_rng(0).normal(0, 0.1, (1, 1, 3, 3))},
    )
    patches = patches_of([image(132, 132)])
    layer, together = layer_error_rows(quickly(model, patches), patches)
    key = "share of squared error"
    assert layer.figures[key].value == pytest.approx(100)
    assert together.name == "all layers"


@pytest.fixture(scope="module")
def corrupted(quantized: Quantized) -> Quantized:
    """Return the network with the weights of one layer negated."""
    op = next(op for op in quantized.core.convolutions if op.name == CORRUPTED)
    core = with_ops(quantized.core, [replace(op, weight=-op.weight)])
    return replace(quantized, core=core, host=host_model(core, {}))


def test_the_loss_is_reported_and_a_large_one_with_its_layer(
    float_onnx: onnx.ModelProto, corrupted: Quantized, patches: Patches, crops: list[np.ndarray]
) -> None:
    """The sentence about the loss names the layer that errs most if the loss is large.

    It advises fine-tuning then, but not for a network that is fine-tuned already.
    """
    gate = compare(open_session(float_onnx), open_session(corrupted.host), patches)
    assert gate.worst_drop_db > gate.drop_db
    slight = replace(gate, psnr_float_db=40.0, psnr_int8_db=39.9, worst_drop_db=2.0)
    assert losses(corrupted, slight, patches) == (
        "INT8 loses 0.10 dB against 40.00 dB in float, and loses 2.00 dB at worst "
        "(6 simulated patches of 128 x 128)"
    )
    better = replace(slight, psnr_int8_db=40.2)
    assert losses(corrupted, better, patches).startswith("INT8 gains 0.20 dB against 40.00 dB")
    strong = replace(slight, psnr_int8_db=39.6)
    few = patches_of(crops)
    much = losses(corrupted, strong, few)
    layers, _ = layer_errors(corrupted.graph, corrupted.core, crops)
    worst = max(layers, key=lambda layer: layer.network.squared)
    assert f": most of it in {worst.name} (" in much
    assert much.endswith("; try `finetune` auto")
    without = replace(gate, psnr_float_db=math.nan)
    assert losses(corrupted, without, patches).endswith("references are not of the result's size")
    assert losses(corrupted, without, without_references(patches)).endswith("patches of 128 x 128)")
    tuned = replace(corrupted, host=host_model(corrupted.core, {"finetune": "3 steps"}))
    drop = replace(gate, psnr_float_db=40.0, psnr_int8_db=39.6)
    assert losses(tuned, drop, few).endswith(" %)")


def test_a_corrupted_layer_is_found(corrupted: Quantized, crops: list[np.ndarray]) -> None:
    """The error is attributed to this layer and to no other."""
    layers, _ = layer_errors(corrupted.graph, corrupted.core, crops)
    worst = min(layers, key=lambda layer: layer.alone.sqnr_db)
    assert worst.name == CORRUPTED
    assert worst.alone.sqnr_db < 0
    assert all(layer.alone.sqnr_db > 10 for layer in layers if layer.name != CORRUPTED)


def test_one_gain_is_attributed_as_two_are(
    float_onnx: onnx.ModelProto, patches: Patches, crops: list[np.ndarray]
) -> None:
    """With one gain the last layer's own error is about its error in the network.

    No layer behind it can change the error, so both figures must agree.
    """
    int8 = quickly(float_onnx, patches, passes=Passes(dual_range=False))
    layers, _ = layer_errors(int8.graph, int8.core, crops)
    tail = layers[-1]
    assert tail.alone.sqnr_db == pytest.approx(tail.network.sqnr_db, abs=1)


def test_loss_is_that_of_its_definition() -> None:
    """MAE, squared error and SQNR are those of all values together, however many parts they come
    in.
    """
    target = np.array([3.0, -4.0, 0.5])
    loss = Loss()
    loss.add(target[:2] + 0.1, target[:2])
    loss.add(target[2:] - 0.2, target[2:])
    assert loss.mae == pytest.approx(0.4 / 3)
    assert loss.squared == pytest.approx(0.06 / 3)
    assert loss.sqnr_db == pytest.approx(10 * np.log10(25.25 / 0.06))
    same = Loss()
    same.add(target, target)
    assert same.sqnr_db == np.inf


def test_spread_counts_every_pixel_by_its_difference(
    float_onnx: onnx.ModelProto, quantized: Quantized, crops: list[np.ndarray]
) -> None:
    """The counts, standard deviation and shares of the gate are those of the differences in pixels.

    The worst patches come first, because a report shows them.
    """
    in_float = open_session(float_onnx)
    in_int8 = open_session(quantized.host)
    spread = compare(in_float, in_int8, patches_of(crops)).spread
    difference = np.concatenate(differences_of(quantized, float_onnx, crops))
    assert spread.counts.sum() == difference.size
    dn = np.rint(difference * MAX_DN)
    assert spread.std_dn == pytest.approx(float(dn.std()), rel=1e-6)
    for beyond in (0, 1, 5):
        share = float((np.abs(dn) > beyond).mean())
        assert spread.share_beyond(beyond) == pytest.approx(share, abs=1e-9)
    order = spread.worst(3)
    assert sorted(order) == [0, 1, 2]
    assert spread.mae[order[0]] == spread.mae.max()
