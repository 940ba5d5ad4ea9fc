"""Tests of what the host computes at a network's end: an activation, and the enlarged image."""

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import onnx
import pytest
import torch
from numpy.testing import assert_allclose

from beers_deploy.quant.encodings import encoding_faults
from beers_deploy.quant.graph import IMAGE, read_network, read_planes
from beers_deploy.quant.graph.base import THE_IMAGE, Base, Mode
from beers_deploy.quant.graph.writer import write_base
from beers_deploy.quant.host_part import HostPart, Plain
from beers_deploy.quant.integer.agreement import agreement
from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx_file import GraphWriter, make_model
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.quick import image, in_float, patches_of, quickly, run_model
from tests.quant.simplify.networks import parsed
from tests.quant.tiling.small_networks import check_tiles

RANDOM = np.random.default_rng(2)
CONSTANTS = {
    "into": RANDOM.normal(0, 0.3, (6, 2, 3, 3)),
    "two": RANDOM.normal(0, 0.2, (2, 6, 3, 3)),
    "into_three": RANDOM.normal(0, 0.3, (6, 3, 3, 3)),
    "alone": RANDOM.normal(0, 0.2, (1, 6, 3, 3)),
    "eight": RANDOM.normal(0, 0.2, (8, 6, 3, 3)),
    "double": [1.0, 1.0, 2.0, 2.0],
    "half": 0.5,
    "around": [0, 0, 4, 4] * 2,
    "eights": [8, 8],
    "minus_eights": [-8, -8],
    "axes": [2, 3],
    "zero": [0],
    "one": [1],
    "ends": [2],
    "low": 0.0,
    "high": 1.0,
}
PADS = "<pads=[1,1,1,1]>"
FEATURES = f"a = Conv{PADS}(image, into) b = Relu(a)"
SHUFFLED = f'{FEATURES} c = Conv{PADS}(b, eight) d = DepthToSpace<blocksize=2, mode="CRD">(c)'
PLAIN = f"{FEATURES} c = Conv{PADS}(b, two)"
HALF_PIXEL = 'coordinate_transformation_mode="half_pixel"'
BLOCKS = 'coordinate_transformation_mode="asymmetric", nearest_mode="floor"'
ENDS = {
    "nearest": (
        f"{SHUFFLED} e = Resize<{BLOCKS}>(image, , double) restored = Add(d, e)",
        ("", Base((), 2), True),
    ),
    "bilinear, clipped": (
        f"""{PLAIN} d = Resize<{BLOCKS}>(c, , double)
        e = Resize<mode="linear", {HALF_PIXEL}>(image, , double)
        f = Add(e, d) restored = Clip(f, low, high)""",
        ("", Base((), 2, "linear"), True),
    ),
    "bicubic": (
        f"""{SHUFFLED} e = Resize<mode="cubic", {HALF_PIXEL}>(image, , double)
        restored = Add(d, e)""",
        ("", Base((), 2, "cubic"), True),
    ),
    "repeated channels": (
        f"""{FEATURES} c = Conv{PADS}(b, eight)
        x = Slice(image, zero, one, one) y = Slice(image, one, ends, one)
        e = Concat<axis=1>(x, x, x, x, y, y, y, y)
        f = Add(c, e) restored = DepthToSpace<blocksize=2, mode="CRD">(f)""",
        ("", Base((), 2), True),
    ),
    "one channel, which the core reads too": (
        f"""x = Slice(image, one, ends, one) y = Concat<axis=1>(x, image)
        a = Conv{PADS}(y, into_three) b = Relu(a) c = Conv{PADS}(b, alone)
        restored = Add(x, c)""",
        ("", Base((1,)), True),
    ),
    "a channel less its noise": (
        f"""{FEATURES} c = Conv{PADS}(b, alone) x = Slice(image, zero, one, one)
        restored = Sub(x, c)""",
        ("", Base((0,)), True),
    ),
    "Sigmoid": (f"{SHUFFLED} restored = Sigmoid(d)", ("Sigmoid", THE_IMAGE, False)),
    "Tanh in the range of Sigmoid": (
        f"{PLAIN} d = Tanh(c) e = Add(d, high) restored = Mul(half, e)",
        ("Sigmoid", THE_IMAGE, False),
    ),
    "Tanh of the correction": (
        f"{PLAIN} d = Tanh(c) restored = Add(image, d)",
        ("Tanh", THE_IMAGE, True),
    ),
    "Tanh of the correction of the enlarged image": (
        f"""{SHUFFLED} e = Tanh(d) f = Resize<{BLOCKS}>(image, , double)
        restored = Add(f, e)""",
        ("Tanh", Base((), 2), True),
    ),
    "Tanh, enlarged image, and a crop of the mirrored border": (
        f"""m = Pad<mode="reflect">(image, around) a = Conv{PADS}(m, into) b = Relu(a)
        c = Conv{PADS}(b, eight) d = DepthToSpace<blocksize=2, mode="CRD">(c) e = Tanh(d)
        f = Resize<{BLOCKS}>(m, , double) g = Add(f, e)
        restored = Slice(g, eights, minus_eights, axes)""",
        ("Tanh", Base((), 2), True),
    ),
    "Sigmoid of a sum with the image": (
        f"{PLAIN} d = Add(image, c) restored = Sigmoid(d)",
        ("Sigmoid", THE_IMAGE, False),
    ),
}


