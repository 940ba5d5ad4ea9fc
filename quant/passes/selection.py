"""The passes to apply: all of them, unless one is measured by leaving it out
(`benchmarks/ablation.py`).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Passes:
    """The passes that reduce the error of rounding, each of which can be left out to measure its
    gain.

    Attributes:
        long_skip: True takes the image out of the long skip connection of a distillation network.
        dual_range: True writes the result in several copies of different scales, which represent it
            more finely than one.
        least_squares: True chooses the scale of least squared error for each tensor, False the
            finest scale that clips nothing.
        equalization: True searches a factor for each channel. False uses one factor for all
            channels of a residual group, at which the widest fits int8.
    """

    long_skip: bool = True
    dual_range: bool = True
    least_squares: bool = True
    equalization: bool = True


ALL = Passes()
