import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from deploy.export import to_onnx
from deploy.restoration.arrays import restore_image
from deploy.restoration.plan import even_side_px, plan_side, plan_tiles
from model.convbeers import ConvBEERS, Variant, initialise
from profiles.errors import OptionError
from quant.session import open_session

RADIUS_PX = 5


@pytest.fixture(scope="module")
def model() -> onnx.ModelProto:
    network = ConvBEERS(Variant(blocks=1, features=8))
    initialise(network, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for value in network.parameters():
            value.mul_(2.0)
    return to_onnx(network, {})


@given(st.integers(1, 90), st.integers(1, 90), st.integers(13, 40), st.integers(0, 6))
def test_kept_parts_cover_every_pixel_once(height: int, width: int, tile_px: int, halo_px: int) -> None:
    seen = np.zeros((height, width), int)
    for tile in plan_tiles(height, width, tile_px, halo_px):
        window = tile.read(seen)
        assert window.shape == (min(tile_px, height), min(tile_px, width))
        tile.write(window + 1, seen)
    assert (seen == 1).all()


@given(st.integers(1, 200), st.integers(13, 60), st.integers(0, 6))
def test_every_kept_pixel_has_its_halo_or_touches_the_border(size: int, tile_px: int, halo_px: int) -> None:
    for tile in plan_tiles(size, size, tile_px, halo_px):
        for span in (tile.rows, tile.columns):
            assert span.start == 0 or span.keep_start - span.start >= halo_px
            assert span.stop == size or span.stop - span.keep_stop >= halo_px


@given(st.integers(1, 2000), st.integers(13, 200), st.integers(0, 6))
def test_an_even_side_needs_as_many_tiles_and_none_shorter_does(size: int, tile_px: int, halo_px: int) -> None:
    side, count = even_side_px(size, tile_px, halo_px), len(plan_side(size, tile_px, halo_px))
    assert side <= tile_px
    assert len(plan_side(size, side, halo_px)) == count
    if side > 2 * halo_px + 1 and count > 1:
        assert len(plan_side(size, side - 1, halo_px)) > count


def test_a_tile_without_room_between_its_halos_is_refused() -> None:
    with pytest.raises(OptionError, match="halo of 20"):
        plan_tiles(100, 100, 40, 20)


@pytest.mark.parametrize(("height", "width"), [(61, 83), (17, 130), (1, 40), (40, 1), (29, 29)])
def test_tiled_equals_whole_bit_for_bit(model: onnx.ModelProto, height: int, width: int) -> None:
    session = open_session(model)
    dn = np.random.default_rng(1).integers(0, 4096, (height, width)).astype(np.float32)
    whole = restore_image(dn, session, tile_px=256, halo_px=RADIUS_PX)
    np.testing.assert_array_equal(restore_image(dn, session, tile_px=23, halo_px=RADIUS_PX), whole)


def test_a_smaller_halo_shows_seams(model: onnx.ModelProto) -> None:
    session = open_session(model)
    dn = np.random.default_rng(1).integers(0, 4096, (61, 83)).astype(np.float32)
    whole = restore_image(dn, session, tile_px=256, halo_px=RADIUS_PX)
    assert (restore_image(dn, session, tile_px=23, halo_px=RADIUS_PX - 3) != whole).any()
