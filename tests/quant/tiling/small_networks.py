"""Small networks as users bring them: strides, pools, transposed convolutions, shuffles,
enlargements, joins.
"""

import math
from functools import cache
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.variants import Variant
from beers_deploy.quant.domains import MICROSOFT
from beers_deploy.quant.onnx_file import any_size, image_info, make_model
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.tiling.receptive_field import tiling_of
from tests.quant.quick import patches_of, quickly


def constant(name: str, *shape: int) -> onnx.TensorProto:
    """Random weights, such that values keep their size from layer to layer."""
    values = np.random.default_rng(list(name.encode())).normal(size=shape)
    return numpy_helper.from_array(
        (values / math.sqrt(math.prod(shape[1:]))).astype(np.float32), name
    )


def whole(name: str, *values: int) -> onnx.TensorProto:
    return numpy_helper.from_array(np.array(values, np.int64), name)


def taps(name: str, *shape: int) -> onnx.TensorProto:
    """Weights of small whole numbers, whose sums are exact in any order."""
    # Sums of small integers are exact in float32, whatever order a runtime adds in.
    values = np.random.default_rng(list(name.encode())).choice([-2, -1, 1, 2, 3], shape)
    return numpy_helper.from_array(values.astype(np.float32), name)


def real(*values: float) -> onnx.TensorProto:
    """Numbers, or one by itself."""
    return numpy_helper.from_array(
        np.array(values if len(values) > 1 else values[0], np.float32), "real"
    )


def graph(
    nodes: list[onnx.NodeProto], *constants: onnx.TensorProto, bands: tuple[int, int] = (1, 1)
) -> onnx.ModelProto:
    ends = [image_info("image", bands[0], None)], [image_info("restored", bands[1], None)]
    model = make_model(helper.make_graph(nodes, "one", *ends, list(constants)), {}, microsoft=True)
    onnx.checker.check_model(model)
    return model


