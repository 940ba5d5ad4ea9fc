"""The published settings of NL-Bayes, and the named trades between quality and time.

The numbers hold for grey levels of 0 to 255 (Lebrun, Buades, Morel, IPOL 2013, section on the parameters).
"""

from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T", int, float)

ALIKE_RMS = 4.0
"""Pass 2 takes every patch within this RMS distance, in grey levels (tau = 16 k^2)."""

FLAT_GAMMA = 1.05
"""A group of pass 1 whose variance stays below gamma sigma^2 holds nothing but noise (homogeneous area criterion)."""


@dataclass(frozen=True)
class Quality:
    """How dense the references are, and how large a group of pass 2 may grow.

    `stride_px` lies between neighbouring references; `group_cap` counts in multiples of the usual group. The
    published method has no cap, and visits every second pixel unless an earlier group held it.
    """

    stride_px: int
    group_cap: int


QUALITIES = {"fast": Quality(4, 2), "standard": Quality(3, 4), "best": Quality(2, 8)}


@dataclass(frozen=True)
class PassSettings:
    """What one pass works with; sigma and distances in grey levels.

    Attributes:
        side_px: k, the side of a patch.
        similar: N, the patches of a group.
        most_similar: the largest group, where more than N patches lie within `alike_rms`.
        alike_rms: RMS distance below which a patch always counts as similar.
        flat_gamma: see FLAT_GAMMA; 0 switches the rule off.
        excess: beta, the factor on the noise variance.
        clean_guide: whether the guide's covariance is that of the signal alone, noise removed.
    """

    side_px: int
    similar: int
    most_similar: int
    alike_rms: float
    flat_gamma: float
    excess: float
    clean_guide: bool

    @property
    def window_px(self) -> int:
        """Candidates along each axis of the search window: about N / 2, odd so that it has a middle."""
        return self.similar // 2 | 1

    @property
    def margin_px(self) -> int:
        """What a reference centred on a border pixel sees beyond it."""
        return self.window_px // 2 + self.side_px // 2


def first_pass(sigma: float) -> PassSettings:
    """Pass 1: the noisy image is its own guide."""
    side_px = 5 if sigma < 30 else 7
    similar = _below(sigma, {10: 35, 30: 45, 80: 90}, 100)
    excess = _below(sigma, {15: 1.1, 70: 1.0}, 0.9)
    return PassSettings(side_px, similar, similar, 0.0, FLAT_GAMMA, excess, clean_guide=False)


def second_pass(sigma: float, quality: Quality) -> PassSettings:
    """Pass 2: the result of pass 1 is the guide."""
    similar = _below(sigma, {20: 15, 40: 25, 80: 30}, 45)
    excess = _below(sigma, {15: 1.1, 35: 1.0}, 0.9)
    return PassSettings(5, similar, quality.group_cap * similar, ALIKE_RMS, 0.0, excess, clean_guide=True)


def _below(sigma: float, table: dict[int, T], otherwise: T) -> T:
    """The value of the first bound that sigma stays below."""
    return next((value for bound, value in table.items() if sigma < bound), otherwise)
