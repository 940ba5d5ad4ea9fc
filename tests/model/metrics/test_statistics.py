import numpy as np

from beers_deploy.model.metrics.statistics import LEAST_SITES, site_interval


def interval(values: list[float], sites: list[str]) -> tuple[float, float]:
    bounds, _ = site_interval(values, sites, np.random.default_rng(0))
    assert bounds is not None
    return bounds


def test_the_interval_covers_the_mean_at_its_nominal_rate() -> None:
    generator = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        offsets = generator.normal(40, 3, 25)
        values = [offset + generator.normal(0, 0.2) for offset in np.repeat(offsets, 3).tolist()]
        low, high = interval(values, [f"s{k // 3}" for k in range(75)])
        hits += low <= 40 <= high
    assert 0.88 <= hits / 200 <= 0.99


def test_images_of_one_site_are_not_taken_for_many() -> None:
    """Ten copies of five values hold no more information than the five values."""
    values = np.repeat((38.0, 41.0, 44.0, 47.0, 50.0), 10).tolist()
    low, high = interval(values, [f"s{k // 10}" for k in range(50)])
    alone_low, alone_high = interval(values, [f"s{k}" for k in range(50)])
    assert high - low > 2 * (alone_high - alone_low)


def test_below_five_sites_there_is_no_interval_and_the_text_says_so() -> None:
    for count in range(1, LEAST_SITES + 2):
        values = np.linspace(40, 44, 3 * count).tolist()
        sites = [f"s{k % count}" for k in range(3 * count)]
        bounds, words = site_interval(values, sites, np.random.default_rng(0))
        assert (bounds is None) == ("no interval" in words) == (count < LEAST_SITES)