class Row:
    """A network written operator by operator, each of which reads what the last one made of the
    image.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self.tensor = "image"

    def add(self, kind: str, *others: onnx.TensorProto | str, **attributes: Any) -> "Row":
        """One more, and what it reads behind the last result: constants, and tensors by name."""
        feeds = [self.tensor]
        name = f"t{len(self.nodes)}"
        for other in others:
            feeds.append(other if isinstance(other, str) else f"{name}.{len(feeds)}")
            if not isinstance(other, str):
                self.weights.append(
                    numpy_helper.from_array(numpy_helper.to_array(other), feeds[-1])
                )
        self.nodes.append(helper.make_node(kind, feeds, [name], **attributes))
        self.tensor = name
        return self

    def model(self, bands: tuple[int, int] = (1, 1)) -> onnx.ModelProto:
        self.nodes[-1].output[0] = "restored"
        return graph(self.nodes, *self.weights, bands=bands)


def float_unet() -> onnx.ModelProto:
    """Convolution, pool, convolution, transposed convolution, beside the first, convolution."""
    row = Row().add("Conv", constant("first", 2, 1, 3, 3), pads=[1] * 4)
    first = row.tensor
    row.add("MaxPool", kernel_shape=[2, 2], strides=[2, 2]).add(
        "Conv", constant("middle", 2, 2, 3, 3), pads=[1] * 4
    )
    row.add("ConvTranspose", constant("up", 2, 2, 2, 2), strides=[2, 2]).add(
        "Concat", first, axis=1
    )
    return row.add("Conv", constant("last", 1, 4, 3, 3), pads=[1] * 4).model()


UNIT = ["unit", "zero"]


def int8_conv(source: str, weight: str, result: str, stride: int = 1) -> onnx.NodeProto:
    feeds = [source, *UNIT, weight, "fine", "none", *UNIT]
    return helper.make_node(
        "QLinearConv", feeds, [result], name=result, pads=[1] * 4, strides=[stride] * 2
    )


def int8_graph(
    nodes: list[onnx.NodeProto], unit: float, **weights: tuple[int, ...]
) -> onnx.ModelProto:
    """A network in whole numbers: `unit` is what 1 stands for, `weights` are
    the shapes of those.
    """
    numbers = {
        "unit": np.float32(unit),
        "coarse": np.float32(16),
        "fine": np.float32(2**-6),
        "zero": np.uint8(128),
        "none": np.int8(0),
        "four": np.array([1, 1, 4, 4], np.float32),
        "table": np.random.default_rng(3).permutation(256).astype(np.uint8),
    }
    for name, shape in weights.items():
        numbers[name] = (
            np.random.default_rng(list(name.encode())).integers(-60, 61, shape).astype(np.int8)
        )
    return graph(
        nodes,
        *(numpy_helper.from_array(np.asarray(value), name) for name, value in numbers.items()),
    )


def int8_unet() -> onnx.ModelProto:
    """In whole numbers, with the activations that an INT8 file may have, on a lattice of 4."""
    nodes = [
        helper.make_node("QuantizeLinear", ["image", "coarse", "zero"], ["q"]),
        int8_conv("q", "first", "a"),
        helper.make_node(
            "QLinearLeakyRelu", ["a", *UNIT, *UNIT], ["leaky"], domain=MICROSOFT, alpha=0.1
        ),
        int8_conv("leaky", "down", "half", 2),
        helper.make_node("Cast", ["half"], ["places"], to=TensorProto.INT32),
        helper.make_node("Gather", ["table", "places"], ["bent"]),
        helper.make_node(
            "QLinearAveragePool",
            ["bent", *UNIT, *UNIT],
            ["mean"],
            domain=MICROSOFT,
            kernel_shape=[2, 2],
            strides=[2, 2],
        ),
        helper.make_node(
            "Resize", ["mean", "", "four"], ["wide"], coordinate_transformation_mode="asymmetric"
        ),
        helper.make_node(
            "QLinearMul", ["wide", *UNIT, "leaky", *UNIT, *UNIT], ["gated"], domain=MICROSOFT
        ),
        helper.make_node(
            "QLinearConcat", [*UNIT, "gated", *UNIT, "q", *UNIT], ["both"], domain=MICROSOFT, axis=1
        ),
        int8_conv("both", "last", "end"),
        helper.make_node("DequantizeLinear", ["end", *UNIT], ["restored"]),
    ]
    return int8_graph(nodes, 0.5, first=(2, 1, 3, 3), down=(2, 2, 3, 3), last=(1, 3, 3, 3))


def espcn() -> onnx.ModelProto:
    """Twice the size by a pixel shuffle."""
    row = Row().add("Conv", constant("in", 8, 1, 5, 5), pads=[2] * 4).add("Relu")
    return (
        row.add("Conv", constant("out", 4, 8, 3, 3), pads=[1] * 4)
        .add("DepthToSpace", blocksize=2, mode="CRD")
        .model()
    )


def four_bands(bands_out: int = 4) -> onnx.ModelProto:
    """Bands that are restored together, or made into others."""
    row = Row().add("Conv", constant("in", 8, 4, 3, 3), pads=[1] * 4).add("Relu")
    return row.add("Conv", constant("out", bands_out, 8, 3, 3), pads=[1] * 4).model((4, bands_out))


def ffdnet() -> onnx.ModelProto:
    """Half the size inside, by a pixel unshuffle in front and a shuffle behind."""
    row = (
        Row().add("SpaceToDepth", blocksize=2).add("Conv", constant("in", 8, 4, 3, 3), pads=[1] * 4)
    )
    row.add("Clip", real(0), real(6)).add(
        "Conv", constant("out", 4, 8, 3, 3), pads=[2] * 4, dilations=[2, 2]
    )
    return row.add("DepthToSpace", blocksize=2).model()


def plain_int8_unet() -> onnx.ModelProto:
    """In whole numbers and operators of ONNX itself, on a lattice of 8."""

    def conv(source: str, weight: str, result: str, stride: int = 1) -> list[onnx.NodeProto]:
        relu = helper.make_node("Max", [f"{result}.sum", "zero"], [result])
        return [int8_conv(source, weight, f"{result}.sum", stride), relu]

    nodes = [
        helper.make_node("QuantizeLinear", ["image", *UNIT], ["q"]),
        *conv("q", "first", "a"),
        helper.make_node("MaxPool", ["a"], ["half"], kernel_shape=[2, 2], strides=[2, 2]),
        *conv("half", "second", "b", 2),
        *conv("b", "third", "c", 2),
        helper.make_node("DepthToSpace", ["c"], ["larger"], blocksize=2),
        helper.make_node(
            "Resize",
            ["larger", "", "four"],
            ["wide"],
            coordinate_transformation_mode="asymmetric",
            nearest_mode="floor",
        ),
        helper.make_node("Concat", ["wide", "a"], ["both"], axis=1),
        *conv("both", "last", "end"),
        helper.make_node("DequantizeLinear", ["end", *UNIT], ["restored"]),
    ]
    weights = {
        "first": (2, 1, 3, 3),
        "second": (4, 2, 3, 3),
        "third": (8, 4, 3, 3),
        "last": (1, 4, 3, 3),
    }
    return int8_graph(nodes, 2**-7, **weights)


def half_resolution() -> onnx.ModelProto:
    """A ConvBEERS of one block at scale 2, of weights that are large enough to show a seam."""
    network = ConvBEERS(Variant(blocks=1, features=8, scale=2))
    initialise(network, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for value in network.parameters():
            value.mul_(2.0)
    return to_onnx(network.eval(), {})


@cache
def quantized_half_resolution() -> Quantized:
    """The same in legal INT8, for the host and for the board."""
    return quickly(
        half_resolution(),
        patches_of(list(np.random.default_rng(5).random((2, 1, 1, 48, 48), np.float32))),
    )


def int8_half_resolution() -> onnx.ModelProto:
    """The host's file of it."""
    return quantized_half_resolution().host


