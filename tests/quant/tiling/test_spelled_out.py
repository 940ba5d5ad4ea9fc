"""Tests that torch's spelled-out pixel shuffles are read as one operator, and nothing else is."""

import warnings
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import ArrayLike
from torch import nn

from beers_deploy.dpu.reading import sized_graph
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.graph.pixel_shuffle import with_shuffles
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from tests.quant.simplify.networks import parsed
from tests.quant.tiling.small_networks import network


def exported(module: nn.Module, any_size: bool, folder: Path, opset: int = 17) -> onnx.ModelProto:
    """Export a module with torch's older exporter, which spells shuffles out."""
    path = folder / "network.onnx"
    axes = {2: "H", 3: "W"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (torch.zeros(1, 1, 70, 70),),
            path,
            dynamo=False,
            opset_version=opset,
            input_names=["image"],
            output_names=["restored"],
            dynamic_axes={"image": axes, "restored": axes} if any_size else None,
        )
    return onnx.load_model(path)


@pytest.mark.parametrize("any_size", [True, False])
@pytest.mark.parametrize("size", [2, 5])
def test_a_spelled_out_unshuffle_is_read_as_one(size: int, any_size: bool, tmp_path: Path) -> None:
    count = size * size
    module = nn.Sequential(
        nn.PixelUnshuffle(size), nn.Conv2d(count, count, 3, padding=1), nn.PixelShuffle(size)
    )
    model = exported(module, any_size, tmp_path)
    assert "Transpose" in {node.op_type for node in model.graph.node}
    assert tiling_of(model) == Tiling(size, size, fixed_px=None if any_size else 70)
    front = read_network(simplify(model, "exported")).front
    assert [(shuffle.block, shuffle.up, shuffle.columns_first) for shuffle in front] == [
        (size, False, True)
    ]


def test_a_shuffle_of_an_old_opset_is_read_as_one(tmp_path: Path) -> None:
    model = exported(
        nn.Sequential(nn.Conv2d(1, 4, 1), nn.PixelShuffle(2)), False, tmp_path, opset=9
    )
    assert "DepthToSpace" not in {node.op_type for node in model.graph.node}
    assert with_shuffles(model).nodes[-1].op_type == "DepthToSpace"
    assert tiling_of(model).scale == 2


NUMBERS: dict[str, ArrayLike] = {
    "at": [2],
    "flat": [1, 1, 1, -1],
    "square": [1, 1, 12, -1],
    "unit": 0.5,
}
NUMBERS["zero"] = np.int8(0)
OTHER_MOVES = [
    "restored = Transpose<perm=[0,1,3,2]>(image)",
    "line = Reshape(image, flat) restored = Reshape(line, square)",
    """more = Unsqueeze(image, at)
    less = Squeeze(more, at)
    other = ReduceSum(more, at)
    restored = Add(less, other)""",
]


@pytest.mark.parametrize("nodes", OTHER_MOVES)
def test_other_operators_that_move_pixels_are_not_changed(nodes: str) -> None:
    model = network(nodes, NUMBERS)
    assert [node.proto for node in with_shuffles(model).nodes] == list(model.graph.node)
    with pytest.raises(ModelError, match=" moves pixels"):
        tiling_of(model)


def test_a_column_that_becomes_channels_is_no_shuffle() -> None:
    ends = "float[1,1,16,1] image => float[1,16,1,1] restored"
    model = parsed("restored = Reshape(image, sizes)", ends, constants={"sizes": [1, 16, 1, 1]})
    assert [node.op_type for node in with_shuffles(model).nodes] == ["Reshape"]


def test_operators_that_cancel_are_a_shuffle_of_block_one() -> None:
    model = network("more = Unsqueeze(image, at) restored = Squeeze(more, at)", NUMBERS)
    assert tiling_of(model) == Tiling(0)


def test_operators_that_move_integers_are_integer_operators() -> None:
    nodes = """
        int8 = QuantizeLinear(image, unit, zero)
        seen = DequantizeLinear(int8, unit, zero)
        more = Unsqueeze(seen, at)
        less = Squeeze(more, at)
        moved = QuantizeLinear(less, unit, zero)
        restored = DequantizeLinear(moved, unit, zero)
    """
    operations = sized_graph(network(nodes, NUMBERS), 8).operations
    kinds = [(op.kind, op.integer) for op in operations]
    assert kinds == [("quantize", True), ("pixel shuffle", True), ("dequantize", False)]
