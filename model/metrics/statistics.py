"""Estimate the uncertainty of a mean over images by a bootstrap over their sites, and the spread of
numbers with outliers.
"""

from collections.abc import Sequence

import numpy as np

from beers_deploy.profiles.errors import counted

DRAWS = 4000
LEVEL = 0.95
WORDS = "95 % bootstrap interval over sites"

LEAST_SITES = 5
"""No interval is shown for fewer sites: their bootstrap varies far less than other sites would."""


def site_interval(
    values: Sequence[float], sites: Sequence[str], generator: np.random.Generator
) -> tuple[tuple[float, float] | None, str]:
    """Compute the 95 % percentile interval of the mean of `values` by drawing whole sites with
    replacement.

    A site is the place that an image shows. Images of one site resemble one another, so that
    drawing single images would make the interval too narrow.

    Args:
        values: (N,) one figure per image.
        sites: (N,) the name of the site of each image.
        generator: the random generator for the draws.

    Returns:
        The interval and its description; or None and the reason, if there are fewer than five
        sites.
    """
    names, places = np.unique(sites, return_inverse=True)
    if len(names) < LEAST_SITES:
        return None, f"no interval: {counted(len(names), 'site')}, fewer than {LEAST_SITES}"
    sums = np.bincount(places, values)
    counts = np.bincount(places)
    draws = generator.integers(len(names), size=(DRAWS, len(names)))
    # The sums are divided by the counts, so that a site of many images counts for them.
    means = sums[draws].sum(1) / counts[draws].sum(1)
    return percentiles(means), WORDS


def percentiles(draws: np.ndarray) -> tuple[float, float]:
    """Return the two ends of the 95 % interval of a figure, computed from N bootstrap draws of it,
    (N,).
    """
    low, high = np.percentile(draws, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return float(low), float(high)


def too_few(sites: int) -> str:
    """Return a sentence that explains why no interval over `sites` sites is shown, or an empty
    string if there are enough sites.
    """
    if sites >= LEAST_SITES:
        return ""
    return (
        f"No interval over sites is shown: of {sites}, fewer than {LEAST_SITES}, none could "
        "be trusted."
    )


def robust_deviation(residuals: np.ndarray) -> float:
    """Return the standard deviation of numbers that are normal around 0, but for some outliers."""
    # The standard deviation of normal numbers is 1.4826 times their median absolute deviation.
    return 1.4826 * float(np.median(np.abs(residuals)))