@cache
def float_network(name: str) -> onnx.ModelProto:
    nodes, _ = ENDS[name]
    ends = "float[N,2,H,W] image => float[N,2,P,Q] restored"
    return simplify(parsed(nodes, ends, constants=CONSTANTS), name)


@pytest.mark.parametrize("name", ENDS)
def test_the_host_takes_the_end_and_nothing_changes_in_float(name: str) -> None:
    network = read_network(float_network(name))
    activation, base, adds_image = ENDS[name][1]
    assert network.activation == activation
    assert network.base == base
    assert network.adds_image == adds_image
    part = HostPart.of(network, Plain())
    raw = image(9, 14, channels=2)
    correction = in_float(read_planes(network.graph), raw, part)
    expected = part.clip(run_model(float_network(name), raw))
    assert_allclose(part.finish(raw, correction), expected, atol=1e-5)
    # Fine-tuning computes its targets by the inverse, where nothing is clipped.
    part = replace(part, limits=(-9.0, 9.0))
    restored = part.finish(raw, correction)
    activated = part.correction_of(raw, restored)
    assert_allclose(replace(part, activation="").finish(raw, activated), restored, atol=1e-5)


@pytest.mark.parametrize("name", ENDS)
def test_int8_files_end_as_the_host_part_does(name: str) -> None:
    raw = [image(24, 40, seed, channels=2) for seed in range(3)]
    int8 = quickly(float_network(name), patches_of(raw[:2]))
    assert encoding_faults(int8.host) == []
    part = int8.core.host_part
    expected = part.finish(raw[2], agreement(int8.core, int8.host, raw[2]).even)
    restored = run_model(int8.host, raw[2])
    assert_allclose(restored, expected, atol=1e-6)
    in_float = part.clip(run_model(float_network(name), raw[2]))
    # A sum inside the core has 8 bits.
    assert np.abs(restored - in_float).mean() < 0.01
    check_tiles(int8.host, raw[2], (16, 24))


@pytest.mark.parametrize(
    ("mode", "factor"),
    [("nearest", 3), *product(("linear", "cubic"), (2, 4))],
)
def test_an_enlarged_base_equals_torch_and_the_runtime(mode: Mode, factor: int) -> None:
    raw = image(7, 11, channels=2)
    names = {"nearest": "nearest", "linear": "bilinear", "cubic": "bicubic"}
    expected = torch.nn.functional.interpolate(
        torch.from_numpy(raw), scale_factor=factor, mode=names[mode]
    )
    base = Base((), factor, mode)
    assert_allclose(base(raw), expected.numpy(), atol=1e-6)
    writer = GraphWriter()
    writer.node("Identity", "restored", [write_base(writer, base, IMAGE)])
    result = onnx.helper.make_tensor_value_info("restored", onnx.TensorProto.FLOAT, None)
    model = make_model(writer.graph("g", [image_info(IMAGE, 2, None)], [result]), {})
    assert_allclose(run_model(model, raw), expected.numpy(), atol=1e-6)