def spans(size_px: int, kept_px: int, halo_px: int) -> list[tuple[int, int, int, int]]:
    """Start and stop of each window and of what is kept of it, `kept_px` at a time."""
    marks = range(0, size_px, kept_px)
    return [
        (max(k - halo_px, 0), min(k + kept_px + halo_px, size_px), k, min(k + kept_px, size_px))
        for k in marks
    ]


def check_tiles(
    model: onnx.ModelProto, image: np.ndarray, all_cells: tuple[int, ...], short_px: int = 0
) -> None:
    """Tiles of so many lattice cells give the whole image (1, C, H, W) bit for bit; the halo may be
    too short.
    """
    tiling = tiling_of(model)
    session = open_session(any_size(model), 1)
    more = [(0, -n % tiling.alignment_px) for n in image.shape[2:]]
    image = np.pad(image, ((0, 0), (0, 0), *more), mode="edge")
    expected = result_of(session, image)
    assert expected.shape == (
        1,
        tiling.channels_out,
        *(int(n * tiling.scale) for n in image.shape[2:]),
    )
    for cells in all_cells:
        kept_px = cells * tiling.alignment_px
        rows = []
        sides = [spans(size, kept_px, tiling.halo_px - short_px) for size in image.shape[2:]]
        for top, bottom, low, high in sides[0]:
            row = []
            for left, right, west, east in sides[1]:
                tile = result_of(session, np.ascontiguousarray(image[:, :, top:bottom, left:right]))
                ends = [
                    int(n * tiling.scale) for n in (low - top, high - top, west - left, east - left)
                ]
                row.append(tile[:, :, ends[0] : ends[1], ends[2] : ends[3]])
            rows.append(np.concatenate(row, axis=3))
        np.testing.assert_array_equal(np.concatenate(rows, axis=2), expected)
