"""How far a mean over images can be trusted: a bootstrap over the sites that they come from."""

from collections.abc import Sequence

import numpy as np

DRAWS = 4000
LEVEL = 0.95
WORDS = "95 % bootstrap interval over sites"

LEAST_SITES = 5
"""Of fewer sites no interval is shown: drawn with replacement, they vary far less than others of
their kind would.
"""


def site_interval(
    values: Sequence[float], sites: Sequence[str], generator: np.random.Generator
) -> tuple[tuple[float, float] | None, str]:
    """Percentile interval (95 %) of the mean of `values`, whole sites drawn with replacement: the
    one rule of all.

    Images of one site resemble one another: drawn one by one, they would promise too much.

    Args:
        values: (N,) a figure an image.
        sites: (N,) the site of each.
        generator: of the draws.

    Returns:
        The interval and what it is in words; None, and the reason, below five sites.
    """
    count = len(set(sites))
    if count < LEAST_SITES:
        return (
            None,
            f"no interval: {count} site{'s' if count > 1 else ''}, fewer than {LEAST_SITES}",
        )
    numbers = np.asarray(values, np.float64)
    names = np.asarray(sites)
    groups = [numbers[names == name] for name in np.unique(names)]
    sums, counts = (np.array([f(group) for group in groups]) for f in (np.sum, np.size))
    draws = generator.integers(len(groups), size=(DRAWS, len(groups)))
    # Sums over counts and not a mean of means: a site of many images counts for them.
    means = sums[draws].sum(1) / counts[draws].sum(1)
    return percentiles(means), WORDS


def percentiles(draws: np.ndarray) -> tuple[float, float]:
    """The interval (95 %) of a figure: between percentiles of its draws (N,)."""
    low, high = np.percentile(draws, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return float(low), float(high)


def too_few(sites: int) -> str:
    """A sentence on why no interval over so many sites is shown; empty where one is."""
    if sites >= LEAST_SITES:
        return ""
    return (
        f"No interval over sites is shown: of {sites}, fewer than {LEAST_SITES}, none could "
        "be trusted."
    )
