"""Tests that users' networks are quantised, equal the reference, keep bounds and can be tiled."""

import json
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from numpy.testing import assert_array_equal

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.encodings import as_on_board, board_model, encoding_faults, read_core
from beers_deploy.quant.encodings.description import KEY
from beers_deploy.quant.integer.agreement import agreement, integer_rows
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.passes.selection import Passes
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.tiling.receptive_field import tiling_of
from examples.networks import NETWORKS, build, to_onnx
from tests.quant.quick import assert_within_bounds, copied, patches_of, quickly, run_model
from tests.quant.simplify.networks import parsed
from tests.quant.tiling.small_networks import check_tiles
from tests.quant.trained import assert_equals_reference, moved

SIDE_PX = 48
EACH = pytest.mark.parametrize("name", NETWORKS)


def images(name: str, count: int = 3, side: int = SIDE_PX) -> list[np.ndarray]:
    """Return smooth patches with an edge, (1, C, h, w) float32 in [0, 1], for a network."""
    generator = np.random.default_rng(7)
    rows, columns = np.mgrid[:side, :side] / side
    patches = []
    for k in range(count):
        waves = (
            0.3
            + 0.2 * np.sin(9 * rows + k) * np.cos(7 * columns)
            + 0.3 * (rows + columns > 0.8 + 0.2 * k)
        )
        bands = [waves * share for share in np.linspace(1, 0.5, NETWORKS[name].inputs)]
        noisy = np.stack(bands) + 0.01 * generator.standard_normal((len(bands), side, side))
        patches.append(np.clip(noisy, 0, 1).astype(np.float32)[None])
    return patches


@cache
def float_network(name: str) -> onnx.ModelProto:
    return simplify(to_onnx(name, build(name, torch.Generator().manual_seed(0))), name)


@cache
def quantized(name: str) -> Quantized:
    return quickly(float_network(name), patches_of(images(name)))


@EACH
def test_int8_stays_near_float(name: str) -> None:
    int8 = quantized(name)
    image = images(name)[1]
    expected = int8.core.host_part.clip(run_model(float_network(name), image))
    actual = run_model(int8.host, image)
    assert actual.shape == expected.shape
    assert np.abs(actual - expected).mean() < 0.15 * max(float(expected.std()), 0.05)


@EACH
def test_the_integer_reference_equals_the_runtime_bit_for_bit(name: str) -> None:
    int8 = quantized(name)
    image = images(name)[2]
    layers = agreement(int8.core, int8.host, image)
    assert [layer.report.name for layer in layers.layers if layer.unequal] == []
    result = run_model(int8.host, image)
    assert_array_equal(int8.core.host_part.finish(image, layers.even), result)


def test_layers_are_compared_at_a_size_that_the_network_accepts() -> None:
    """Half of this sample's side is no multiple of the network's strides."""
    int8 = quantized("unet")
    side_px = 128 + tiling_of(int8.host).alignment_px
    samples = images("unet", 1, side_px)
    rows = integer_rows(float_network("unet"), int8.core, int8.host, samples)
    *layers, _ = rows
    assert {row.figures["as onnxruntime"].value for row in layers} == {100}


@EACH
def test_training_computes_the_integers_of_the_reference(name: str) -> None:
    int8 = quantized(name)
    assert_equals_reference(moved(int8.core), int8.core.host_part.encode(images(name, 4)[3]))


@EACH
def test_no_image_leaves_the_proven_bounds(name: str) -> None:
    core = quantized(name).core
    assert_within_bounds(core, core.host_part.encode(np.round(images(name)[0])))


@EACH
def test_a_file_is_read_back_as_the_core_it_was_written_from(name: str) -> None:
    int8 = quantized(name)
    core = read_core(int8.host)
    assert encoding_faults(int8.host) == []
    for one, other in zip(core.convolutions, int8.core.convolutions, strict=True):
        assert_array_equal(one.weight, other.weight)
        assert (one.window, one.groups, one.activation) == (
            other.window,
            other.groups,
            other.activation,
        )
    planes = int8.core.host_part.encode(images(name)[0])
    assert_array_equal(
        run_core(core, planes)[0]["correction"], run_core(int8.core, planes)[0]["correction"]
    )


def test_a_node_that_differs_from_the_description_is_a_fault() -> None:
    corrupted = copied(quantized("unet").host)
    node = next(
        candidate for candidate in corrupted.graph.node if candidate.op_type == "ConvInteger"
    )
    node.attribute[0].ints[0] += 1
    assert encoding_faults(corrupted) == [f"node {node.name}"]


@pytest.mark.parametrize(
    "change",
    [
        lambda description: description["ops"][0].update(kind="Sort"),
        lambda description: description["ops"][0]["window"].update(strides=[10**9, 10**9]),
        lambda description: description["ends"].update(planes="three"),
        lambda description: description["frac_bits"].update(planes=10**9),
        lambda description: description["ops"][0].pop("weight"),
        lambda description: description.pop("ends"),
        lambda description: description["ops"].clear(),
    ],
)
def test_an_invalid_description_raises_no_other_error(
    change: Callable[[dict[str, Any]], object],
) -> None:
    corrupted = copied(quantized("unet").host)
    entry = next(candidate for candidate in corrupted.metadata_props if candidate.key == KEY)
    description = json.loads(entry.value)
    change(description)
    entry.value = json.dumps(description)
    # The file may be read or refused with ModelError. No other error may come out.
    with suppress(ModelError):
        assert encoding_faults(corrupted)
    with suppress(ModelError):
        as_on_board(corrupted)


@EACH
def test_the_core_is_legal_on_the_dpu(name: str) -> None:
    dpu = load_dpu("vck190", None)
    for file in (quantized(name).host, board_model(quantized(name).core, {})):
        assert legality(place(sized_graph(file, 64), dpu), dpu).passed


@EACH
def test_tiles_of_int8_give_the_whole(name: str) -> None:
    model = quantized(name).host
    alignment_px = tiling_of(model).alignment_px
    check_tiles(model, images(name, 1, 64)[0], (16 // alignment_px, 24 // alignment_px))


def one_convolution(weight: float, bias: float) -> onnx.ModelProto:
    """Build image * weight + bias, without a global add."""
    return parsed(
        "restored = Conv(image, w, b)",
        "float[N,1,H,W] image => float[N,1,H,W] restored",
        constants={"w": [[[[weight]]]], "b": [bias]},
    )


@pytest.mark.parametrize(("weight", "bias"), [(1.0, 0.0), (-0.7, 0.93), (0.4, -0.31)])
def test_windows_make_a_result_finer_than_8_bits(weight: float, bias: float) -> None:
    image_list = images("ffdnet")
    patches = patches_of(image_list)
    model = one_convolution(weight, bias)
    errors = []
    for dual in (True, False):
        int8 = quantize_model(model, patches, {}, passes=Passes(dual_range=dual))
        expected = run_model(model, image_list[0])
        actual = run_model(int8.host, image_list[0])
        # The rounding of the one weight and bias is the same in both, and is left out.
        line = np.polynomial.Polynomial.fit(expected.ravel(), actual.ravel(), 1)
        errors.append(float((actual - line(expected)).std()))
        assert encoding_faults(int8.host) == []
    assert errors[0] < 0.4 * errors[1]
