"""Small networks with strides, pools, transposed convolutions, shuffles, resizes and concats."""

import json
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import ArrayLike

from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.convbeers import ConvBEERS, initialise
from beers_deploy.model.variants import Variant
from beers_deploy.quant.onnx.image_input import any_size
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.session import open_session, result_of
from beers_deploy.quant.tiling.receptive_field import tiling_of
from tests.quant.quick import patches_of, quickly, uniform
from tests.quant.simplify.networks import parsed


def weights(**shapes: tuple[int, ...]) -> dict[str, ArrayLike]:
    """Return random weights with which values keep their size from layer to layer."""
    return {
        name: np.random.default_rng(list(name.encode())).normal(size=shape)
        / math.sqrt(math.prod(shape[1:]))
        for name, shape in shapes.items()
    }


def network(
    nodes: str, constants: Mapping[str, ArrayLike], bands: tuple[int, int] = (1, 1)
) -> onnx.ModelProto:
    """Return a network from `image` to `restored`, from ONNX's text format."""
    ends = f"float[N,{bands[0]},H,W] image => float[N,{bands[1]},P,Q] restored"
    model = parsed(nodes, ends, constants=constants)
    onnx.checker.check_model(model)
    return model


def taps(name: str, *shape: int) -> np.ndarray:
    """Return weights of small integers, whose sums are exact in float32 in any order."""
    values = np.random.default_rng(list(name.encode())).choice([-2, -1, 1, 2, 3], shape)
    return values.astype(np.float32)


class Row:
    """A network that is written operator by operator; each one reads the result of the last."""

    def __init__(self) -> None:
        self.nodes: list[str] = []
        self.constants: dict[str, ArrayLike] = {}
        self.tensor = "image"

    def add(self, kind: str, *others: ArrayLike | str, **attributes: Any) -> "Row":
        """Append an operator that reads the last result and `others`: constants or tensor names."""
        feeds = [self.tensor]
        self.tensor = f"t{len(self.nodes)}"
        for other in others:
            if isinstance(other, str):
                feeds.append(other)
            else:
                feeds.append(f"{self.tensor}_{len(feeds)}")
                self.constants[feeds[-1]] = other
        words = ", ".join(f"{key}={json.dumps(value)}" for key, value in attributes.items())
        operator = f"{kind}<{words}>" if words else kind
        self.nodes.append(f"{self.tensor} = {operator}({', '.join(feeds)})")
        return self

    def model(self, bands: tuple[int, int] = (1, 1)) -> onnx.ModelProto:
        nodes = " ".join([*self.nodes, f"restored = Identity({self.tensor})"])
        return network(nodes, self.constants, bands)


SAME = "Conv<pads=[1,1,1,1]>"


def float_unet() -> onnx.ModelProto:
    """Build a float U-Net of one level, which concatenates its first convolution as a skip."""
    nodes = f"""
        a = {SAME}(image, first)
        half = MaxPool<kernel_shape=[2,2], strides=[2,2]>(a)
        b = {SAME}(half, middle)
        c = ConvTranspose<strides=[2,2]>(b, up)
        both = Concat<axis=1>(c, a)
        restored = {SAME}(both, last)
    """
    shapes = {"first": (2, 1, 3, 3), "middle": (2, 2, 3, 3), "up": (2, 2, 2, 2)}
    return network(nodes, weights(**shapes, last=(1, 4, 3, 3)))


CONV = "QLinearConv<pads=[1,1,1,1], strides=[{0},{0}]>({1}, unit, zero, {2}, fine, no, unit, zero)"
"""An integer convolution; the placeholders are its stride, its tensor and its weights."""
CORNER = 'coordinate_transformation_mode="asymmetric"'


def int8_network(nodes: str, unit: float, **shapes: tuple[int, ...]) -> onnx.ModelProto:
    """Return a network on uint8 integers of the scale `unit`."""
    numbers: dict[str, ArrayLike] = {
        "unit": unit,
        "coarse": 16.0,
        "fine": 2**-6,
        "zero": np.uint8(128),
        "no": np.int8(0),
        "four": [1.0, 1.0, 4.0, 4.0],
        "table": np.random.default_rng(3).permutation(256).astype(np.uint8),
    }
    for name, shape in shapes.items():
        generator = np.random.default_rng(list(name.encode()))
        numbers[name] = generator.integers(-60, 61, shape).astype(np.int8)
    return network(nodes, numbers)


