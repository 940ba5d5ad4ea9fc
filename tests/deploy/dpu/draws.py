"""Nodes between two convolutions, functions that place networks on a DPU, and the rules that they
break.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import onnx

from beers_deploy.dpu.board import Dpu, load_dpu
from beers_deploy.dpu.checker.placement import PlacedNode, Placement, place
from beers_deploy.dpu.reading import read_sized_graph
from tests.deploy.dpu.graphs import SAME, written

DPU = load_dpu("vck190")
TILE_PX = 288


@contextmanager
def as_written() -> Iterator[None]:
    """Read files without simplifying them."""
    with patch("beers_deploy.quant.onnx_file.simplify", lambda model, _: model):
        yield


def placed_file(path: Path, tile_px: int = TILE_PX, dpu: Dpu = DPU) -> Placement:
    """Read a file, and place its nodes on a DPU."""
    return place(read_sized_graph(path, tile_px), dpu)


def placed(model: onnx.ModelProto, tile_px: int = TILE_PX, dpu: Dpu = DPU) -> Placement:
    """Write a network to a file, read it, and place its nodes on a DPU."""
    with TemporaryDirectory() as folder:
        onnx.save_model(model, Path(folder) / "network.onnx")
        return placed_file(Path(folder) / "network.onnx", tile_px, dpu)


def broken_rules(model: onnx.ModelProto, tile_px: int = TILE_PX, dpu: Dpu = DPU) -> list[str]:
    """Return the names of the rules that the nodes of a network break."""
    return rules_of(placed(model, tile_px, dpu).nodes)


def rules_of(nodes: Iterable[PlacedNode]) -> list[str]:
    """Return the names of the rules that nodes break, node by node."""
    violations = chain.from_iterable(node.broken for node in nodes)
    return [violation.rule for violation in violations]


def between_convs(nodes: str, dpu: Dpu = DPU, channels: int = 8) -> list[str]:
    """Return the rules that nodes from `x` to `y` break between two convolutions."""
    # One of a single pixel would be folded into the next.
    first = f"x = {SAME}(image, w{channels}x{channels}x3x3)"
    last = f"p = AveragePool<kernel_shape=[1,1]>(y) z = Conv(p, w1x{channels}x1x1)"
    return broken_rules(written(f"{first} {nodes} {last}", channels, ("z",)), dpu=dpu)


CONV = f"y = {SAME}(x, w)"


def behind_conv(node: str) -> str:
    """Return a convolution of `x` and a node that reads it as `a` and writes `y`."""
    return f"a = {SAME}(x, w) y = {node}"


def behind_depthwise(node: str) -> str:
    return f"a = Conv<pads=[1,1,1,1], group=8>(x, w8x1x3x3) y = {node}"


def behind_sum(node: str) -> str:
    return f"a = Add(x, x) y = {node}"


def behind_mean(node: str) -> str:
    return f"a = AveragePool<kernel_shape=[2,2]>(x) y = {node}"


def behind_pool(node: str) -> str:
    return f"a = MaxPool<kernel_shape=[2,2]>(x) y = {node}"


def depthwise(window: str, rows: int, columns: int) -> str:
    return f"y = Conv<group=8, {window}>(x, w8x1x{rows}x{columns})"
