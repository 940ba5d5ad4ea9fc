"""How an image may be tiled: the whole image's result wherever it is allowed, one sentence elsewhere."""

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from profiles.errors import ModelError
from quant.tiling.walk import Tiling, receptive_radius_px, tiling_of
from tests.quant.tiling.small_networks import constant, float_unet, graph, int8_unet, networks, whole


def one(
    kind: str, *constants: onnx.TensorProto, bands: tuple[int, int] = (1, 1), **attributes: Any
) -> onnx.ModelProto:
    feeds = ["image", *(c.name for c in constants)]
    return graph([helper.make_node(kind, feeds, ["restored"], **attributes)], *constants, bands=bands)


def resized(mode: str, coordinates: str, factor: float, **attributes: Any) -> onnx.ModelProto:
    scales = numpy_helper.from_array(np.array([1, 1, factor, factor], np.float32), "scales")
    node = helper.make_node(
        "Resize",
        ["image", "", "scales"],
        ["restored"],
        mode=mode,
        coordinate_transformation_mode=coordinates,
        **attributes,
    )
    return graph([node], scales)


def session_of(model: onnx.ModelProto) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    return ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


LOCAL = {
    "3 x 3": (one("Conv", constant("w", 1, 1, 3, 3), pads=[1] * 4), 1),
    "5 x 3": (one("Conv", constant("w", 1, 1, 5, 3), pads=[2, 1, 2, 1]), 2),
    "dilated": (one("Conv", constant("w", 1, 1, 3, 3), pads=[4] * 4, dilations=[4, 4]), 4),
    "one-sided": (one("Conv", constant("w", 1, 1, 3, 3), pads=[2, 0, 0, 2]), 2),
    "same": (one("Conv", constant("w", 1, 1, 4, 4), auto_pad="SAME_UPPER"), 2),
    "pool": (one("MaxPool", kernel_shape=[5, 5], pads=[2] * 4), 2),
    "mean": (one("AveragePool", kernel_shape=[3, 3], pads=[1] * 4), 1),
    "gain": (one("Mul", constant("gain", 1, 1, 1)), 0),
    "padded before": (
        graph(
            [
                helper.make_node("Pad", ["image", "pads"], ["wide"], mode="reflect"),
                helper.make_node("Conv", ["wide", "w"], ["restored"]),
            ],
            whole("pads", 0, 0, 3, 3, 0, 0, 3, 3),
            constant("w", 1, 1, 7, 7),
        ),
        3,
    ),
}


@pytest.mark.parametrize("name", LOCAL)
def test_no_pixel_depends_on_one_beyond_the_radius(name: str) -> None:
    model, radius_px = LOCAL[name]
    assert tiling_of(model) == Tiling(radius_px, least_px=4 if "before" in name else 1)  # a mirror needs pixels
    image = np.zeros((2, 1, 21, 23), np.float32)
    image[1, 0, 10, 11] = 9
    still, moved = session_of(model).run(None, {"image": image})[0][:, 0]
    rows, columns = np.nonzero(still != moved)
    assert max(np.abs(rows - 10).max(), np.abs(columns - 11).max()) == radius_px


