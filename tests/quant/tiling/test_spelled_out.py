"""Pixel shuffles spelled out as torch does are seen as one operator; whatever else moves pixels is
left as it is.
"""

import warnings
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper
from torch import nn

from beers_deploy.dpu.reading import network_of
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.graph.pixel_shuffle import with_shuffles
from beers_deploy.quant.simplify.simplify import simplify
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from tests.quant.tiling.small_networks import graph, whole


def exported(network: nn.Module, any_size: bool, folder: Path, opset: int = 17) -> onnx.ModelProto:
    """As torch's own exporter leaves it."""
    path = folder / "network.onnx"
    axes = {2: "H", 3: "W"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
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
def test_what_torch_makes_of_an_unshuffle_is_one(size: int, any_size: bool, tmp_path: Path) -> None:
    count = size * size
    network = nn.Sequential(
        nn.PixelUnshuffle(size), nn.Conv2d(count, count, 3, padding=1), nn.PixelShuffle(size)
    )
    model = exported(network, any_size, tmp_path)
    assert "Transpose" in {node.op_type for node in model.graph.node}
    assert tiling_of(model) == Tiling(size, size, fixed_px=None if any_size else 70)
    front = read_network(simplify(model, "exported")).front
    assert [(shuffle.block, shuffle.up, shuffle.columns_first) for shuffle in front] == [
        (size, False, True)
    ]


def test_a_shuffle_of_an_old_opset_is_one(tmp_path: Path) -> None:
    model = exported(
        nn.Sequential(nn.Conv2d(1, 4, 1), nn.PixelShuffle(2)), False, tmp_path, opset=9
    )
    assert "DepthToSpace" not in {node.op_type for node in model.graph.node}
    assert with_shuffles(model).nodes[-1].op_type == "DepthToSpace"
    assert tiling_of(model).scale == 2


def moves(*nodes: onnx.NodeProto) -> onnx.ModelProto:
    sizes = {"at": [2], "flat": [1, 1, 1, -1], "square": [1, 1, 12, -1]}
    return graph(list(nodes), *(whole(name, *values) for name, values in sizes.items()))


MORE = helper.make_node("Unsqueeze", ["image", "at"], ["more"])
LEFT = {
    "turned": moves(
        helper.make_node("Transpose", ["image"], ["restored"], name="turn", perm=[0, 1, 3, 2])
    ),
    "flat": moves(
        helper.make_node("Reshape", ["image", "flat"], ["line"], name="flatten"),
        helper.make_node("Reshape", ["line", "square"], ["restored"]),
    ),
    "read in the middle": moves(
        MORE,
        helper.make_node("Squeeze", ["more", "at"], ["less"]),
        helper.make_node("ReduceSum", ["more", "at"], ["other"]),
        helper.make_node("Add", ["less", "other"], ["restored"]),
    ),
}


@pytest.mark.parametrize("name", LEFT)
def test_whatever_else_moves_pixels_is_left(name: str) -> None:
    assert [node.proto for node in with_shuffles(LEFT[name]).nodes] == list(LEFT[name].graph.node)
    with pytest.raises(ModelError, match=" moves pixels"):
        tiling_of(LEFT[name])


def test_a_row_that_leads_back_is_a_shuffle_of_one() -> None:
    assert tiling_of(
        moves(MORE, helper.make_node("Squeeze", ["more", "at"], ["restored"]))
    ) == Tiling(0)


def test_moves_between_integers_are_of_integers() -> None:
    unit = ["unit", "zero"]
    nodes = [
        helper.make_node("QuantizeLinear", ["image", *unit], ["int8"]),
        helper.make_node("DequantizeLinear", ["int8", *unit], ["seen"]),
        helper.make_node("Unsqueeze", ["seen", "at"], ["more"]),
        helper.make_node("Squeeze", ["more", "at"], ["less"]),
        helper.make_node("QuantizeLinear", ["less", *unit], ["moved"]),
        helper.make_node("DequantizeLinear", ["moved", *unit], ["restored"]),
    ]
    values = {"unit": np.float32(0.5), "zero": np.int8(0), "at": np.array([2])}
    model = graph(
        nodes, *(numpy_helper.from_array(np.asarray(value), name) for name, value in values.items())
    )
    kinds = [(op.kind, op.integer) for op in network_of(model, 8).operations]
    assert kinds == [("quantize", True), ("pixel shuffle", True), ("dequantize", False)]
