"""Functions that add nodes between two convolutions, place networks on a DPU, and list the rules
that they break.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import onnx

from beers_deploy.dpu.board import Dpu, load_dpu
from beers_deploy.dpu.checker.placement import PlacedNode, Placement, place
from beers_deploy.dpu.reading import read_network
from tests.deploy.dpu.graphs import Sketch, Value

Draw = Callable[[Sketch, str], str]
DPU = load_dpu("vck190")
TILE_PX = 288


@contextmanager
def as_written() -> Iterator[None]:
    """Read files without simplifying them."""
    with patch("beers_deploy.quant.onnx_file.simplify", lambda model, _: model):
        yield


def placed_file(path: Path, tile_px: int = TILE_PX, dpu: Dpu = DPU) -> Placement:
    """Read a file, and place its nodes on a DPU."""
    return place(read_network(path, tile_px), dpu)


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


def between_convs(draw: Draw, dpu: Dpu = DPU, channels: int = 8) -> list[str]:
    """Return the rules that a network with `draw` between two convolutions breaks."""
    sketch = Sketch(channels)
    middle = draw(sketch, sketch.conv("image", (channels, channels, 1, 1)))
    result = sketch.node("AveragePool", middle, kernel_shape=[1, 1])
    return broken_rules(sketch.model(sketch.conv(result, (1, channels, 1, 1))), dpu=dpu)


def conv(*weight: int, **attributes: Value) -> Draw:
    return lambda sketch, source: sketch.conv(source, weight, **attributes)


def transposed(*weight: int, **attributes: Value) -> Draw:
    return lambda sketch, source: sketch.node(
        "ConvTranspose", source, sketch.weight(*weight), **attributes
    )


def node(op_type: str, **attributes: Value) -> Draw:
    return lambda sketch, source: sketch.node(op_type, source, **attributes)


def scaled(*shape: int) -> Draw:
    return lambda sketch, source: sketch.node("Mul", source, sketch.weight(*shape))


def resized(scale: float, **attributes: Value) -> Draw:
    return lambda sketch, source: sketch.node(
        "Resize",
        source,
        "",
        sketch.constant(np.array([1, 1, scale, scale], np.float32)),
        **attributes,
    )


def padded(mode: str) -> Draw:
    pads = np.array([0, 0, 2, 2, 0, 0, 2, 2], np.int64)
    return lambda sketch, source: sketch.node("Pad", source, sketch.constant(pads), mode=mode)


def in_two(first: Draw, second: Draw) -> Draw:
    """Return a draw that applies `first` and then `second`."""
    return lambda sketch, source: second(sketch, first(sketch, source))


def conv_3x3(**attributes: Value) -> Draw:
    return conv(8, 8, 3, 3, **attributes)


def depthwise(height: int, width: int, **attributes: Value) -> Draw:
    return conv(8, 1, height, width, group=8, **attributes)


def max_pool(rows: int, columns: int, **attributes: Value) -> Draw:
    return node("MaxPool", kernel_shape=[rows, columns], **attributes)


def doubled(sketch: Sketch, source: str) -> str:
    return sketch.node("Add", source, source)


def behind_conv(op_type: str, **attributes: Value) -> Draw:
    return in_two(conv_3x3(), node(op_type, **attributes))


def behind_depthwise(op_type: str, **attributes: Value) -> Draw:
    return in_two(depthwise(3, 3), node(op_type, **attributes))


def behind_sum(op_type: str, **attributes: Value) -> Draw:
    return in_two(doubled, node(op_type, **attributes))


def mean_pool() -> Draw:
    return node("AveragePool", kernel_shape=[2, 2])


def behind_mean(op_type: str) -> Draw:
    return in_two(mean_pool(), node(op_type))


def behind_pool(op_type: str, **attributes: Value) -> Draw:
    return in_two(max_pool(2, 2), node(op_type, **attributes))
