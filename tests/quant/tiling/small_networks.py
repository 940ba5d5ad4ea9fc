"""Small networks as users bring them: strides, pools, transposed convolutions, shuffles,
enlargements, joins.
"""

import math
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import onnx
import torch
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.variants import Variant
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
MICROSOFT = "com.microsoft"


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


class Builder(Row):
    """A random network; every tensor has `at` pixels for one of the image."""

    def __init__(self, draw: Any) -> None:
        super().__init__()
        self.draw = draw
        self.channels = 1
        self.at = Fraction(1)
        self.skips: dict[Fraction, tuple[str, int]] = {}

    def number(self, least: int, most: int) -> int:
        return int(self.draw(st.integers(least, most)))

    def pads(self, total: int) -> list[int]:
        before = [self.number(0, total) for _ in range(2)]
        return [*before, *(total - pad for pad in before)]

    def convolve(self, kernel: int, channels: int = 2, **window: Any) -> None:
        self.add(
            "Conv", taps(f"{len(self.nodes)}", channels, self.channels, kernel, kernel), **window
        )
        self.channels = channels

    def conv(self, stride: int = 1) -> None:
        kernel = self.number(1, 4)
        dilation = self.number(1, 2)
        extent = (kernel - 1) * dilation + 1
        pads = self.pads(self.number(max(extent - stride, 0), extent - 1))
        self.convolve(kernel, strides=[stride] * 2, dilations=[dilation] * 2, pads=pads)
        self.at /= stride

    def strided(self) -> None:
        self.conv(self.number(2, 3))

    def pool(self) -> None:
        extent = self.number(2, 4)
        kind = self.draw(st.sampled_from(["MaxPool", "AveragePool"]))
        counted = {"count_include_pad": 1} if kind == "AveragePool" else {}
        self.add(
            kind, kernel_shape=[extent] * 2, strides=[2, 2], pads=self.pads(extent - 2), **counted
        )
        self.at /= 2

    def padded(self) -> None:
        """By itself, then used up by a window; or moved, cut off on the one side that was not
        padded.
        """
        mode = self.draw(st.sampled_from(["constant", "edge", "reflect"]))
        before, behind = self.pads(2)[::2]
        self.add("Pad", whole("pads", 0, 0, before, before, 0, 0, behind, behind), mode=mode)
        if before == behind or self.draw(st.booleans()):
            self.convolve(3)
        else:
            self.add(
                "Slice",
                whole("from", behind, behind),
                whole("to", *[-before or 1 << 62] * 2),
                whole("axes", 2, 3),
            )

    def transposed(self) -> None:
        kernel = self.number(1, 4)
        window = {"pads": self.pads(max(kernel - 2, 0)), "output_padding": [max(2 - kernel, 0)] * 2}
        weight = taps(f"{len(self.nodes)}", self.channels, 2, kernel, kernel)
        self.add("ConvTranspose", weight, strides=[2, 2], **window)
        self.channels = 2
        self.at *= 2

    def shuffle(self) -> None:
        self.convolve(1, 4)
        self.add("DepthToSpace", blocksize=2, mode="CRD")
        self.channels = 1
        self.at *= 2

    def unshuffle(self) -> None:
        self.add("SpaceToDepth", blocksize=2)
        self.channels *= 4
        self.at /= 2

    def resize(self) -> None:
        mode = self.draw(st.sampled_from(["nearest", "linear"]))
        where = self.draw(st.sampled_from(["asymmetric", "half_pixel", "pytorch_half_pixel"]))
        self.add("Resize", "", real(1, 1, 2, 2), mode=mode, coordinate_transformation_mode=where)
        self.at *= 2

    def join(self) -> None:
        """Beside an earlier tensor of the same size, where there is one."""
        if self.at in self.skips:
            name, channels = self.skips[self.at]
            self.add("Concat", name, axis=1)
            self.channels += channels
        self.skips[self.at] = self.tensor, self.channels

    def small(self) -> None:
        """Back to small whole numbers: their sums are exact in any order, which a runtime chooses
        by the size.
        """
        self.add("Mul", real(0.125)).add("Floor").add("Clip", real(-255), real(255))


@st.composite
def networks(draw: Any) -> onnx.ModelProto:
    """Small networks of everything that can be tiled, of whole numbers."""
    builder = Builder(draw)
    parts = (
        Builder.conv,
        Builder.strided,
        Builder.pool,
        Builder.padded,
        Builder.transposed,
        Builder.shuffle,
        Builder.unshuffle,
        Builder.resize,
        Builder.join,
    )
    for part in draw(st.lists(st.sampled_from(parts), min_size=2, max_size=7)):
        grows = part in (Builder.transposed, Builder.shuffle, Builder.resize)
        if builder.channels <= 16 and not (grows and builder.at >= 2):
            part(builder)
            builder.small()
    return builder.add("Identity").model((1, builder.channels))


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
    more = [(0, -n % tiling.lattice_px) for n in image.shape[2:]]
    image = np.pad(image, ((0, 0), (0, 0), *more), mode="edge")
    expected = result_of(session, image)
    assert expected.shape == (
        1,
        tiling.channels_out,
        *(int(n * tiling.scale) for n in image.shape[2:]),
    )
    for cells in all_cells:
        kept_px = cells * tiling.lattice_px
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