STRIDED = {
    "pool": (one("MaxPool", kernel_shape=[2, 2], strides=[2, 2]), Tiling(0, 2, Fraction(1, 2))),
    "conv": (
        one("Conv", constant("w", 1, 1, 3, 3), pads=[1] * 4, strides=[2, 2]),
        Tiling(2, 2, Fraction(1, 2)),
    ),
    "odd pool": (
        one("MaxPool", kernel_shape=[3, 3], strides=[3, 3], ceil_mode=1),
        Tiling(0, 3, Fraction(1, 3)),
    ),
    "transposed": (
        one("ConvTranspose", constant("w", 1, 1, 4, 4), strides=[2, 2], pads=[1] * 4),
        Tiling(1, 1, Fraction(2)),
    ),
    "transposed with gaps": (
        one("ConvTranspose", constant("w", 1, 1, 2, 2), strides=[3, 3], output_padding=[1, 1]),
        Tiling(0, 1, Fraction(3)),
    ),
    "shuffle": (one("DepthToSpace", blocksize=2, bands=(4, 1)), Tiling(0, 1, Fraction(2), 4, 1)),
    "unshuffle": (one("SpaceToDepth", blocksize=2, bands=(1, 4)), Tiling(0, 2, Fraction(1, 2), 1, 4)),
    "nearest": (resized("nearest", "asymmetric", 3, nearest_mode="floor"), Tiling(0, 1, Fraction(3))),
    "nearest, half": (resized("nearest", "half_pixel", 2), Tiling(0, 1, Fraction(2))),
    "linear": (resized("linear", "half_pixel", 2), Tiling(1, 1, Fraction(2))),
    "linear down": (resized("linear", "half_pixel", 0.5), Tiling(0, 2, Fraction(1, 2))),
    "transposed with a dilation, then windows": (
        graph(
            [
                helper.make_node(
                    "ConvTranspose", ["image", "far"], ["wide"], strides=[2, 2], dilations=[3, 3], pads=[1] * 4
                ),
                helper.make_node("MaxPool", ["wide"], ["restored"], kernel_shape=[2, 2], pads=[0, 0, 1, 1]),
            ],
            constant("far", 1, 1, 2, 2),
        ),
        Tiling(1, 1, Fraction(2)),
    ),
    "every second": (
        graph(
            [helper.make_node("Slice", ["image", "from", "to", "axes", "steps"], ["restored"])],
            whole("from", 1, 0),
            whole("to", 1 << 62, 1 << 62),
            whole("axes", 2, 3),
            whole("steps", 2, 2),
        ),
        Tiling(0, 2, Fraction(1, 2)),
    ),
}


@pytest.mark.parametrize("name", STRIDED)
def test_strides_and_enlargements_have_a_lattice_and_a_scale(name: str) -> None:
    model, tiling = STRIDED[name]
    assert tiling_of(model) == tiling
    check_tiles(model, (13, 22))


ELSEWHERE = {
    "GlobalAveragePool": one("GlobalAveragePool"),
    "InstanceNormalization": one("InstanceNormalization", constant("scale", 1), constant("bias", 1)),
    "Softmax": one("Softmax", axis=3),
    "ReduceMean": one("ReduceMean", axes=[2, 3]),
    "Flatten": one("Flatten"),
    "Resize by one and a half": resized("nearest", "asymmetric", 1.5),
    "Resize by three, linear": resized("linear", "half_pixel", 3),
    "Resize of coordinates that depend on the size": resized("linear", "align_corners", 2),
    "Resize to a fixed size": graph(
        [helper.make_node("Resize", ["image", "", "", "sizes"], ["restored"])], whole("sizes", 1, 1, 40, 40)
    ),
    "Slice at a fixed place": graph(
        [helper.make_node("Slice", ["image", "from", "to", "axes"], ["restored"])],
        whole("from", 0),
        whole("to", 40),
        whole("axes", 2),
    ),
    "DynamicQuantizeLinear": graph(
        [
            helper.make_node("DynamicQuantizeLinear", ["image"], ["q", "s", "z"]),
            helper.make_node("DequantizeLinear", ["q", "s", "z"], ["restored"]),
        ]
    ),
    "Add of a map": one("Add", constant("map", 1, 1, 40, 40)),
    "Mul along the rows": one("Mul", constant("ramp", 40)),
    "Concat of rows": graph([helper.make_node("Concat", ["image", "image"], ["restored"], axis=2)]),
    "Concat of unequal sizes": graph(
        [
            helper.make_node("MaxPool", ["image"], ["half"], kernel_shape=[2, 2], strides=[2, 2]),
            helper.make_node("Concat", ["image", "half"], ["restored"], axis=1),
        ],
        bands=(1, 2),
    ),
    "MaxPool's places": graph(
        [
            helper.make_node("MaxPool", ["image"], ["max", "places"], kernel_shape=[3, 3], pads=[1] * 4),
            helper.make_node("Cast", ["places"], ["restored"], to=TensorProto.FLOAT),
        ]
    ),
    "-2 pixels a side": one("Conv", constant("w", 1, 1, 3, 3)),
    "1/2 and 1": one("MaxPool", kernel_shape=[2, 1], strides=[2, 1]),
    "a period of": graph(
        [
            helper.make_node("MaxPool", ["image"], ["small"], kernel_shape=[2, 2], strides=[64, 64]),
            helper.make_node("MaxPool", ["small"], ["restored"], kernel_shape=[2, 2], strides=[64, 64]),
        ]
    ),
}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_what_depends_on_the_place_or_the_whole_image_is_refused(name: str) -> None:
    plain = name[0] in "-1a"
    with pytest.raises(ModelError, match=name if plain else name.split()[0].removesuffix("'s")):
        tiling_of(ELSEWHERE[name])


