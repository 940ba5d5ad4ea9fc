"""Decide which effects a scene needs, with a proof and a reason, before any pixel is computed.

Each effect is applied, or skipped because

1. not called for: neither sensor nor scene has its table, or it is excluded; 2. neutral: its
parameters change nothing; 3. cannot show: a bound proves that no pixel of this scene changes by
more than the tolerance.

All effects skipped for the third reason together stay within the tolerance: their bounds are added,
the smallest first.
"""

import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy import fft

from beers_deploy.model.simulator.detector import NOISE_LIMIT
from beers_deploy.model.simulator.mtf import Blur, smear_response, transfer_function
from beers_deploy.profiles.effects import TABLES, PixelEffect, pixel_effects
from beers_deploy.profiles.instrument import Instrument, mtf_limit


@dataclass(frozen=True)
class SceneStats:
    """Statistics of a scene; radiances are in W/m2/sr/um on the scene's own grid."""

    low: float
    high: float
    # The largest difference between neighbours in a column, the periodic border included.
    step_along: float
    height: int
    width: int
    oversampling: int


def scene_stats(radiance: np.ndarray, oversampling: int) -> SceneStats:
    """Compute the statistics of a scene's radiance (H, W) in one pass over it."""
    low = float(radiance.min())
    high = float(radiance.max())
    step = max(
        float(np.abs(radiance[1:] - radiance[:-1]).max()),
        float(np.abs(radiance[0] - radiance[-1]).max()),
    )
    height, width = radiance.shape
    return SceneStats(low, high, step, height, width, oversampling)


def ringing_of(sensor: Instrument, stats: SceneStats) -> float:
    """Compute the sum of the absolute values of the blur's kernel on the scene's grid: 1 without
    ringing.

    A blurrier sensor is a sharper one followed by a positive kernel of sum 1, which cannot increase
    the sum. The MTF is therefore rounded up to the next integer percent, so that sensors share
    results. That does not hold for two axes rounded separately, nor for a table or a point-spread
    function, which are used unrounded.
    """
    across, along = sensor.mtf_axes
    blur: Blur = sensor.blur
    if sensor.response is None and across == along:
        blur = max(min(math.ceil(across * 100) / 100, mtf_limit(sensor.antialias_px)), across)
    return _kernel_sum(stats.height, stats.width, stats.oversampling, blur, sensor.antialias_px)


@lru_cache(maxsize=256)
def _kernel_sum(height: int, width: int, oversampling: int, blur: Blur, sigma_px: float) -> float:
    transfer = transfer_function(height, width, oversampling, blur, sigma_px).astype(np.complex128)
    return float(np.abs(fft.irfft2(transfer, s=(height, width))).sum())


@lru_cache(maxsize=256)
def smear_moments(height: int, oversampling: int, length_px: float) -> tuple[float, float]:
    """Compute two moments of the smear's kernel minus a unit pulse.

    Returns:
        Half of its absolute sum, and its absolute first moment in pixels.
    """
    fy = np.fft.fftfreq(height, 1 / oversampling)
    kernel = np.fft.ifft(smear_response(fy, length_px)).real
    kernel[0] -= 1
    distance = np.minimum(np.arange(height), height - np.arange(height))
    return float(np.abs(kernel).sum()) / 2, float((np.abs(kernel) * distance).sum())


def behind(name: str, change_dn: float, sensor: Instrument) -> float:
    """Bound the change of a pixel by one effect, after all later effects have acted on it too.

    Blooming adds its share, PRNU its largest gain, and noise changes with the signal: |sqrt(a) -
    sqrt(b)| <= min(sqrt|a - b|, |a - b| / (2 sqrt(beta))).

    Args:
        name: the name of the effect.
        change_dn: the largest change by the effect itself.
        sensor: the instrument.

    Returns:
        The bound in DN.
    """
    gain = sensor.gain_dn_per_radiance
    change = change_dn
    for later in ORDER[ORDER.index(name) + 1 :]:
        effect = sensor.effects.get(later)
        if isinstance(effect, PixelEffect):
            change *= effect.growth
        if later == "noise" and change > 0:
            variance = sensor.alpha * change / gain
            slope = variance / (2 * math.sqrt(sensor.beta)) if sensor.beta > 0 else math.inf
            change += gain * NOISE_LIMIT * min(math.sqrt(variance), slope)
    return change


TOLERANCE_DN = 0.25
"""The tolerance before digitising: a quarter of a digital number is below the converter's own
rounding.
"""

Choice = Literal["applied", "not called for", "neutral", "cannot show"]

PIXEL_EFFECTS = {name: kind for name, kind in TABLES.items() if issubclass(kind, PixelEffect)}


def costs(acts_on: str) -> dict[str, str]:
    """Return what each effect costs in computing time, in words, by the name of the effect.

    Args:
        acts_on: the quantity that the effects change, "radiance" or "DN".
    """
    return {name: kind.cost for name, kind in PIXEL_EFFECTS.items() if kind.acts_on == acts_on}


COSTS = {
    "mtf": "2 transforms of the scene",
    **{name: kind.cost for name, kind in TABLES.items() if name not in PIXEL_EFFECTS},
    "sampling": "folding of the spectrum",
    **costs("radiance"),
    "noise": "1 draw a pixel",
    **costs("DN"),
    "digitising": "1 pass",
}
ORDER = tuple(COSTS)
"""The effects in the order in which the light meets them."""

