"""The shipped networks, and such as are made to saturate, in both encodings: the integer reference
bit for bit.
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
from beers_deploy.quant.integer.reference import correction, merged_correction, run_core
from beers_deploy.quant.session import open_session, run
from tests.processors.conftest import Encodings

Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]


def noise(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Digital numbers of all sizes side by side: the largest sums."""
    return generator.integers(0, 4096, shape)


def edges(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Black and white: the strongest that there are."""
    return generator.integers(0, 2, shape) * 4095


def image(draw: Draw, shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    """(1, 1, H, W) in [0, 1]."""
    dn = draw(np.random.default_rng(seed), shape)
    return (dn.astype(np.float32) / np.float32(4095))[None, None]


@pytest.mark.parametrize("optimise", [True, False], ids=["optimised", "unoptimised"])
@pytest.mark.parametrize("draw", [noise, edges])
@pytest.mark.parametrize("shape", [(37, 53), (4, 4), (4, 40)])
def test_both_encodings_are_the_integer_reference(
    shape: tuple[int, int], draw: Draw, optimise: bool, shipped: Encodings
) -> None:
    pixels = image(draw, shape)
    planes = shipped.core.host_part.encode(pixels)
    tensors, _ = run_core(shipped.core, planes, half_even=True)
    restored = np.clip(pixels + merged_correction(shipped.core, tensors), 0, 1)
    assert_array_equal(run(open_session(shipped.host, optimise=optimise), pixels), restored)
    feed = {PLANES: planes.astype(np.float32) * np.float32(2.0**-PLANES_FRAC_BITS)}
    by_board = open_session(shipped.board, optimise=optimise).run(None, feed)[0]
    assert_array_equal(by_board, correction(shipped.core, planes, half_even=True))


def test_every_layer_is_that_of_the_integer_reference(shipped: Encodings) -> None:
    layers = agreement(shipped.core, shipped.host, image(noise, (29, 31)))
    assert {layer.report.name: layer.unequal for layer in layers.layers if layer.unequal} == {}


def test_the_board_s_core_is_the_host_file_s(shipped: Encodings) -> None:
    """The tests above compare two files of one network: its bias, made int8, aligns to what the
    file holds.
    """
    assert list(host_model(shipped.core, {}).graph.initializer) == list(
        shipped.host.graph.initializer
    )


def harsh_core(seed: int, channels: int) -> IntCore:
    """Two convolutions of weights at the ends of int8, cut so that their results fill int8 but for
    few of them.
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
    # The map has the product's fractional bits, less those that the shift cuts.
    inner = PLANES_FRAC_BITS + 10 - 9
    return IntCore(
        (first, last), {PLANES: PLANES_FRAC_BITS, "inner": inner, CORRECTION: inner + 10 - 10}
    )


@pytest.mark.parametrize("channels", [5, 16, 32])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_largest_products_are_added_exactly(seed: int, channels: int) -> None:
    core = harsh_core(seed, channels)
    pixels = image(edges, (13, 21), seed)
    expected = correction(core, IMAGE_SLICES.encode(pixels), half_even=True)
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
    """What kernels without VNNI make of sums over the last axis: products of neighbours added in
    saturating int16.
    """
    pairs = (values.astype(np.int64) * weights).reshape(*values.shape[:-1], -1, 2).sum(-1)
    return np.asarray(np.clip(pairs, -(2**15), 2**15 - 1).sum(-1))


def test_saturated_sums_would_show() -> None:
    """The control: what these networks add leaves int16, so a kernel that saturates would give
    other numbers.
    """
    for seed in range(4):
        core = harsh_core(seed, 16)
        last = core.ops[-1]
        assert isinstance(last, IntConv)
        tensors, _ = run_core(
            core, IMAGE_SLICES.encode(image(edges, (13, 21), seed)), half_even=True
        )
        # One tap over all channels is what one dot product of a kernel adds.
        weights = last.weight[0, :, 1, 1].astype(np.int64)
        # The host's file stores activations as UINT8, 128 above their value.
        stored = np.moveaxis(tensors["inner"], 1, -1).astype(np.int64) + 128
        exact = (stored * weights).sum(-1)
        assert (saturating_sums(stored, weights) != exact).mean() > 0.3
