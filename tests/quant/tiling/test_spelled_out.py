"""Pixel shuffles spelled out as torch does are seen as one operator; whatever else moves pixels is left as it is."""

import warnings
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import helper
from torch import Tensor, nn

from profiles.errors import ModelError
from quant.tiling.spelled_out import with_shuffles
from quant.tiling.walk import Tiling, tiling_of
from tests.quant.tiling.small_networks import graph, whole


class Old(nn.Module):
    """A pixel shuffle as it was written before there was one."""

    def forward(self, x: Tensor) -> Tensor:
        """Images (N, 4, H, W) to (N, 1, 2 H, 2 W)."""
        count, _, height, width = x.shape
        return (
            x.view(count, 1, 2, 2, height, width).permute(0, 1, 4, 2, 5, 3).reshape(count, 1, 2 * height, 2 * width)
        )


def exported(network: nn.Module, any_size: bool, folder: Path) -> onnx.ModelProto:
    """As torch's own exporter leaves it."""
    path, axes = folder / "network.onnx", {2: "H", 3: "W"}
    dynamic = {"image": axes, "restored": axes} if any_size else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network, (torch.zeros(1, 1, 24, 24),), path, dynamo=False, opset_version=17,
            input_names=["image"], output_names=["restored"], dynamic_axes=dynamic,
        )  # fmt: skip
    return onnx.load_model(path)


@pytest.mark.parametrize("any_size", [True, False])
@pytest.mark.parametrize("size", [2, 3])
def test_what_torch_makes_of_an_unshuffle_is_one(size: int, any_size: bool, tmp_path: Path) -> None:
    count = size * size
    network = nn.Sequential(nn.PixelUnshuffle(size), nn.Conv2d(count, count, 3, padding=1), nn.PixelShuffle(size))
    model = exported(network, any_size, tmp_path)
    assert "Transpose" in {node.op_type for node in model.graph.node}
    assert tiling_of(model) == Tiling(size, size, fixed_px=None if any_size else 24)


def test_a_shuffle_of_old_is_one(tmp_path: Path) -> None:
    model = exported(nn.Sequential(nn.Conv2d(1, 4, 1), Old()), any_size=False, folder=tmp_path)
    assert [node.op_type for node in with_shuffles(model).graph.node][-1] == "DepthToSpace"
    assert tiling_of(model).scale == 2


TURNED = graph([helper.make_node("Transpose", ["image"], ["restored"], name="turn", perm=[0, 1, 3, 2])])
FLAT = graph(
    [
        helper.make_node("Reshape", ["image", "flat"], ["line"], name="flatten"),
        helper.make_node("Reshape", ["line", "square"], ["restored"]),
    ],
    whole("flat", 1, 1, 1, -1),
    whole("square", 1, 1, 12, -1),
)


@pytest.mark.parametrize("model", [TURNED, FLAT])
def test_whatever_else_moves_pixels_is_left(model: onnx.ModelProto) -> None:
    assert with_shuffles(model).graph == model.graph
    with pytest.raises(ModelError, match="which moves pixels"):
        tiling_of(model)


def test_a_row_that_leads_back_is_a_shuffle_of_one() -> None:
    model = graph(
        [
            helper.make_node("Unsqueeze", ["image", "at"], ["more"]),
            helper.make_node("Squeeze", ["more", "at"], ["restored"]),
        ],
        whole("at", 2),
    )
    assert tiling_of(model) == Tiling(0)


def test_what_reads_the_middle_of_a_row_sees_it() -> None:
    nodes = [
        helper.make_node("Unsqueeze", ["image", "at"], ["more"]),
        helper.make_node("Squeeze", ["more", "at"], ["less"]),
        helper.make_node("ReduceSum", ["more", "at"], ["other"]),
        helper.make_node("Add", ["less", "other"], ["restored"]),
    ]
    model = graph(nodes, whole("at", 2))
    assert np.array_equal([node.op_type for node in with_shuffles(model).graph.node], [n.op_type for n in nodes])
