"""Estimate the spread of numbers of which some are outliers."""

import numpy as np


def robust_deviation(residuals: np.ndarray) -> float:
    """Return the standard deviation of numbers that are normal around 0, but for some outliers."""
    # The standard deviation of normal numbers is 1.4826 times their median absolute deviation.
    return 1.4826 * float(np.median(np.abs(residuals)))
