"""Tests of networks with other ranges than [0, 1]: integers, borders and refused ranges."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
import pytest
import tifffile
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import encoding_faults, read_core
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import read_network, read_planes
from beers_deploy.quant.host_part import HostPart, Plain, host_part_from_json, host_part_to_json
from beers_deploy.quant.input_range import (
    Ranges,
    from_shares,
    ranges_of,
    ranges_of_result,
    read_ranges,
    to_shares,
)
from beers_deploy.quant.integer.agreement import agreement
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.price import price_rows
from beers_deploy.quant.samples.own import read_samples
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session
from tests.quant.quick import in_float as float_result
from tests.quant.quick import quickly, run_model
from tests.quant.simplify.networks import parsed
from tests.quant.test_odd_networks import SAME

ENDS = st.floats(-300, 300, width=32)
PAIRS = st.tuples(ENDS, ENDS).filter(lambda ends: ends[1] - ends[0] > 0.01)
RANGES = st.lists(PAIRS, min_size=1, max_size=4).map(tuple)
SIDES = st.integers(3, 11)
LIMITS = [(-1.0, 1.0), (0.0, 1.0), (0.0, 255.0), (-0.25, 0.5)]
NO_REFERENCE = np.empty(0)
MAX_DN = 4095


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
    """Build two padded convolutions behind a pixel unshuffle of `block`.

    The first one's weights are multiplied by `gains` (C,), the last one's by `out_gains`.
    """
    generator = np.random.default_rng(0)
    pixels = block**2
    factors = np.repeat(np.broadcast_to(gains, channels), pixels)
    first = generator.normal(0, 0.3, (6, channels * pixels, 3, 3))
    first *= factors[:, None, None]
    last = generator.normal(0, 0.3, (outputs * pixels, 6, 5, 5))
    last *= np.broadcast_to(out_gains, len(last))[:, None, None, None]
    bias = generator.normal(0, 0.3, 6)
    low, high = limits or (0.0, 0.0)
    constants = {"first": first, "bias": bias, "last": last, "low": low, "high": high}
    source = "image"
    nodes = ""
    if block > 1:
        # ONNX's own operator has another order of the channels than torch, but of one channel.
        nodes += f"places = SpaceToDepth<blocksize={block}>(image) "
        source = "places"
    nodes += f"conv_1 = {SAME}({source}, first, bias) relu = Relu(conv_1) "
    nodes += "conv_2 = Conv<pads=[2,2,2,2]>(relu, last) "
    result = "conv_2"
    if block > 1:
        nodes += f"pixels = DepthToSpace<blocksize={block}>({result}) "
        result = "pixels"
    if adds_image:
        nodes += f"sum = Add(image, {result}) "
        result = "sum"
    if limits:
        nodes += f"clip = Clip({result}, low, high)"
        result = "clip"
    ends = f"float[N,{channels},H,W] image => float[N,{outputs},P,Q] {result}"
    return parsed(nodes, ends, constants=constants)


def shares(channels: int, rows: int = 13, columns: int = 18, count: int = 3) -> list[np.ndarray]:
    """Return images (1, C, rows, columns) in [0, 1]."""
    generator = np.random.default_rng(3)
    images = generator.uniform(0, 1, (count, 1, channels, rows, columns))
    return list(images.astype(np.float32))


def scaled(images: Sequence[np.ndarray], gains: np.ndarray) -> list[np.ndarray]:
    """Return images whose channels are multiplied by `gains` (C,)."""
    factors = gains[:, None, None]
    return [(image * factors).astype(np.float32) for image in images]


def patches(images: Sequence[np.ndarray], ranges: Ranges = ()) -> Patches:
    """Return images, each its own reference, of a range of values."""
    return Patches([(image, image) for image in images], images, ranges=ranges)


def same_integers(one: IntCore, other: IntCore) -> bool:
    """Return True if two cores have equal weights, biases and scales of weights."""
    for a, b in zip(one.convolutions, other.convolutions, strict=True):
        if a.weight_frac_bits != b.weight_frac_bits:
            return False
        if not np.array_equal(a.weight, b.weight) or not np.array_equal(a.bias, b.bias):
            return False
    return True


@settings(max_examples=10)
@given(st.lists(st.integers(-8, 8), min_size=1, max_size=4), st.booleans())
def test_a_network_of_scaled_channels_has_the_same_integers(
    exponents: list[int], signed: bool
) -> None:
    """A network that reads other units has the same integers and the same results.

    It is so exactly, because the scales are powers of two. A range of both signs is encoded in
    the same planes as a range of one sign.
    """
    gains = 2.0 ** np.array(exponents)
    count = len(gains)
    images = shares(count)
    wide = scaled(images, gains)
    ranges = tuple((-gain if signed else 0.0, gain) for gain in map(float, gains))
    plain = quickly(network(count, 2), patches(images))
    other = quickly(network(count, 2, gains=1 / gains), patches(wide, ranges))
    assert same_integers(plain.core, other.core)
    expected = run_model(plain.host, images[0])
    actual = run_model(other.host, wide[0])
    assert_array_equal(actual, expected)


@settings(max_examples=25)
@given(
    ranges=RANGES,
    sides=st.tuples(SIDES, SIDES),
    block=st.sampled_from([1, 2]),
    adds_image=st.booleans(),
)
def test_padding_stays_zero(
    ranges: Ranges, sides: tuple[int, int], block: int, adds_image: bool
) -> None:
    """In float the network of planes agrees with the network of the image, but for the encoding.

    It does so at borders too, where a zero of padding must stay a zero in the network's own
    units.
    """
    ranges = ranges[:1] if block > 1 else ranges
    channels = len(ranges)
    sizes = np.array([max(map(abs, ends)) for ends in ranges])
    model = network(channels, channels, gains=1 / sizes, block=block, adds_image=adds_image)
    split = read_network(model)
    part = HostPart.of(split, Plain(), ranges)
    rows, columns = sides
    (share,) = shares(channels, block * rows, block * columns, 1)
    image = from_shares(share, ranges)
    graph = read_planes(split.graph, part.full_scale)
    correction = float_result(graph, image, part)
    actual = part.finish(image, correction)
    expected = run_model(model, image)
    # Half a digital number at each of up to 4 * 9 taps, whose weights are below 1.5.
    assert_allclose(actual, expected, atol=36 * 1.5 * 30 / (2 * MAX_DN))


@settings(max_examples=12)
@given(
    ranges=RANGES,
    adds_image=st.booleans(),
    side=st.sampled_from([9, 14]),
    limits=st.none() | st.sampled_from(LIMITS),
)
def test_numpy_onnx_and_description_agree(
    ranges: Ranges, adds_image: bool, side: int, limits: tuple[float, float] | None
) -> None:
    """NumPy, onnxruntime and the description in the file compute the same for any range and limits.

    A board's host is written from the description alone. The network's limits are stored in it.
    """
    channels = len(ranges)
    model = network(channels, channels, gains=0.1, adds_image=adds_image, limits=limits)
    images = [from_shares(image, ranges) for image in shares(channels, side)]
    int8 = quickly(model, patches(images, ranges))
    assert encoding_faults(int8.host) == []
    core = read_core(int8.host)
    assert same_integers(core, int8.core)
    part = core.host_part
    assert part == int8.core.host_part
    image = images[0]
    layers = agreement(int8.core, int8.host, image).layers
    assert not any(layer.unequal for layer in layers)
    tensors, _ = run_core(int8.core, part.encode(image), half_even=True)
    scale = int8.core.scale("correction")
    correction = tensors["correction"].astype(np.float32) * np.float32(scale)
    restored = run_model(int8.host, image)
    assert_array_equal(part.restore(image, correction, scale), restored)
    assert part.clip_limits == (limits or ())
    if limits:
        assert limits[0] <= restored.min() <= restored.max() <= limits[1]


@pytest.mark.parametrize(
    ("limits", "stored"), [((0.0, 1.0), ()), ((0.25, 0.5), (0.25, 0.5))], ids=["usual", "narrow"]
)
def test_limits_are_stored_for_images_in_the_usual_range_too(
    limits: tuple[float, float], stored: tuple[float, ...]
) -> None:
    """The network's clip is stored, except one to [0, 1], which storing an image applies anyway."""
    int8 = quickly(network(1, 1, limits=limits), patches(shares(1)))
    assert int8.core.host_part.clip_limits == stored


