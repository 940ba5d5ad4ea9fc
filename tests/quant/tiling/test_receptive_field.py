"""How an image may be tiled: the whole image's result wherever it is allowed, one sentence
elsewhere.
"""

from fractions import Fraction
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from tests.quant.tiling.random_networks import networks
from tests.quant.tiling.small_networks import (
    Row,
    check_tiles,
    constant,
    float_unet,
    graph,
    int8_unet,
    real,
    taps,
    whole,
)


def one(kind: str, *others: onnx.TensorProto | str, **attributes: Any) -> onnx.ModelProto:
    return Row().add(kind, *others, **attributes).model()


def conv(rows: int = 3, columns: int = 3, **attributes: Any) -> onnx.ModelProto:
    return one("Conv", taps("w", 1, 1, rows, columns), **attributes)


def transposed(side: int, stride: int, **attributes: Any) -> onnx.ModelProto:
    return one("ConvTranspose", taps("w", 1, 1, side, side), strides=[stride] * 2, **attributes)


def resized(mode: str, where: str, factor: float, **attributes: Any) -> onnx.ModelProto:
    scales = real(1, 1, factor, factor)
    return one("Resize", "", scales, mode=mode, coordinate_transformation_mode=where, **attributes)


def looking(pads: list[int]) -> Row:
    """A window that looks further to one side."""
    return Row().add("Conv", taps("w", 1, 1, 3, 3), pads=pads)


def pad(before: int, behind: int) -> onnx.TensorProto:
    return whole("pads", 0, 0, before, before, 0, 0, behind, behind)


def cut(begin: tuple[int, int], end: int, step: int = 1) -> list[onnx.TensorProto]:
    return [
        whole("from", *begin),
        whole("to", end, end),
        whole("axes", 2, 3),
        whole("steps", step, step),
    ]


FAR = 1 << 62
EXACT = {
    "3 x 3": (conv(pads=[1] * 4), Tiling(1)),
    "5 x 3": (conv(5, 3, pads=[2, 1, 2, 1]), Tiling(2)),
    "dilated": (conv(pads=[4] * 4, dilations=[4, 4]), Tiling(4)),
    "one-sided": (conv(pads=[2, 0, 0, 2]), Tiling(2)),
    "same": (conv(4, 4, auto_pad="SAME_UPPER"), Tiling(2)),
    "same, strided": (
        conv(4, 4, auto_pad="SAME_LOWER", strides=[3, 3]),
        Tiling(3, 3, Fraction(1, 3)),
    ),
    "pool": (one("MaxPool", kernel_shape=[5, 5], pads=[2] * 4), Tiling(2)),
    "mean": (one("AveragePool", kernel_shape=[3, 3], pads=[1] * 4), Tiling(1)),
    "gain": (one("Mul", taps("gain", 1, 1, 1)), Tiling(0)),
    "padded before": (
        Row().add("Pad", pad(3, 3), mode="edge").add("Conv", taps("w", 1, 1, 7, 7)).model(),
        Tiling(3),
    ),
    "looks ahead, mirrored and moved": (
        looking([0, 0, 2, 2])
        .add("Pad", pad(1, 0), mode="reflect")
        .add("Slice", *cut((0, 0), -1))
        .model(),
        # Mirrored padding needs as many pixels as it mirrors.
        Tiling(3, min_side_px=2),
    ),
    "looks back, copied and moved": (
        looking([2, 2, 0, 0])
        .add("Pad", pad(0, 1), mode="edge")
        .add("Slice", *cut((1, 1), FAR))
        .model(),
        Tiling(2),
    ),
    "strided pool": (
        one("MaxPool", kernel_shape=[2, 2], strides=[2, 2]),
        Tiling(0, 2, Fraction(1, 2)),
    ),
    "strided": (conv(pads=[1] * 4, strides=[2, 2]), Tiling(2, 2, Fraction(1, 2))),
    "odd pool": (
        one("MaxPool", kernel_shape=[3, 3], strides=[3, 3], ceil_mode=1),
        Tiling(0, 3, Fraction(1, 3)),
    ),
    "transposed": (transposed(4, 2, pads=[1] * 4), Tiling(1, 1, Fraction(2))),
    "transposed with gaps": (transposed(2, 3, output_padding=[1, 1]), Tiling(0, 1, Fraction(3))),
    "shuffle": (
        Row().add("DepthToSpace", blocksize=2).model((4, 1)),
        Tiling(0, 1, Fraction(2), 4, 1),
    ),
    "unshuffle": (
        Row().add("SpaceToDepth", blocksize=2).model((1, 4)),
        Tiling(0, 2, Fraction(1, 2), 1, 4),
    ),
    "nearest": (
        resized("nearest", "asymmetric", 3, nearest_mode="floor"),
        Tiling(0, 1, Fraction(3)),
    ),
    "nearest, half": (resized("nearest", "half_pixel", 2), Tiling(0, 1, Fraction(2))),
    "linear": (resized("linear", "half_pixel", 2), Tiling(1, 1, Fraction(2))),
    "linear down": (resized("linear", "half_pixel", 0.5), Tiling(0, 2, Fraction(1, 2))),
    "transposed with a dilation, then windows": (
        Row()
        .add(
            "ConvTranspose", taps("far", 1, 1, 2, 2), strides=[2, 2], dilations=[3, 3], pads=[1] * 4
        )
        .add("MaxPool", kernel_shape=[2, 2], pads=[0, 0, 1, 1])
        .model(),
        Tiling(1, 1, Fraction(2)),
    ),
    "every second": (one("Slice", *cut((1, 0), FAR, 2)), Tiling(0, 2, Fraction(1, 2))),
    "float U-Net": (float_unet(), Tiling(6, 2)),
    "INT8 U-Net": (int8_unet(), Tiling(8, 4)),
}


