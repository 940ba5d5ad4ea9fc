"""Tests that an enlarged image keeps its place on Earth and that pixels can have a nodata value."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.raster.facts import Georeference, usable_nodata

NUMBER = st.floats(-1e3, 1e3).map(lambda number: round(number, 3))
SIZE = st.floats(0.1, 1e3)


@given(st.tuples(SIZE, NUMBER, NUMBER, NUMBER, SIZE, NUMBER), NUMBER, NUMBER, st.integers(1, 4))
def test_the_pixels_of_an_enlarged_pixel_keep_its_middle(
    matrix: tuple[float, ...], column: float, row: float, scale: int
) -> None:
    """This holds for a transform, ground control points and rational polynomials."""
    polynomials = {"LINE_OFF": "20.5", "LINE_SCALE": "7", "SAMP_OFF": "3", "SAMP_SCALE": "2"}
    georeference = Georeference(
        transform=Affine(*matrix),
        gcps=((row, column, 1.0, 2.0, 3.0),),
        rpcs=tuple(polynomials.items()),
    )
    larger = georeference.enlarged(scale)
    parts = [(k + 0.5) for k in range(scale)]
    middles = [
        larger.transform @ (column * scale + across, row * scale + down)
        for down, across in product(parts, parts)
    ]
    np.testing.assert_allclose(
        np.mean(middles, axis=0),
        georeference.transform @ (column + 0.5, row + 0.5),
        rtol=1e-6,
        atol=1e-5,
    )
    assert larger.gcps[0] == (row * scale, column * scale, 1.0, 2.0, 3.0)
    # Polynomials count pixels from the middle of the first one, in units of their scale.
    after = {key: float(text) for key, text in larger.rpcs}
    for axis, at in (("LINE", row), ("SAMP", column)):
        offset = float(polynomials[f"{axis}_OFF"])
        normalised = (at - offset) / float(polynomials[f"{axis}_SCALE"])
        own = np.mean([at * scale + part - 0.5 for part in parts])
        assert (own - after[f"{axis}_OFF"]) / after[f"{axis}_SCALE"] == pytest.approx(
            normalised, abs=1e-6
        )


@pytest.mark.parametrize("text", ["none", " "])
@pytest.mark.parametrize("key", ["LINE_OFF", "SAMP_SCALE"])
def test_polynomials_that_are_no_numbers_do_not_stop_an_enlargement(key: str, text: str) -> None:
    polynomials = {"LINE_OFF": "20.5", "SAMP_SCALE": "2", key: text}
    assert Georeference(rpcs=tuple(polynomials.items())).enlarged(2).rpcs == ()


def test_a_scale_of_1_keeps_the_georeference() -> None:
    georeference = Georeference(rpcs=(("LINE_OFF", "1"),))
    assert georeference.enlarged(1) is georeference


@given(st.floats(-1e6, 1e6), st.sampled_from(["uint8", "int16", "uint16", "int32", "float32"]))
def test_a_nodata_value_is_one_that_a_pixel_can_have(value: float, kind: str) -> None:
    dtype = np.dtype(kind)
    used = usable_nodata(value, dtype)
    if dtype.kind == "f" or (value.is_integer() and int(value) in _values(dtype)):
        assert used == value
    else:
        assert used is None


def _values(dtype: np.dtype[Any]) -> range:
    limits = np.iinfo(dtype)
    return range(limits.min, limits.max + 1)
