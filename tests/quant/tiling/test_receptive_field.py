"""Tests that tiles give the whole image's result, or that tiling is refused in a sentence."""

from fractions import Fraction

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from tests.quant.simplify.networks import parsed
from tests.quant.tiling.random_networks import networks
from tests.quant.tiling.small_networks import (
    check_tiles,
    float_unet,
    int8_unet,
    taps,
)

FAR = 1 << 62
SHAPES = {"w2": (2, 2), "w3": (3, 3), "w4": (4, 4), "w7": (7, 7), "w53": (5, 3)}
CONSTANTS = {
    **{name: taps(name, 1, 1, *shape) for name, shape in SHAPES.items()},
    "gain": [[[3.0]]],
    "map": np.arange(1600.0).reshape(1, 1, 40, 40),
    "ramp": np.arange(40.0),
    "around": [0, 0, 3, 3, 0, 0, 3, 3],
    "before": [0, 0, 1, 1, 0, 0, 0, 0],
    "behind": [0, 0, 0, 0, 0, 0, 1, 1],
    "axes": [2, 3],
    "zeros": [0, 0],
    "ones": [1, 1],
    "ones_back": [-1, -1],
    "two_one": [1, 0],
    "twos": [2, 2],
    "far": [FAR, FAR],
    "forties": [40, 40],
    "sizes": [1, 1, 40, 40],
    "half": [1.0, 1.0, 0.5, 0.5],
    "more": [1.0, 1.0, 1.5, 1.5],
    "double": [1.0, 1.0, 2.0, 2.0],
    "triple": [1.0, 1.0, 3.0, 3.0],
    "scale": [0.5],
    "bias": [0.5],
}


def model_of(nodes: str, bands: tuple[int, int] = (1, 1)) -> onnx.ModelProto:
    """Return a network from `image` to `restored`."""
    ends = f"float[N,{bands[0]},H,W] image => float[N,{bands[1]},P,Q] restored"
    return parsed(nodes, ends, constants=CONSTANTS)


HALF_PIXEL = 'coordinate_transformation_mode="half_pixel"'
CORNER = 'coordinate_transformation_mode="asymmetric"'
EXACT = {
    "restored = Conv<pads=[1,1,1,1]>(image, w3)": Tiling(1),
    "restored = Conv<pads=[2,1,2,1]>(image, w53)": Tiling(2),
    "restored = Conv<pads=[4,4,4,4], dilations=[4,4]>(image, w3)": Tiling(4),
    "restored = Conv<pads=[2,0,0,2]>(image, w3)": Tiling(2),
    'restored = Conv<auto_pad="SAME_UPPER">(image, w4)': Tiling(2),
    'restored = Conv<auto_pad="SAME_LOWER", strides=[3,3]>(image, w4)': Tiling(
        3, 3, Fraction(1, 3)
    ),
    "restored = MaxPool<kernel_shape=[5,5], pads=[2,2,2,2]>(image)": Tiling(2),
    "restored = AveragePool<kernel_shape=[3,3], pads=[1,1,1,1]>(image)": Tiling(1),
    "restored = Mul(image, gain)": Tiling(0),
    "restored = ReduceMean<axes=[-3]>(image)": Tiling(0),
    'p = Pad<mode="edge">(image, around) restored = Conv(p, w7)': Tiling(3),
    # Mirrored padding needs as many pixels as it mirrors.
    """c = Conv<pads=[0,0,2,2]>(image, w3)
    p = Pad<mode="reflect">(c, before)
    restored = Slice(p, zeros, ones_back, axes)""": Tiling(3, min_side_px=2),
    """c = Conv<pads=[2,2,0,0]>(image, w3)
    p = Pad<mode="edge">(c, behind)
    restored = Slice(p, ones, far, axes)""": Tiling(2),
    "restored = MaxPool<kernel_shape=[2,2], strides=[2,2]>(image)": Tiling(0, 2, Fraction(1, 2)),
    "restored = Conv<pads=[1,1,1,1], strides=[2,2]>(image, w3)": Tiling(2, 2, Fraction(1, 2)),
    "restored = MaxPool<kernel_shape=[3,3], strides=[3,3], ceil_mode=1>(image)": Tiling(
        0, 3, Fraction(1, 3)
    ),
    "restored = ConvTranspose<strides=[2,2], pads=[1,1,1,1]>(image, w4)": Tiling(1, 1, Fraction(2)),
    "restored = ConvTranspose<strides=[3,3], output_padding=[1,1]>(image, w2)": Tiling(
        0, 1, Fraction(3)
    ),
    f'restored = Resize<{CORNER}, nearest_mode="floor">(image, , triple)': Tiling(
        0, 1, Fraction(3)
    ),
    f"restored = Resize<{HALF_PIXEL}>(image, , double)": Tiling(0, 1, Fraction(2)),
    f'restored = Resize<mode="linear", {HALF_PIXEL}>(image, , double)': Tiling(1, 1, Fraction(2)),
    f'restored = Resize<mode="cubic", {HALF_PIXEL}>(image, , double)': Tiling(2, 1, Fraction(2)),
    f'restored = Resize<mode="linear", {HALF_PIXEL}>(image, , half)': Tiling(0, 2, Fraction(1, 2)),
    """c = ConvTranspose<strides=[2,2], dilations=[3,3], pads=[1,1,1,1]>(image, w2)
    restored = MaxPool<kernel_shape=[2,2], pads=[0,0,1,1]>(c)""": Tiling(1, 1, Fraction(2)),
    "restored = Slice(image, two_one, far, axes, twos)": Tiling(0, 2, Fraction(1, 2)),
}
OTHERS = {
    "float U-Net": (float_unet(), Tiling(6, 2)),
    "INT8 U-Net": (int8_unet(), Tiling(8, 4)),
    "shuffle": (
        model_of("restored = DepthToSpace<blocksize=2>(image)", (4, 1)),
        Tiling(0, 1, Fraction(2), 4, 1),
    ),
    "unshuffle": (
        model_of("restored = SpaceToDepth<blocksize=2>(image)", (1, 4)),
        Tiling(0, 2, Fraction(1, 2), 1, 4),
    ),
}