@given(PAIRS, st.integers(0, MAX_DN))
def test_the_encoding_errs_by_half_a_step(ends: tuple[float, float], dn: int) -> None:
    """Any value of a range is encoded to half a digital number of 12 bits, relative to its
    larger end.
    """
    low, high = map(float, ends)
    part = HostPart(input_ranges=((low, high),), encoding=HostPart().encoding)
    part = host_part_from_json(host_part_to_json(part))
    value = np.float32(low + (high - low) * dn / MAX_DN)
    planes = part.encode(np.full((1, 1, 1, 1), value))
    coarse, rest, _ = planes[0, :, 0, 0].astype(int)
    step = max(abs(low), abs(high)) / MAX_DN
    decoded = (32 * coarse + rest) * step
    assert abs(decoded - float(value)) <= 0.501 * step


@settings(max_examples=10)
@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), st.floats(0, 0.01))
def test_figures_do_not_depend_on_the_unit(exponents: list[int], error: float) -> None:
    """Networks that differ by `error` are compared with the same figures, whatever the unit.

    Without this a limit of the gate would mean something else for each network.
    """
    gains = 2.0 ** np.array(exponents)
    images = shares(len(gains), count=2)
    # The range is found from the samples, so one pixel has to reach 1.
    images[0][..., 0, 0] = 1
    figures = []
    count = len(gains)
    for unit in (np.ones(count), gains):
        exact = network(count, count, gains=1 / unit, out_gains=unit)
        wrong = network(count, count, gains=1 / unit, out_gains=(1 + error) * unit)
        samples = scaled(images, unit)
        pairs = patches(samples, ranges_of(samples))
        result = compare(open_session(exact), open_session(wrong), pairs)
        figures.append((result.mae, result.max_abs, result.psnr_float_db, result.input_change))
    assert figures[0] == pytest.approx(figures[1], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("block", [1, 2])
def test_prices_do_not_depend_on_the_unit(block: int) -> None:
    """A restriction of a DPU costs a network the same share of its range, whatever the unit.

    Channels of unequal units would share a scale in the result, which has a price.
    """
    gains = np.full(2, 32.0)
    images = shares(2, 14, 18)
    images[0][..., 0, 0] = 1
    rows = []
    for unit in (np.ones(2), gains):
        model = network(2, 2, gains=1 / unit, out_gains=np.repeat(unit, block**2), block=block)
        samples = scaled(images, unit)
        pairs = patches(samples, ranges_of(samples))
        rows.append(price_rows(quickly(model, pairs), pairs))
    for one, other in zip(*rows, strict=True):
        for name in one.figures.keys() & {"MAE", "PSNR drop"}:
            assert one.figures[name].value == pytest.approx(other.figures[name].value, rel=0.02)


@given(RANGES)
def test_shares_are_inverse(ranges: Ranges) -> None:
    """An image that is mapped to its range and back is the image again."""
    image = shares(len(ranges), 4, 5, 1)[0]
    again = to_shares(from_shares(image, ranges), ranges)
    assert_allclose(again, image, atol=1e-3)


@given(RANGES)
def test_a_stated_range_is_read_as_it_is(ranges: Ranges) -> None:
    """A range is read the same from text, from pairs, and from one pair for all channels."""
    # Ranges that are all [0, 1] are read as none, which another test checks.
    assume((0, 1) not in ranges)
    text = ",".join(repr(float(end)) for end in chain.from_iterable(ranges))
    assert read_ranges(text, len(ranges)) == ranges
    assert read_ranges(ranges, len(ranges)) == ranges
    assert read_ranges(ranges[0], 3) == ranges[:1] * 3


def test_the_usual_range_is_none() -> None:
    """The range [0, 1] is stored as no range, so that files of usual networks stay as they were."""
    assert read_ranges("0,1", 4) == ()
    assert ranges_of(shares(3)) == ()


@pytest.mark.parametrize("option", ["", "1", "1,0", "0,0", "0,1,2", "0,nan", "0,inf", "0,1e9", 5])
def test_an_invalid_range_is_refused(option: object) -> None:
    """A range that is empty, not finite or too large is refused with the form that is expected."""
    with pytest.raises(OptionError, match="`input_range` must be LOW,HIGH"):
        read_ranges(option, 3)


def test_samples_determine_the_range() -> None:
    """The range of each channel that leaves [0, 1] is found from the samples.

    A constant map is a level without contrast, so samples of constant channels alone are refused.
    """
    image = shares(4, 8, 8, 1)[0]
    image[:, 1] = 2 * image[:, 1] - 1
    image[:, 3] = 25
    samples = read_samples([(image[0], NO_REFERENCE)], 4, None)
    low = float(image[0, 1].min())
    high = float(image[0, 1].max())
    assert samples.ranges == ((0.0, 1.0), (low, high), (0.0, 1.0), (0.0, 25.0))
    assert "found in the samples" in samples.about["input_range"]
    levels = np.array([0.5, -1, 0.1, 25], np.float32)
    flat = np.broadcast_to(levels[:, None, None], (4, 8, 8))
    with pytest.raises(ImageError, match="constant"):
        read_samples([(flat, NO_REFERENCE)], 4, None)


def test_samples_outside_a_stated_range_are_refused() -> None:
    """Values outside of the stated range are refused."""
    beyond = [(2 * shares(1)[0][0], NO_REFERENCE)]
    with pytest.raises(ImageError, match="must be in `input_range`, -1 to 1"):
        read_samples(beyond, 1, None, ranges=((-1.0, 1.0),))


@settings(max_examples=10)
@given(st.tuples(PAIRS, PAIRS, PAIRS))
def test_image_files_are_mapped_onto_a_stated_range(ranges: Ranges) -> None:
    """0 to full scale of an image file become LOW to HIGH of each channel; a .npy file stays."""
    pixels = np.random.default_rng(4).integers(0, 256, (8, 9, 3), np.uint8)
    pixels[0, :2] = [[0], [255]]
    expected = from_shares(np.moveaxis(pixels, -1, 0) / np.float32(255), ranges)
    with TemporaryDirectory() as folder:
        tifffile.imwrite(f"{folder}/a.tif", pixels, photometric="rgb")
        np.save(f"{folder}/b.npy", expected)
        samples = read_samples(Path(folder), 3, None, ranges=ranges)
    for image in samples.all.degraded:
        assert_allclose(image[0], expected, atol=1e-4)
    assert samples.stated


def test_a_channel_of_zeros_may_be_a_little_below() -> None:
    """Rounding leaves -1e-8 in a degradation code, which needs no range of its own.

    A channel that reaches as far below zero as the smallest range has its own range.
    """
    image = shares(2, 8, 8, 1)[0]
    image[:, 1] = -1e-8
    assert ranges_of([image]) == ()
    image[:, 1] = -1e-3
    assert_allclose(ranges_of([image]), ((0.0, 1.0), (-1e-3, 0.0)))


@pytest.mark.parametrize(
    ("ends", "size", "is_own"),
    [
        ((0.0, 1.0), 0.3, False),
        ((0.0, 1.0), 20, True),
        ((0.0, 255.0), 150, False),
        ((0.0, 255.0), 5, False),
        ((0.0, 255.0), 3000, True),
        ((-1.0, 1.0), 40, True),
    ],
)
def test_maps_of_another_unit_are_compared_by_their_own_range(
    ends: tuple[float, float], size: float, is_own: bool
) -> None:
    """Logits of a detector have no range of the image, unless most of them lie in it."""
    ranges = () if ends == (0, 1) else (ends,) * 2
    image = from_shares(shares(2, 9, 9, 1)[0], ranges)
    maps = size * np.random.default_rng(5).uniform(-0.2, 1.5, (1, 3, 9, 9))
    own = ((maps.min(), maps.max()),)
    assert ranges_of_result(maps, image, ranges) == (own if is_own else ranges)


def test_a_result_of_the_images_channels_keeps_the_range_of_the_image() -> None:
    """A far too bright image is an error of the network, and not a map of another unit."""
    image = shares(3, 9, 9, 1)[0]
    assert ranges_of_result(100 * image, image, ()) == ()
    assert ranges_of_result(100 * image, image[:, :2], ()) != ()
    # A restored image next to a map of noise levels.
    colours = ((0.0, 255.0),) * 3
    assert ranges_of_result(250 * image[:, :2], 255 * image, colours) == colours
