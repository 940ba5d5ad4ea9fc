"""The price of seams: measured where an image is cut, weighed by how many seams a swath has."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.bench.tables import Swath
from deploy.restoration.engine import restore_dn
from deploy.restoration.plan import make_plan
from deploy.tradeoff.accuracy import Scores, cut_in_four, halves, seam_density, with_seams
from model.evaluation.scores import fidelity_db
from quant.session import open_session, run
from quant.tiling.walk import Tiling, tiling_of
from tests.quant.tiling.small_networks import half_resolution

RADIUS_PX = 2


def blur(image: np.ndarray) -> np.ndarray:
    """A mean over 5 x 5 with zeros beyond the border, (1, 1, h, w): a network that sees 2 pixels far."""
    padded = np.pad(image, ((0, 0), (0, 0), (RADIUS_PX, RADIUS_PX), (RADIUS_PX, RADIUS_PX)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(2, 3))
    return np.asarray(windows.mean(axis=(-1, -2)), np.float32)


def image(side: tuple[int, int] = (37, 50)) -> np.ndarray:
    return np.random.default_rng(0).integers(500, 3000, side).astype(np.float32)


def test_with_the_whole_radius_the_cut_does_not_show_and_with_less_it_does() -> None:
    dn = image()
    whole = np.rint(4095 * blur(dn[None, None] / np.float32(4095))[0, 0])
    assert np.array_equal(cut_in_four(blur, RADIUS_PX)(dn), whole)
    off = cut_in_four(blur, 0)(dn) != whole
    rows, columns = np.nonzero(off)
    assert off.any()
    assert np.all(
        (abs(rows - 17.5) <= RADIUS_PX) | (abs(columns - 24.5) <= RADIUS_PX)
    )  # cut before row 18, column 25


def test_a_network_at_half_resolution_is_cut_on_its_lattice() -> None:
    """At odd sizes too: with the whole radius nothing shows, with less it does."""
    model = half_resolution()
    infer, tiling = partial(run, open_session(model)), tiling_of(model)
    dn = image((83, 70))
    whole = restore_dn(dn, infer, make_plan((1, *dn.shape), 500, tiling.halo_px, tiling))
    np.testing.assert_array_equal(cut_in_four(infer, tiling.halo_px, lattice_px=2)(dn), whole)
    assert (cut_in_four(infer, 0, lattice_px=2)(dn) != whole).any()


@given(st.integers(2, 99), st.integers(0, 24), st.sampled_from([1, 2, 4, 8]))
def test_halves_begin_on_the_lattice_and_read_to_its_end(size_px: int, halo: int, lattice_px: int) -> None:
    spans = halves(size_px, halo * lattice_px, lattice_px)
    assert [p for span in spans for p in range(span.keep_start, span.keep_stop)] == list(range(size_px))
    for span in spans:
        assert span.start % lattice_px == span.stop % lattice_px == 0
        assert span.start <= span.keep_start <= span.keep_stop <= span.stop < size_px + lattice_px


@given(st.integers(2, 99), st.integers(0, 99))
def test_halves_keep_every_pixel_once(size_px: int, halo_px: int) -> None:
    spans = halves(size_px, halo_px)
    assert [p for span in spans for p in range(span.keep_start, span.keep_stop)] == list(range(size_px))
    for span in spans:
        assert 0 <= span.start <= span.keep_start <= span.keep_stop <= span.stop <= size_px


def test_a_swath_in_smaller_tiles_has_more_seams_and_in_one_tile_none() -> None:
    densities = [seam_density(Swath(2000, 1000, tile_px, 8)) for tile_px in (2000, 640, 256, 128)]
    assert densities[0] == 0
    assert densities == sorted(densities)
    assert seam_density(Swath(200, 100, 100, 0)) == 1 / 200


@given(st.floats(0, 3))
def test_weighing_is_exact_for_errors_that_lie_at_seams(share: float) -> None:
    """Twice the seams, twice what they add to the mean squared error."""
    shape = (40, 80)
    exact, cut = 45.0, 42.0
    density = share * (1 / 40 + 1 / 80)
    before, after = (Scores(({"PSNR": p, "SSIM": s},)) for p, s in ((exact, 0.99), (cut, 0.97)))
    found = with_seams(before, after, [shape], density)
    error, more = (10 ** (-psnr / 10) for psnr in (exact, cut))
    assert found.images[0]["PSNR"] == pytest.approx(-10 * np.log10(error + share * (more - error)))
    assert found.images[0]["SSIM"] == pytest.approx(0.99 - share * 0.02)


def test_no_seams_cost_nothing_and_a_missing_score_stays_missing() -> None:
    exact, cut = Scores(({"PSNR": 45.0, "LPIPS": None},)), Scores(({"PSNR": 40.0, "LPIPS": None},))
    found = with_seams(exact, cut, [(30, 30)], 0.0)
    assert found.images[0]["PSNR"] == pytest.approx(45)
    assert found.images[0]["LPIPS"] is None


def test_predicted_from_a_cut_is_what_a_swath_of_tiles_really_shows() -> None:
    """On one large image, cut in four and in tiles: the prediction meets the measurement."""
    dn = image((300, 300))
    reference = dn.copy()
    exact, cut, tiled = (
        fidelity_db(restored, reference, dn)
        for restored in (cut_in_four(blur, RADIUS_PX)(dn), cut_in_four(blur, 0)(dn), in_tiles(dn, 60))
    )
    density = seam_density(Swath(300, 300, 60, 0))
    found = with_seams(Scores(({"PSNR": exact},)), Scores(({"PSNR": cut},)), [dn.shape], density)
    assert exact - tiled > 0.02
    assert found.images[0]["PSNR"] == pytest.approx(tiled, abs=0.2 * (exact - tiled))


def in_tiles(dn: np.ndarray, tile_px: int) -> np.ndarray:
    return restore_dn(dn, blur, make_plan((1, *dn.shape), tile_px, 0, Tiling(0)))
