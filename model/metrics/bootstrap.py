"""How far a mean over images can be trusted: a bootstrap over the sites that they come from."""

from collections.abc import Sequence

import numpy as np

DRAWS, LEVEL = 4000, 0.95

LEAST_SITES = 5
"""Of fewer sites no interval is shown: drawn with replacement, they vary far less than others of their kind would."""


def site_interval(
    values: Sequence[float], sites: Sequence[str], generator: np.random.Generator
) -> tuple[tuple[float, float] | None, str]:
    """The interval of `mean_interval` and what it is in words; None, and the reason, below five sites."""
    count = len(set(sites))
    if count < LEAST_SITES:
        return None, f"no interval: {count} site{'s' if count > 1 else ''}, fewer than {LEAST_SITES}"
    return mean_interval(values, sites, generator), "95 % bootstrap interval over sites"


def mean_interval(
    values: Sequence[float], sites: Sequence[str], generator: np.random.Generator
) -> tuple[float, float]:
    """Percentile interval (95 %) of the mean of `values`, whole sites drawn with replacement.

    Images of one site resemble one another: drawn one by one, they would promise too much. With a single site the
    images are drawn. One image alone gives the interval of no width that its value is.

    Args:
        values: (N,) a figure an image.
        sites: (N,) the site of each.
        generator: of the draws.
    """
    numbers = np.asarray(values, np.float64)
    names = np.asarray(sites) if len(set(sites)) > 1 else np.arange(len(numbers))
    groups = [numbers[names == name] for name in np.unique(names)]
    sums, counts = (np.array([f(group) for group in groups]) for f in (np.sum, np.size))
    drawn = generator.integers(len(groups), size=(DRAWS, len(groups)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.percentile(means, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return float(low), float(high)
