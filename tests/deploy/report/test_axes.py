import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.report.axes import Axis, padded


@given(
    st.floats(-6, 6),
    st.floats(0.01, 12),
    st.integers(3, 16),
    st.booleans(),
    st.sampled_from([(60.0, 900.0), (500.0, 30.0)]),
)
def test_ticks_are_few_rising_and_on_the_axis(
    start: float, decades: float, most: int, logarithmic: bool, ends: tuple[float, float]
) -> None:
    axis = Axis(10**start, 10 ** (start + decades), *ends, logarithmic)
    ticks = axis.ticks(most)
    assert 1 <= len(ticks) <= most
    assert ticks == sorted(set(ticks))
    places = [axis.place(tick) for tick in ticks]
    assert all(min(ends) <= place <= max(ends) for place in places)
    assert all(axis.low * (1 - 1e-9) <= tick <= axis.high * (1 + 1e-9) for tick in ticks)


def test_a_logarithmic_axis_gives_ratios_the_same_length() -> None:
    axis = Axis(1, 10_000, 0, 400, logarithmic=True)
    assert [axis.place(value) for value in (1, 10, 100, 1000, 10_000)] == [0, 100, 200, 300, 400]
    assert axis.ticks(6) == [1, 10, 100, 1000, 10_000]


def test_an_even_axis_gives_differences_the_same_length() -> None:
    axis = Axis(41.5, 46.5, 500, 0, logarithmic=False)
    assert axis.place(44) == 250
    assert axis.ticks(6) == [42, 43, 44, 45, 46]


def test_what_lies_beyond_stands_at_the_end() -> None:
    axis = Axis(1, 10, 0, 100, logarithmic=True)
    assert axis.place(1000) == 100
    assert axis.place(0.001) == 0
    assert axis.place(-3) == 0


@pytest.mark.parametrize("value", [-3.0, 0.0, 5.0])
def test_a_range_without_length_gets_some(value: float) -> None:
    low, high = padded(value, value, 0.07, logarithmic=False)
    assert low < value < high


def test_padding_is_the_same_share_on_both_scales() -> None:
    low, high = padded(1, 100, 0.1, logarithmic=True)
    assert np.isclose(low * high, 100)
    assert np.isclose(high / 100, 100**0.1)
