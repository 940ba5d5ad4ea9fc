"""Tests of which images have 12-bit digital numbers and which need the option `full_scale`."""

from itertools import product

import numpy as np
import pytest

from beers_deploy.model.raster.facts import Extent, extent_of
from beers_deploy.model.raster.full_scale import UNIT_MAX, settled_scale
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.instrument import MAX_DN


def settled(kind: str, *largest: float, requested: float | None = None) -> float:
    return settled_scale(
        "x.tif", np.dtype(kind), (Extent(value, whole=True) for value in largest), requested
    )


@pytest.mark.parametrize(
    ("kind", "largest"),
    [
        *product(["uint16", "int16", "uint32"], [[0], [4095], [60_000]]),
        *product(["float16", "float32", "float64"], [[], [0], [0, 1, 2.5], [4095]]),
    ],
)
def test_deep_integers_and_floats_beyond_any_fraction_are_12_bit_digital_numbers(
    kind: str, largest: list[float]
) -> None:
    # Values above the scale are not refused here, but where pixels are read.
    assert settled(kind, *largest) == MAX_DN


@pytest.mark.parametrize(
    ("kind", "largest", "words"),
    [
        *(("float32", value, "shares of full scale") for value in (1e-6, 0.5, 1, UNIT_MAX)),
        ("uint8", 200, r"\(255 for"),
        ("int8", 100, "8-bit pixels"),
    ],
)
def test_fractions_and_8_bit_pixels_need_the_option(kind: str, largest: float, words: str) -> None:
    with pytest.raises(ImageError, match=words) as caught:
        settled(kind, 0, largest)
    assert str(caught.value).startswith("x.tif has ")
    assert "`full_scale`" in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "requested"), [("uint8", 255), ("float32", 0.5), ("float32", 4095), ("uint16", 1023)]
)
def test_a_requested_full_scale_is_used(kind: str, requested: float) -> None:
    assert settled(kind, 0.7, requested=requested) == requested


IMPOSSIBLE = (0, -1, float("nan"), float("inf"))


@pytest.mark.parametrize(
    ("kind", "words", "requested"),
    [("uint16", "integer", (*IMPOSSIBLE, 0.5)), ("float32", "above 0", IMPOSSIBLE)],
)
def test_an_impossible_full_scale_is_refused(
    kind: str, words: str, requested: tuple[float, ...]
) -> None:
    for full_scale in requested:
        with pytest.raises(OptionError, match=f"full_scale.*{words}"):
            settled(kind, 1000, requested=full_scale)


def test_no_more_parts_are_read_than_needed() -> None:
    parts = (Extent(value, whole=False) for value in (0.0, 0.9, 3000.0, 4000.0, 5000.0))
    assert settled_scale("x", np.dtype("float32"), parts) == MAX_DN
    assert settled_scale("x", np.dtype("uint16"), parts) == MAX_DN
    assert next(parts).largest == 4000


def test_floats_that_may_be_radiances_need_the_option() -> None:
    digital = np.random.default_rng(0).integers(0, 1700, (40, 40)).astype(np.float32)
    for pixels in (digital, digital * 2.1):
        assert settled_scale("x", pixels.dtype, [extent_of(pixels)]) == MAX_DN
    for pixels in (digital / 10.2375, digital / 4):
        with pytest.raises(ImageError, match=r"radiances.*full_scale"):
            settled_scale("x", pixels.dtype, [extent_of(pixels)])


def test_a_caller_without_the_option_states_its_own_remedy() -> None:
    with pytest.raises(ImageError, match=r"\. Rescale it\.$"):
        settled_scale("x", np.dtype("uint8"), (), remedy="Rescale it.")
