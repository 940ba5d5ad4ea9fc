import pytest

from deploy.bench.tables import Swath
from profiles.errors import OptionError


def test_the_paper_counts_fractions() -> None:
    frames = Swath(13600, 9016).frames
    assert frames == pytest.approx(299.36, abs=0.01)
    assert frames / 7.2 == pytest.approx(42, abs=0.5)


@pytest.mark.parametrize(
    ("halo_px", "tiles"),
    [(0, 330), (11, 330), (12, 345), (20, 345), (21, 368), (25, 368), (26, 384), (35, 384), (38, 384)],
)
def test_whole_tiles_of_the_published_swath(halo_px: int, tiles: int) -> None:
    assert Swath(13600, 9016, 640, halo_px).tiles == tiles


@pytest.mark.parametrize(("size_px", "halo_px"), [(641, 0), (1000, 7), (13, 3), (9016, 35), (640, 100)])
def test_one_side_is_the_formula(size_px: int, halo_px: int) -> None:
    formula = max(1, -(-(size_px - 2 * halo_px) // (640 - 2 * halo_px)))
    assert Swath(size_px, size_px, 640, halo_px).tiles == formula**2


def test_a_halo_that_leaves_nothing_is_refused() -> None:
    with pytest.raises(OptionError, match="--tile"):
        _ = Swath(1000, 1000, 64, 32).tiles
