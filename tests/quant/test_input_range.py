"""Networks of other ranges than [0, 1]: their integers, their borders, and what is refused."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import helper

from beers_deploy.profiles.errors import BeersError, ImageError, OptionError
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import encoding_faults, read_core
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import read_network, read_planes
from beers_deploy.quant.host_part import HostPart, Plain, host_part_from_json, host_part_to_json
from beers_deploy.quant.input_range import Ranges, from_shares, ranges_of, read_ranges, to_shares
from beers_deploy.quant.integer.reference import agreement, run_core
from beers_deploy.quant.onnx_file import GraphWriter, image_info, make_model
from beers_deploy.quant.samples.own import read_samples
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session, result_of
from tests.quant.quick import in_float as float_result
from tests.quant.quick import quickly

ENDS = st.floats(-300, 300, width=32)
PAIRS = st.tuples(ENDS, ENDS).filter(lambda ends: ends[1] - ends[0] > 0.01)
RANGES = st.lists(PAIRS, min_size=1, max_size=4).map(tuple)


def network(
    channels: int,
    outputs: int,
    *,
    gains: np.ndarray | float = 1.0,
    out_gains: np.ndarray | float = 1.0,
    block: int = 1,
    adds_image: bool = False,
    limits: tuple[float, float] | None = None,
) -> onnx.ModelProto:
    """Two padded convolutions behind a pixel unshuffle of `block`, the weights of the first times
    `gains` (C,), those of the last times `out_gains`.
    """
    generator = np.random.default_rng(0)
    w = GraphWriter()
    factors = np.repeat(np.broadcast_to(gains, channels), block**2)[:, None, None]
    first = generator.normal(0, 0.3, (6, channels * block**2, 3, 3)) * factors
    last = generator.normal(0, 0.3, (outputs * block**2, 6, 5, 5))
    last = last * np.broadcast_to(out_gains, len(last))[:, None, None, None]
    bias = generator.normal(0, 0.3, 6)
    arrays = {"first": first, "bias": bias, "last": last}
    names = [w.constant(name, value.astype(np.float32)) for name, value in arrays.items()]
    x = "image"
    if block > 1:
        # ONNX's own operator has another order of the channels than torch, but of one channel.
        x = w.node("SpaceToDepth", "places", [x], blocksize=block)
    x = w.node("Relu", "relu", [w.node("Conv", "conv_1", [x, *names[:2]], pads=[1] * 4)])
    x = w.node("Conv", "conv_2", [x, names[2]], pads=[2] * 4)
    if block > 1:
        x = w.node("DepthToSpace", "pixels", [x], blocksize=block)
    if adds_image:
        x = w.node("Add", "sum", ["image", x])
    if limits:
        ends = [w.constant(f"limit_{k}", np.array(end, np.float32)) for k, end in enumerate(limits)]
        x = w.node("Clip", "clip", [x, *ends])
    result = helper.make_tensor_value_info(x, onnx.TensorProto.FLOAT, ["N", outputs, "h", "w"])
    return make_model(w.graph("net", [image_info("image", channels, None)], [result]), {})


def shares(channels: int, rows: int = 13, columns: int = 18, count: int = 3) -> list[np.ndarray]:
    """Images (1, C, rows, columns) in [0, 1]."""
    generator = np.random.default_rng(3)
    return list(generator.uniform(0, 1, (count, 1, channels, rows, columns)).astype(np.float32))


def patches(images: Sequence[np.ndarray], ranges: Ranges = ()) -> Patches:
    return Patches([(image, image) for image in images], images, ranges=ranges)


def same_integers(one: IntCore, other: IntCore) -> bool:
    return all(
        np.array_equal(a.weight, b.weight)
        and np.array_equal(a.bias, b.bias)
        and a.weight_frac_bits == b.weight_frac_bits
        for a, b in zip(one.convolutions, other.convolutions, strict=True)
    )


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(-8, 8), min_size=1, max_size=4), st.booleans())
def test_a_network_of_scaled_channels_has_the_same_integers(
    exponents: list[int], signed: bool
) -> None:
    """Exactly, where scales are powers of two; a range of both signs has the planes of one sign."""
    gains = 2.0 ** np.array(exponents)
    count = len(gains)
    images = shares(count)
    scaled = [(image * gains[:, None, None]).astype(np.float32) for image in images]
    ranges = tuple((-g if signed else 0.0, float(g)) for g in gains)
    plain = quickly(network(count, 2), patches(images))
    other = quickly(network(count, 2, gains=1 / gains), patches(scaled, ranges))
    assert same_integers(plain.core, other.core)
    sessions = [open_session(each.host) for each in (plain, other)]
    np.testing.assert_array_equal(
        result_of(sessions[0], images[0]), result_of(sessions[1], scaled[0])
    )


@settings(max_examples=25, deadline=None)
@given(
    ranges=RANGES,
    sides=st.tuples(st.integers(3, 11), st.integers(3, 11)),
    block=st.sampled_from([1, 2]),
    adds_image=st.booleans(),
)
def test_padding_stays_zero(
    ranges: Ranges, sides: tuple[int, int], block: int, adds_image: bool
) -> None:
    """In float the planes give what the image gives, at borders too, but for the encoding."""
    ranges = ranges[:1] if block > 1 else ranges
    channels = len(ranges)
    sizes = np.array([max(map(abs, ends)) for ends in ranges])
    model = network(channels, channels, gains=1 / sizes, block=block, adds_image=adds_image)
    split = read_network(model)
    part = HostPart.of(split, Plain(), ranges)
    (image,) = shares(channels, block * sides[0], block * sides[1], 1)
    image = from_shares(image, ranges)
    result = float_result(read_planes(split.graph, part.full_scale), image, part)
    # Half a digital number at each of up to 4 * 9 taps, whose weights are below 1.5.
    np.testing.assert_allclose(
        part.finish(image, result), result_of(open_session(model), image), atol=36 * 1.5 * 30 / 8190
    )


@settings(max_examples=20, deadline=None)
@given(
    ranges=RANGES,
    adds_image=st.booleans(),
    side=st.sampled_from([9, 14]),
    limits=st.none() | st.sampled_from([(-1.0, 1.0), (0.0, 1.0), (0.0, 255.0), (-0.25, 0.5)]),
)
def test_numpy_onnx_and_description_agree(
    ranges: Ranges, adds_image: bool, side: int, limits: tuple[float, float] | None
) -> None:
    channels = len(ranges)
    model = network(channels, channels, gains=0.1, adds_image=adds_image, limits=limits)
    images = [from_shares(image, ranges) for image in shares(channels, side)]
    int8 = quickly(model, patches(images, ranges))
    assert encoding_faults(int8.host) == []
    assert same_integers(read_core(int8.host), int8.core)
    part = read_core(int8.host).host_part
    assert part == int8.core.host_part
    assert not any(layer.unequal for layer in agreement(int8.core, int8.host, images[0]).layers)
    tensors, _ = run_core(int8.core, part.encode(images[0]), half_even=True)
    scale = int8.core.scale("correction")
    result = tensors["correction"].astype(np.float32) * np.float32(scale)
    restored = result_of(open_session(int8.host), images[0])
    np.testing.assert_array_equal(part.restore(images[0], result, scale), restored)
    assert part.clip_limits == (limits or ())
    if limits:
        assert limits[0] <= restored.min() <= restored.max() <= limits[1]


def test_limits_are_kept_of_images_in_the_usual_range_too() -> None:
    """But for [0, 1], to which whoever stores an image clips it."""
    images = shares(1)
    for limits, expected in (((0.0, 1.0), ()), ((0.25, 0.5), (0.25, 0.5))):
        part = quickly(network(1, 1, limits=limits), patches(images)).core.host_part
        assert part.clip_limits == expected


@given(PAIRS, st.integers(0, 4095))
def test_the_encoding_errs_by_half_a_step(ends: tuple[float, float], dn: int) -> None:
    low, high = map(float, ends)
    part = HostPart(input_ranges=((low, high),), encoding=HostPart().encoding)
    part = host_part_from_json(host_part_to_json(part))
    value = np.float32(low + (high - low) * dn / 4095)
    coarse, rest, _ = part.encode(np.full((1, 1, 1, 1), value))[0, :, 0, 0].astype(int)
    size = max(abs(low), abs(high))
    assert abs((32 * coarse + rest) * size / 4095 - float(value)) <= 0.501 * size / 4095


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), st.floats(0, 0.01))
def test_figures_do_not_depend_on_the_unit(exponents: list[int], error: float) -> None:
    """Networks that differ by `error` are compared with the same figures, whatever the unit."""
    gains = 2.0 ** np.array(exponents)
    images = shares(len(gains), count=2)
    # The range that is found is that of all samples.
    images[0][..., 0, 0] = 1
    figures = []
    for unit in (np.ones(len(gains)), gains):
        in_float, in_int8 = (
            open_session(network(len(unit), len(unit), gains=1 / unit, out_gains=gain * unit))
            for gain in (1, 1 + error)
        )
        scaled = [(image * unit[:, None, None]).astype(np.float32) for image in images]
        result = compare(in_float, in_int8, patches(scaled, ranges_of(scaled)))
        figures.append((result.mae, result.max_abs, result.psnr_float_db, result.input_change))
    assert figures[0] == pytest.approx(figures[1], rel=1e-6, abs=1e-9)


@given(RANGES)
def test_shares_are_inverse(ranges: Ranges) -> None:
    image = shares(len(ranges), 4, 5, 1)[0]
    np.testing.assert_allclose(to_shares(from_shares(image, ranges), ranges), image, atol=1e-3)


@given(RANGES)
def test_a_stated_range_is_read_as_it_is(ranges: Ranges) -> None:
    text = ",".join(f"{end!r}" for pair in ranges for end in map(float, pair))
    assert read_ranges(text, len(ranges)) == ranges
    assert read_ranges(ranges, len(ranges)) == ranges
    assert read_ranges(ranges[0], 3) == ranges[:1] * 3


def test_the_usual_range_is_none() -> None:
    assert read_ranges("0,1", 4) == ()
    assert ranges_of(shares(3)) == ()


@pytest.mark.parametrize("option", ["", "1", "1,0", "0,0", "0,1,2", "0,nan", "0,inf", "0,1e9", 5])
def test_what_is_no_range_is_refused(option: object) -> None:
    with pytest.raises(OptionError, match="`input_range` must be LOW,HIGH"):
        read_ranges(option, 3)


def test_samples_tell_the_range() -> None:
    """Of each channel that leaves [0, 1]; constant maps are no contrast."""
    image = shares(4, 8, 8, 1)[0]
    image[:, 1] = 2 * image[:, 1] - 1
    image[:, 3] = 25
    samples = read_samples([(image[0], np.empty(0))], 4, None)
    low = float(image[0, 1].min())
    high = float(image[0, 1].max())
    assert samples.ranges == ((0.0, 1.0), (low, high), (0.0, 1.0), (0.0, 25.0))
    assert "found in the samples" in samples.about["input_range"]
    flat = np.broadcast_to(np.array([0.5, -1, 0.1, 25], np.float32)[:, None, None], (4, 8, 8))
    with pytest.raises(ImageError, match="constant"):
        read_samples([(flat, np.empty(0))], 4, None)


def _beyond(_: Path) -> object:
    return [(2 * shares(1)[0][0], np.empty(0))]


def _pictures(folder: Path) -> object:
    (folder / "a.png").touch()
    return folder


@pytest.mark.parametrize(
    ("write", "message"),
    [(_beyond, "must be in `input_range`, -1 to 1"), (_pictures, r"Give \.npy files")],
)
def test_samples_outside_a_stated_range_are_refused(
    write: Callable[[Path], object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ImageError, match=message):
        read_samples(write(tmp_path), 1, None, ranges=((-1.0, 1.0),))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "damage",
    [
        {"input_ranges": [[1.0, 0.0]]},
        {"input_ranges": [[0.0, float("nan")]]},
        {"input_ranges": [[0.0, 1e9]]},
        {"input_ranges": [[0.0, 2.0]] * 2},
        {"input_ranges": [[0.0]]},
        {"input_ranges": 3},
        {"limits": [1.0, 0.0]},
        {"limits": [1.0]},
        {"limits": [0.0, float("inf")]},
    ],
)
def test_a_damaged_description_is_refused(damage: dict[str, object]) -> None:
    record = {**host_part_to_json(HostPart()), **damage}
    with pytest.raises((BeersError, TypeError, ValueError)):
        host_part_from_json(record)
