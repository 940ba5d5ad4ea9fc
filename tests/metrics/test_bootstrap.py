import numpy as np
import pytest

from model.metrics.bootstrap import LEAST_SITES, mean_interval, site_interval


def interval(values: list[float], sites: list[str]) -> tuple[float, float]:
    return mean_interval(values, sites, np.random.default_rng(0))


def test_it_covers_the_mean_as_often_as_it_says() -> None:
    generator, hits = np.random.default_rng(1), 0
    for _ in range(200):
        offsets = generator.normal(40, 3, 25)
        values = [offset + generator.normal(0, 0.2) for offset in offsets for _ in range(3)]
        low, high = interval(values, [f"s{k // 3}" for k in range(75)])
        hits += low <= 40 <= high
    assert 0.88 <= hits / 200 <= 0.99


def test_images_of_one_site_are_not_taken_for_many() -> None:
    """Ten copies of four figures tell no more than the four; drawn one by one they would seem to."""
    values = [level for level in (38.0, 41.0, 44.0, 47.0) for _ in range(10)]
    low, high = interval(values, [f"s{k // 10}" for k in range(40)])
    alone_low, alone_high = interval(values, [f"s{k}" for k in range(40)])
    assert high - low > 2 * (alone_high - alone_low)


def test_a_single_site_draws_its_images_and_a_single_image_has_no_width() -> None:
    low, high = interval([1.0, 2.0, 3.0], ["a"] * 3)
    assert 1 <= low < 2 < high <= 3
    assert interval([5.0], ["a"]) == (5, 5)


def test_the_same_seed_gives_the_same_interval() -> None:
    assert interval([1.0, 2.0, 4.0], list("abc")) == interval([1.0, 2.0, 4.0], list("abc"))
    assert interval([1.0, 2.0, 4.0], list("abc")) == pytest.approx((1, 4), abs=0.7)


@pytest.mark.parametrize("count", [1, 2, LEAST_SITES - 1, LEAST_SITES, 9])
def test_below_five_sites_there_is_no_interval_and_it_is_said(count: int) -> None:
    values, sites = list(np.linspace(40, 44, 3 * count)), [f"s{k % count}" for k in range(3 * count)]
    found, words = site_interval(values, sites, np.random.default_rng(0))
    if count < LEAST_SITES:
        assert found is None
        assert "no interval" in words
        assert f"{count} site" in words
    else:
        assert found == interval(values, sites)
        assert "no interval" not in words