def int8_unet() -> onnx.ModelProto:
    """Build an INT8 U-Net with the activations that an INT8 file may have, aligned to 4 pixels."""
    unit = "unit, zero"
    nodes = f"""
        q = QuantizeLinear(image, coarse, zero)
        a = {CONV.format(1, "q", "first")}
        leaky = com.microsoft.QLinearLeakyRelu<alpha=0.1>(a, {unit}, {unit})
        half = {CONV.format(2, "leaky", "down")}
        places = Cast<to=6>(half)
        bent = Gather(table, places)
        mean = com.microsoft.QLinearAveragePool<kernel_shape=[2,2], strides=[2,2]>(
            bent, {unit}, {unit}
        )
        wide = Resize<{CORNER}>(mean, , four)
        gated = com.microsoft.QLinearMul(wide, {unit}, leaky, {unit}, {unit})
        both = com.microsoft.QLinearConcat<axis=1>({unit}, gated, {unit}, q, {unit})
        end = {CONV.format(1, "both", "last")}
        restored = DequantizeLinear(end, {unit})
    """
    return int8_network(nodes, 0.5, first=(2, 1, 3, 3), down=(2, 2, 3, 3), last=(1, 3, 3, 3))


def espcn() -> onnx.ModelProto:
    """Build a network that doubles the size by a pixel shuffle."""
    nodes = f"""
        a = Conv<pads=[2,2,2,2]>(image, in)
        b = Relu(a)
        c = {SAME}(b, out)
        restored = DepthToSpace<blocksize=2, mode="CRD">(c)
    """
    return network(nodes, weights(**{"in": (8, 1, 5, 5), "out": (4, 8, 3, 3)}))


def four_bands(bands_out: int = 4) -> onnx.ModelProto:
    """Build a network that restores four bands jointly, or computes other bands from them."""
    nodes = f"a = {SAME}(image, in) b = Relu(a) restored = {SAME}(b, out)"
    shapes = {"in": (8, 4, 3, 3), "out": (bands_out, 8, 3, 3)}
    return network(nodes, weights(**shapes), (4, bands_out))


def ffdnet() -> onnx.ModelProto:
    """Build a network that works at half the size, between a pixel unshuffle and a shuffle."""
    nodes = f"""
        places = SpaceToDepth<blocksize=2>(image)
        a = {SAME}(places, in)
        b = Clip(a, low, high)
        c = Conv<pads=[2,2,2,2], dilations=[2,2]>(b, out)
        restored = DepthToSpace<blocksize=2>(c)
    """
    constants = weights(**{"in": (8, 4, 3, 3), "out": (4, 8, 3, 3)})
    return network(nodes, {**constants, "low": 0.0, "high": 6.0})


def plain_int8_unet() -> onnx.ModelProto:
    """Build an INT8 U-Net of ONNX's own operators, aligned to 8 pixels."""
    nodes = f"""
        q = QuantizeLinear(image, unit, zero)
        a_sum = {CONV.format(1, "q", "first")}
        a = Max(a_sum, zero)
        half = MaxPool<kernel_shape=[2,2], strides=[2,2]>(a)
        b_sum = {CONV.format(2, "half", "second")}
        b = Max(b_sum, zero)
        c_sum = {CONV.format(2, "b", "third")}
        c = Max(c_sum, zero)
        larger = DepthToSpace<blocksize=2>(c)
        wide = Resize<{CORNER}, nearest_mode="floor">(larger, , four)
        both = Concat<axis=1>(wide, a)
        end_sum = {CONV.format(1, "both", "last")}
        end = Max(end_sum, zero)
        restored = DequantizeLinear(end, unit, zero)
    """
    shapes = {"first": (2, 1, 3, 3), "second": (4, 2, 3, 3), "third": (8, 4, 3, 3)}
    return int8_network(nodes, 2**-7, **shapes, last=(1, 4, 3, 3))


def half_resolution() -> onnx.ModelProto:
    """Build a ConvBEERS of one block at scale 2, with weights large enough to show a seam."""
    network = ConvBEERS(Variant(blocks=1, features=8, scale=2))
    initialise(network, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for value in network.parameters():
            value.mul_(2.0)
    return to_onnx(network.eval(), {})


@cache
def quantized_half_resolution() -> Quantized:
    """Quantize `half_resolution` to legal INT8."""
    return quickly(
        half_resolution(),
        patches_of(list(uniform(2, 1, 1, 48, 48, seed=5))),
    )


def int8_half_resolution() -> onnx.ModelProto:
    """Return the host's INT8 file of `half_resolution`."""
    return quantized_half_resolution().host


def spans(size_px: int, kept_px: int, halo_px: int) -> list[tuple[int, int, int, int]]:
    """Return start and stop of each window and of its kept part, in steps of `kept_px`."""
    marks = range(0, size_px, kept_px)
    return [
        (max(k - halo_px, 0), min(k + kept_px + halo_px, size_px), k, min(k + kept_px, size_px))
        for k in marks
    ]


def check_tiles(
    model: onnx.ModelProto, image: np.ndarray, all_cells: tuple[int, ...], short_px: int = 0
) -> None:
    """Check that tiles give the result of the whole image (1, C, H, W), bit for bit.

    Each number in `all_cells` is the side of a tile in steps of the alignment. The halo is shorter
    by `short_px`.
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
