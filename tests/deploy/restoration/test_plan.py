from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.plan import even_side_px, make_plan, plan_side


@given(st.integers(1, 90), st.integers(1, 90), st.integers(13, 40), st.integers(0, 6))
def test_kept_parts_cover_every_pixel_once(
    height: int, width: int, tile_px: int, halo_px: int
) -> None:
    plan = make_plan((1, height, width), tile_px, halo_px, Tiling(halo_px))
    for size, spans in ((height, plan.rows), (width, plan.columns)):
        places = chain.from_iterable(range(span.keep_start, span.keep_stop) for span in spans)
        assert list(places) == list(range(size))
        assert {span.stop - span.start for span in spans} == {spans[0].stop}, "all of one size"
        assert spans[0].stop <= min(tile_px, size)


@given(st.integers(1, 200), st.integers(13, 60), st.integers(0, 6))
def test_every_kept_pixel_has_its_halo_or_touches_the_border(
    size: int, tile_px: int, halo_px: int
) -> None:
    for side_px in (tile_px, even_side_px(size, tile_px, halo_px)):
        for span in plan_side(size, side_px, halo_px):
            assert span.start == 0 or span.keep_start - span.start >= halo_px
            assert span.stop == size or span.stop - span.keep_stop >= halo_px


@given(st.integers(1, 2000), st.integers(13, 200), st.integers(0, 6))
def test_an_even_side_needs_as_many_tiles_and_none_shorter_does(
    size: int, tile_px: int, halo_px: int
) -> None:
    side = even_side_px(size, tile_px, halo_px)
    count = len(plan_side(size, tile_px, halo_px))
    assert side <= tile_px
    assert len(plan_side(size, side, halo_px)) == count
    if side > 2 * halo_px + 1 and count > 1:
        assert len(plan_side(size, side - 1, halo_px)) > count


def test_a_span_reads_as_many_pixels_as_a_network_needs() -> None:
    assert [
        (span.start, span.stop, span.keep_stop) for span in plan_side(1, 20, 4, 2, min_side_px=5)
    ] == [(0, 6, 1)]


def test_a_tile_without_room_between_its_halos_is_refused() -> None:
    with pytest.raises(OptionError, match="halo of 20"):
        plan_side(100, 40, 20)
    with pytest.raises(OptionError, match="at least 34 px, got 20 px"):
        plan_side(100, 20, 4, 2, min_side_px=33)


def test_tiles_are_no_shorter_than_the_border_that_a_network_mirrors() -> None:
    """One tile of a small image may be short, and so may the even tiles of a larger one."""
    plan = make_plan((1, 9, 40), 30, 5, Tiling(5, min_side_px=17))
    sides = {span.stop - span.start for span in (*plan.rows, *plan.columns)}
    assert min(sides) >= 17