def test_a_refusal_names_the_node() -> None:
    node = helper.make_node("GlobalAveragePool", ["image"], ["restored"], name="head/pool")
    with pytest.raises(ModelError, match="got GlobalAveragePool head/pool, which looks at the whole image"):
        tiling_of(graph([node]))


def test_constants_in_the_graph_are_followed() -> None:
    weight = helper.make_node("Constant", [], ["w"], value=constant("w", 1, 1, 7, 7))
    conv = helper.make_node("Conv", ["image", "w"], ["restored"], pads=[3] * 4)
    assert receptive_radius_px(graph([weight, conv])) == 3


def spans(size_px: int, kept_px: int, halo_px: int) -> list[tuple[int, int, int, int]]:
    """Start and stop of each window and of what is kept of it, `kept_px` at a time."""
    marks = range(0, size_px, kept_px)
    return [(max(k - halo_px, 0), min(k + kept_px + halo_px, size_px), k, min(k + kept_px, size_px)) for k in marks]


def tiled(
    run: Callable[[np.ndarray], np.ndarray], image: np.ndarray, tiling: Tiling, cells: int, halo_px: int
) -> np.ndarray:
    """An image (1, C, H, W) whose sides are multiples of the lattice, restored in tiles of so many lattice cells."""
    sides = [spans(size, cells * tiling.lattice_px, halo_px) for size in image.shape[2:]]
    rows = []
    for top, bottom, low, high in sides[0]:
        row = []
        for left, right, west, east in sides[1]:
            window = np.ascontiguousarray(image[:, :, top:bottom, left:right])
            ends = [int(n * tiling.scale) for n in (low - top, high - top, west - left, east - left)]
            row.append(run(window)[:, :, ends[0] : ends[1], ends[2] : ends[3]])
        rows.append(np.concatenate(row, axis=3))
    return np.concatenate(rows, axis=2)


def check_tiles(
    model: onnx.ModelProto, size: tuple[int, int], all_cells: tuple[int, ...] = (1, 3), short_px: int = 0
) -> None:
    """Tiled is whole, bit for bit, at a size that is extended to the lattice; the halo may be too short."""
    tiling, session = tiling_of(model), session_of(model)
    image = np.random.default_rng(1).integers(0, 4096, (1, tiling.channels_in, *size)).astype(np.float32)
    more = [-n % tiling.lattice_px for n in size]
    image = np.pad(image, ((0, 0), (0, 0), (0, more[0]), (0, more[1])), mode="edge")

    def run(window: np.ndarray) -> np.ndarray:
        return np.asarray(session.run(None, {"image": window})[0])

    expected = run(image)
    assert expected.shape == (1, tiling.channels_out, *(int(n * tiling.scale) for n in image.shape[2:]))
    for cells in all_cells:
        np.testing.assert_array_equal(tiled(run, image, tiling, cells, tiling.halo_px - short_px), expected)


@settings(max_examples=40)
@given(networks(), st.integers(9, 40), st.integers(9, 40))
def test_random_networks_are_tiled_as_a_whole(model: onnx.ModelProto, height: int, width: int) -> None:
    lattice_px = tiling_of(model).lattice_px
    check_tiles(model, (height + 2 * lattice_px, width + lattice_px))


UNETS = {"float": (float_unet(), Tiling(6, 2)), "int8": (int8_unet(), Tiling(8, 4))}


@pytest.mark.parametrize("name", UNETS)
def test_unets_are_tiled_as_a_whole_and_no_smaller_halo_does(name: str) -> None:
    model, tiling = UNETS[name]
    assert tiling_of(model) == tiling
    check_tiles(model, (45, 38), (2, 5))
    with pytest.raises(AssertionError, match="Mismatched"):
        check_tiles(model, (45, 38), (2, 5), short_px=tiling.lattice_px)
