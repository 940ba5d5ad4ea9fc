"""Which passes are applied: all of them, unless one is measured by leaving it out
(`benchmarks/ablation.py`).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Passes:
    """What reduces the error of rounding, each by its name.

    Attributes:
        half_lsb_pair: the last sum of a residual stream is computed as a pair, half a unit apart.
        dual_range: the result is computed in two ranges or in windows, finer than its own.
        fitted_weights: weights are rounded so that layers' outputs stay near, not each to its
            nearest.
        least_squares: scales leave the least squared error; without, they clip nothing.
        full_range_relu: what a ReLU leaves is stored from -128 on.
        copies: dead channels hold copies of the largest ones.
        equalising: the ranges of channels are searched; without, the largest one fits and all share
            its factor.
    """

    half_lsb_pair: bool = True
    dual_range: bool = True
    fitted_weights: bool = True
    least_squares: bool = True
    full_range_relu: bool = True
    copies: bool = True
    equalising: bool = True


ALL = Passes()