UNSEEN = {"mtf": "the scene is constant"} | {
    name: kind.unseen for name, kind in PIXEL_EFFECTS.items()
}
"""The reason why an effect cannot show if its bound is zero because of the scene."""


@dataclass(frozen=True)
class Decision:
    """The decision whether the simulation of a scene needs one effect.

    Attributes:
        effect: the name of the effect.
        choice: applied, or the kind of reason for which it is skipped.
        why: the reason in words.
        bound_dn: the largest change of any pixel by the effect, in DN; None if no bound is known.
        cost: what the effect costs in computing time, in words.
    """

    effect: str
    choice: Choice
    why: str
    bound_dn: float | None
    cost: str


@dataclass(frozen=True)
class Plan:
    """The decisions about all effects of one acquisition, in the order in which light passes them.

    Attributes:
        decisions: a decision for each effect.
        tolerance_dn: the largest change, in DN, by all effects that are skipped as negligible.
    """

    decisions: tuple[Decision, ...]
    tolerance_dn: float

    @property
    def skipped(self) -> frozenset[str]:
        """The effects that are not applied."""
        return frozenset(d.effect for d in self.decisions if d.choice != "applied")

    def to_json(self) -> dict[str, object]:
        """Return the plan as a dataset's manifest stores it."""
        return {"tolerance_dn": self.tolerance_dn, "decisions": [asdict(d) for d in self.decisions]}


def make_plan(sensor: Instrument, stats: SceneStats, tolerance_dn: float = TOLERANCE_DN) -> Plan:
    """Decide about every effect of a sensor for a scene with these statistics.

    Args:
        sensor: the instrument.
        stats: the statistics of the scene.
        tolerance_dn: the largest change by all effects that are skipped as negligible.
    """
    bounds = effect_bounds(sensor, stats)
    spent = 0.0
    negligible = set()
    # Smallest first, so that as many effects as the tolerance allows are skipped.
    for name, change in sorted(bounds.items(), key=lambda item: item[1]):
        if change > 0 and spent + change <= tolerance_dn:
            spent += change
            negligible.add(name)
    decisions = []
    for name, cost in COSTS.items():
        choice, why, bound = _decide(name, sensor, bounds, negligible, tolerance_dn)
        decisions.append(
            Decision(name, choice, why, bound, cost if choice == "applied" else "none")
        )
    return Plan(tuple(decisions), tolerance_dn)


def effect_bounds(sensor: Instrument, stats: SceneStats) -> dict[str, float]:
    """Bound the change of any pixel by each effect that can be skipped, in DN, including later
    effects.
    """
    gain = sensor.gain_dn_per_radiance
    ringing = ringing_of(sensor, stats)
    # A blur whose kernel sums to 1, in absolute values to `ringing`: |k * (L - m)| <= ringing *
    # span / 2.
    span = stats.high - stats.low
    middle = (stats.low + stats.high) / 2
    reach = ringing * span / 2
    low = middle - reach
    high = middle + reach
    total = ringing
    bounds = dict[str, float]()

    def add(name: str, direct_dn: float) -> None:
        nonlocal low, high
        bounds[name] = behind(name, direct_dn, sensor)
        # Later effects may meet this range, whether the effect is applied or left out.
        low -= direct_dn / gain
        high += direct_dn / gain

    if "smear" in sensor.effects:
        # The kernel of the smear minus a pulse sums to 0. Its effect is at most half its size times
        # the span, or steps times moment. The blur behind it multiplies that by its ringing.
        size, moment = smear_moments(stats.height, stats.oversampling, sensor.smear_px)
        add("smear", gain * ringing * min(size * span, moment * stats.step_along))
        # Its kernel is a unit pulse plus the difference from it.
        total *= 1 + 2 * size
    # The blurred pixel and the plain mean of its scene pixels lie in one range: they differ by its
    # width at most.
    bounds["mtf"] = behind("mtf", gain * (1 + total) / 2 * span, sensor)
    for name, effect in pixel_effects(sensor.effects, "radiance").items():
        add(name, effect.bound_dn(sensor, low, high))
    add("noise", gain * NOISE_LIMIT * sensor.noise_sigma(max(high, 0.0)))
    for name, effect in pixel_effects(sensor.effects, "DN").items():
        add(name, effect.bound_dn(sensor, low, high))
    return bounds


def _decide(
    name: str,
    sensor: Instrument,
    bounds: dict[str, float],
    negligible: set[str],
    tolerance_dn: float,
) -> tuple[Choice, str, float | None]:
    """Return the decision about an effect, its reason, and its bound."""
    if name in ("sampling", "digitising"):
        return "applied", "every sensor has it", None
    if name in TABLES and name not in sensor.effects:
        return "not called for", "nothing asks for it", None
    if name in ("antialias", "smear") and ("mtf" in negligible or bounds["mtf"] == 0):
        return "cannot show", "the scene is too flat for any blur to show", bounds["mtf"]
    if name == "antialias":
        return "applied", "part of the MTF, and of its budget", None
    bound = bounds[name]
    if bound == 0:
        why = UNSEEN.get(name)
        return "cannot show" if why else "neutral", why or "its parameters change nothing", 0.0
    if name in negligible:
        return (
            "cannot show",
            f"no pixel changes by more than the {tolerance_dn:g} DN allowed",
            bound,
        )
    return "applied", "it may change a pixel by up to the bound", bound