@pytest.mark.parametrize("nodes", EXACT)
def test_tiles_give_the_whole_and_a_shorter_halo_does_not(nodes: str) -> None:
    check_halo(model_of(nodes), EXACT[nodes], (1, 3))


@pytest.mark.parametrize("name", OTHERS)
def test_tiles_of_larger_networks_and_shuffles_give_the_whole(name: str) -> None:
    check_halo(*OTHERS[name], (2, 5))


def check_halo(model: onnx.ModelProto, tiling: Tiling, cells: tuple[int, ...]) -> None:
    """Check the tiling of a network, and that a shorter halo gives another result."""
    assert tiling_of(model) == tiling
    check_any(model, (25, 38), cells)
    if tiling.halo_px:
        with pytest.raises(AssertionError, match="Mismatched"):
            check_any(model, (25, 38), cells, short_px=tiling.alignment_px)


HALVES = "strides=[64,64], kernel_shape=[2,2]"
REFUSED = {
    "but GlobalAveragePool head/pool reads the whole image": (
        '["head/pool"] restored = GlobalAveragePool(image)'
    ),
    "InstanceNormalization restored reads the whole image": (
        "restored = InstanceNormalization(image, scale, bias)"
    ),
    "ReduceMean restored reads the whole image": "restored = ReduceMean<axes=[2,3]>(image)",
    "DynamicQuantizeLinear q reads the whole image": (
        "q, s, z = DynamicQuantizeLinear(image) restored = DequantizeLinear(q, s, z)"
    ),
    "Flatten restored is fully connected": "restored = Flatten(image)",
    "Softmax restored does not work along the channels": "restored = Softmax<axis=3>(image)",
    "Concat restored does not work along the channels": "restored = Concat<axis=2>(image, image)",
    "Concat restored combines tensors of different sizes": (
        "p = MaxPool<kernel_shape=[2,2], strides=[2,2]>(image) restored = Concat<axis=1>(p, image)"
    ),
    "Resize restored resizes by 1 x 1 x 1.5 x 1.5": f"restored = Resize<{CORNER}>(image, , more)",
    "Resize restored resizes by 3 with weights whose rounding depends on the position": (
        f'restored = Resize<mode="linear", {HALF_PIXEL}>(image, , triple)'
    ),
    "Resize restored uses the coordinates align_corners, which depend on the size": (
        'restored = Resize<mode="linear", coordinate_transformation_mode="align_corners">'
        "(image, , double)"
    ),
    "Resize restored resizes to a fixed size": "restored = Resize(image, , , sizes)",
    "Slice restored cuts at a fixed position": "restored = Slice(image, zeros, forties, axes)",
    "Add restored has a constant that differs from pixel to pixel": "restored = Add(image, map)",
    "Mul restored has a constant that differs": "restored = Mul(image, ramp)",
    "MaxPool max returns positions as well": (
        "max, at = MaxPool<kernel_shape=[3,3], pads=[1,1,1,1]>(image) restored = Cast<to=1>(at)"
    ),
    "MaxPool restored has no positive stride": (
        "restored = MaxPool<kernel_shape=[2,2], strides=[-2,-2]>(image)"
    ),
    "but it has -2 pixels a side": "restored = Conv(image, w3)",
    "scale rows and columns by one factor, but the factors are 1/2 and 1": (
        "restored = MaxPool<kernel_shape=[2,1], strides=[2,1]>(image)"
    ),
    "its period is 4096 pixels": f"p = MaxPool<{HALVES}>(image) restored = MaxPool<{HALVES}>(p)",
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_operators_that_read_positions_or_the_whole_image_are_refused(sentence: str) -> None:
    with pytest.raises(ModelError, match=sentence):
        tiling_of(model_of(REFUSED[sentence]))


def test_weights_of_a_constant_node_are_read() -> None:
    weight = "w = Constant<value = float[1,1,3,1] {1, 1, 1}>()"
    assert tiling_of(model_of(f"{weight} restored = Conv<pads=[1,0,1,0]>(image, w)")).halo_px == 1


def check_any(
    model: onnx.ModelProto,
    size: tuple[int, int],
    cells: tuple[int, ...] = (1, 3),
    short_px: int = 0,
) -> None:
    """Check the tiles of an image of random digital numbers; the halo may be too short."""
    image = (
        np.random.default_rng(1)
        .integers(0, 4096, (1, tiling_of(model).channels_in, *size))
        .astype(np.float32)
    )
    check_tiles(model, image, cells, short_px)


@settings(max_examples=40)
@given(networks(), st.integers(9, 40), st.integers(9, 40))
def test_tiles_of_random_networks_give_the_whole(
    model: onnx.ModelProto, height: int, width: int
) -> None:
    alignment_px = tiling_of(model).alignment_px
    check_any(model, (height + 2 * alignment_px, width + alignment_px))
