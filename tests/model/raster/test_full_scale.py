"""Whose pixels are 12-bit digital numbers, and whose nobody can know."""

from collections.abc import Iterator

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


@pytest.mark.parametrize("kind", ["uint16", "int16", "uint32", "int32"])
def test_integers_of_more_than_8_bits_are_12_bit_digital_numbers(kind: str) -> None:
    # Values above the scale are not refused here, but where pixels are read.
    for brightest in (0, 1, 255, 4095, 60000):
        assert settled(kind, brightest) == MAX_DN


@pytest.mark.parametrize("kind", ["float16", "float32", "float64"])
def test_floats_beyond_any_share_are_digital_numbers(kind: str) -> None:
    assert settled(kind, 0.0, 1.0, 2.5) == MAX_DN
    assert settled(kind, 4095) == MAX_DN
    for brightest in (1e-6, 0.5, 1.0, UNIT_MAX):
        with pytest.raises(
            ImageError, match=r"x\.tif has floats of at most .*shares of full scale.*`full_scale`"
        ):
            settled(kind, 0.0, brightest)


@pytest.mark.parametrize("kind", ["uint8", "int8"])
def test_8_bit_pixels_leave_it_open(kind: str) -> None:
    with pytest.raises(ImageError, match=r"x\.tif has 8-bit pixels.*`full_scale` \(255 for"):
        settled(kind, 200)


def test_black_says_nothing() -> None:
    assert settled("float32") == settled("float32", 0.0, 0.0) == MAX_DN


@pytest.mark.parametrize(
    ("kind", "requested"), [("uint8", 255), ("float32", 0.5), ("float32", 4095), ("uint16", 1023)]
)
def test_what_was_asked_for_settles_it(kind: str, requested: float) -> None:
    assert settled(kind, 0.7, requested=requested) == requested


IMPOSSIBLE = (0, -1, float("nan"), float("inf"))


@pytest.mark.parametrize(
    ("kind", "words", "requested"),
    [("uint16", "integer", (*IMPOSSIBLE, 0.5)), ("float32", "above 0", IMPOSSIBLE)],
)
def test_no_image_has_such_a_full_scale(
    kind: str, words: str, requested: tuple[float, ...]
) -> None:
    for full_scale in requested:
        with pytest.raises(OptionError, match=f"full_scale.*{words}"):
            settled(kind, 1000, requested=full_scale)


def test_no_more_is_looked_at_than_decides() -> None:
    with_look: list[float] = []

    def parts() -> Iterator[Extent]:
        for value in (0.0, 0.9, 3000.0, 4000.0):
            with_look.append(value)
            yield Extent(value, whole=False)

    assert settled_scale("x", np.dtype("float32"), parts()) == MAX_DN
    assert with_look == [0.0, 0.9, 3000.0]
    assert settled_scale("x", np.dtype("uint16"), parts()) == MAX_DN
    assert with_look == [0.0, 0.9, 3000.0]


def test_floats_that_may_be_radiances_leave_it_open() -> None:
    digital = np.random.default_rng(0).integers(0, 1700, (40, 40)).astype(np.float32)
    for pixels, open_ in (
        (digital, False),
        (digital / 10.2375, True),
        (digital * 2.1, False),
        (digital / 4.0, True),
    ):
        if open_:
            with pytest.raises(ImageError, match=r"radiances.*full_scale"):
                settled_scale("x", pixels.dtype, [extent_of(pixels)])
        else:
            assert settled_scale("x", pixels.dtype, [extent_of(pixels)]) == MAX_DN


def test_who_has_no_such_option_says_what_else_to_do() -> None:
    with pytest.raises(ImageError, match=r"\. Rescale it\.$"):
        settled_scale("x", np.dtype("uint8"), (), remedy="Rescale it.")
