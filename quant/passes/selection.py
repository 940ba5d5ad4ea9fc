"""The passes to apply: all of them, unless one is measured by leaving it out
(`benchmarks/ablation.py`).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Passes:
    """The passes that reduce the error of rounding, by name.

    Attributes:
        dual_range: the result is computed in two ranges or in windows, finer than its own.
        least_squares: scales leave the least squared error; without, they clip nothing.
        equalization: the ranges of channels are searched; without, the largest one fits and all
            share its factor.
    """

    dual_range: bool = True
    least_squares: bool = True
    equalization: bool = True


ALL = Passes()