@pytest.mark.parametrize("name", EXACT)
def test_tiled_is_whole_and_no_smaller_halo_does(name: str) -> None:
    model, tiling = EXACT[name]
    assert tiling_of(model) == tiling
    cells = (2, 5) if "U-Net" in name else (1, 3)
    check_any(model, (25, 38), cells)
    if tiling.halo_px:
        with pytest.raises(AssertionError, match="Mismatched"):
            check_any(model, (25, 38), cells, short_px=tiling.alignment_px)


HEAD = helper.make_node("GlobalAveragePool", ["image"], ["restored"], name="head/pool")
ELSEWHERE = {
    "but GlobalAveragePool head/pool reads the whole image": graph([HEAD]),
    "InstanceNormalization restored reads the whole image": one(
        "InstanceNormalization", constant("scale", 1), constant("bias", 1)
    ),
    "ReduceMean restored reads the whole image": one("ReduceMean", axes=[2, 3]),
    "DynamicQuantizeLinear q reads the whole image": graph(
        [
            helper.make_node("DynamicQuantizeLinear", ["image"], ["q", "s", "z"]),
            helper.make_node("DequantizeLinear", ["q", "s", "z"], ["restored"]),
        ]
    ),
    "Flatten restored is fully connected": one("Flatten"),
    "Softmax restored does not work along the channels": one("Softmax", axis=3),
    "Concat restored does not work along the channels": one("Concat", "image", axis=2),
    "Concat restored combines tensors of different sizes": Row()
    .add("MaxPool", kernel_shape=[2, 2], strides=[2, 2])
    .add("Concat", "image", axis=1)
    .model((1, 2)),
    "Resize restored resizes by 1 x 1 x 1.5 x 1.5": resized("nearest", "asymmetric", 1.5),
    "Resize restored resizes by 3 with weights whose rounding depends on the position": resized(
        "linear", "half_pixel", 3
    ),
    "Resize restored uses the coordinates align_corners, which depend on the size": resized(
        "linear", "align_corners", 2
    ),
    "Resize restored resizes to a fixed size": one("Resize", "", "", whole("sizes", 1, 1, 40, 40)),
    "Slice restored cuts at a fixed position": one("Slice", *cut((0, 0), 40)),
    "Add restored has a constant that differs from pixel to pixel": one(
        "Add", constant("map", 1, 1, 40, 40)
    ),
    "Mul restored has a constant that differs": one("Mul", constant("ramp", 40)),
    "MaxPool max returns positions as well": graph(
        [
            helper.make_node(
                "MaxPool", ["image"], ["max", "places"], kernel_shape=[3, 3], pads=[1] * 4
            ),
            helper.make_node("Cast", ["places"], ["restored"], to=TensorProto.FLOAT),
        ]
    ),
    "MaxPool restored has no positive stride": one(
        "MaxPool", kernel_shape=[2, 2], strides=[-2, -2]
    ),
    "but it has -2 pixels a side": conv(),
    "scale rows and columns by one factor, but the factors are 1/2 and 1": one(
        "MaxPool", kernel_shape=[2, 1], strides=[2, 1]
    ),
    "its period is 4096 pixels": Row()
    .add("MaxPool", kernel_shape=[2, 2], strides=[64, 64])
    .add("MaxPool", kernel_shape=[2, 2], strides=[64, 64])
    .model(),
}


@pytest.mark.parametrize("sentence", ELSEWHERE)
def test_what_depends_on_the_place_or_the_whole_image_is_refused(sentence: str) -> None:
    with pytest.raises(ModelError, match=sentence):
        tiling_of(ELSEWHERE[sentence])


def test_constants_in_the_graph_are_followed() -> None:
    weight = helper.make_node("Constant", [], ["w"], value=constant("w", 1, 1, 7, 7))
    assert (
        tiling_of(
            graph([weight, helper.make_node("Conv", ["image", "w"], ["restored"], pads=[3] * 4)])
        ).halo_px
        == 3
    )


def check_any(
    model: onnx.ModelProto,
    size: tuple[int, int],
    cells: tuple[int, ...] = (1, 3),
    short_px: int = 0,
) -> None:
    """Of digital numbers at random; the halo may be too short."""
    image = (
        np.random.default_rng(1)
        .integers(0, 4096, (1, tiling_of(model).channels_in, *size))
        .astype(np.float32)
    )
    check_tiles(model, image, cells, short_px)


@settings(max_examples=40)
@given(networks(), st.integers(9, 40), st.integers(9, 40))
def test_random_networks_are_tiled_as_a_whole(
    model: onnx.ModelProto, height: int, width: int
) -> None:
    alignment_px = tiling_of(model).alignment_px
    check_any(model, (height + 2 * alignment_px, width + alignment_px))
