"""Tests that both encodings equal the integer reference bit for bit.

They run the shipped networks, and cores whose results saturate.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import board_model, host_model
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import CORRECTION, PLANES, PLANES_FRAC_BITS, Activation, same
from beers_deploy.quant.host_part import IMAGE_SLICES
from beers_deploy.quant.integer.agreement import agreement
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.session import open_session, run
from tests.processors.conftest import Encodings

Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]


def noise(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Draw each pixel from the full 12-bit range."""
    return generator.integers(0, 4096, shape)


def edges(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Draw black and white pixels, which have the strongest edges."""
    return generator.integers(0, 2, shape) * 4095


def image(draw: Draw, shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    """Return an image (1, 1, H, W) in [0, 1] of drawn digital numbers."""
    dn = draw(np.random.default_rng(seed), shape)
    return (dn.astype(np.float32) / np.float32(4095))[None, None]


@pytest.mark.parametrize("optimise", [True, False], ids=["optimised", "unoptimised"])
@pytest.mark.parametrize("draw", [noise, edges])
@pytest.mark.parametrize("shape", [(37, 53), (4, 4), (4, 40)])
def test_both_encodings_equal_the_integer_reference(
    shape: tuple[int, int], draw: Draw, optimise: bool, shipped: Encodings
) -> None:
    pixels = image(draw, shape)
    planes = shipped.core.host_part.encode(pixels)
    tensors, _ = run_core(shipped.core, planes, half_even=True)
    restored = np.clip(pixels + merged_correction(shipped.core, tensors), 0, 1)
    assert_array_equal(run(open_session(shipped.host, optimise=optimise), pixels), restored)
    feed = {PLANES: planes.astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)}
    by_board = open_session(shipped.board, optimise=optimise).run(None, feed)[0]
    scale = np.float32(shipped.core.scale(CORRECTION))
    assert_array_equal(by_board, tensors[CORRECTION] * scale)


def test_every_layer_equals_the_integer_reference(shipped: Encodings) -> None:
    layers = agreement(shipped.core, shipped.host, image(noise, (29, 31)))
    assert {layer.report.name: layer.unequal for layer in layers.layers if layer.unequal} == {}


def test_the_core_with_int8_biases_gives_the_host_file(shipped: Encodings) -> None:
    """So the tests above compare two encodings of one network."""
    assert list(host_model(shipped.core, {}).graph.initializer) == list(
        shipped.host.graph.initializer
    )


def harsh_core(seed: int, channels: int) -> IntCore:
    """Build two convolutions with weights near the limits of int8, whose results fill int8.

    The first saturates at 1 to 6 % of its results, the second at up to 70 % (measured).
    """
    generator = np.random.default_rng(seed)

    def conv(
        name: str, source: str, result: str, shape: tuple[int, int, int, int], relu: bool
    ) -> IntConv:
        weight = generator.choice(np.array([INT8_MIN, -100, 100, INT8_MAX], np.int8), shape)
        bias = generator.integers(INT8_MIN, INT8_MAX, shape[0]).astype(np.int8)
        activation = Activation.relu if relu else Activation.none
        return IntConv(name, source, result, weight, 10, bias, 12, activation, same(weight))

    first = conv("first", PLANES, "inner", (channels, 3, 3, 3), relu=bool(seed % 2))
    last = conv("last", "inner", CORRECTION, (1, channels, 3, 3), relu=False)
    # The map has the fractional bits of the product, less those that the shift cuts off.
    inner = PLANES_FRAC_BITS + 10 - 9
    return IntCore(
        (first, last), {PLANES: PLANES_FRAC_BITS, "inner": inner, CORRECTION: inner + 10 - 10}
    )


@pytest.mark.parametrize("channels", [5, 16, 32])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_largest_products_are_added_exactly(seed: int, channels: int) -> None:
    core = harsh_core(seed, channels)
    pixels = image(edges, (13, 21), seed)
    tensors, _ = run_core(core, IMAGE_SLICES.encode(pixels), half_even=True)
    expected = merged_correction(core, tensors)
    assert len(np.unique(expected)) > 40
    restored = np.clip(pixels + expected, 0, 1)
    feed = {
        PLANES: IMAGE_SLICES.encode(pixels).astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)
    }
    for optimise in (True, False):
        assert_array_equal(
            run(open_session(host_model(core, {}), optimise=optimise), pixels), restored
        )
        by_board = open_session(board_model(core, {}), optimise=optimise).run(None, feed)[0]
        assert_array_equal(by_board, expected)


def saturating_sums(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sums over the last axis as kernels without VNNI compute them.

    Such kernels add the products of two neighbours in saturating int16.
    """
    pairs = (values.astype(np.int64) * weights).reshape(*values.shape[:-1], -1, 2).sum(-1)
    return np.asarray(np.clip(pairs, -(2**15), 2**15 - 1).sum(-1))


def test_saturated_sums_would_show() -> None:
    """Control: sums of these cores leave int16, so a saturating kernel would give other numbers."""
    for seed in range(4):
        core = harsh_core(seed, 16)
        last = core.ops[-1]
        assert isinstance(last, IntConv)
        tensors, _ = run_core(
            core, IMAGE_SLICES.encode(image(edges, (13, 21), seed)), half_even=True
        )
        # One dot product of a kernel adds one tap over all channels.
        weights = last.weight[0, :, 1, 1].astype(np.int64)
        # The host's file stores activations as UINT8, 128 above their value.
        stored = np.moveaxis(tensors["inner"], 1, -1).astype(np.int64) + 128
        exact = (stored * weights).sum(-1)
        assert (saturating_sums(stored, weights) != exact).mean() > 0.3
