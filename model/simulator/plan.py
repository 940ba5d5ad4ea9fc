"""Which effects a scene calls for: decided, proven and explained before a pixel is made.

Each effect is applied, or skipped because

1. not called for: neither sensor nor scene has its table, or it is left out;
2. neutral: its parameters change nothing;
3. this scene cannot show it: a bound proves that no pixel changes by more than the tolerance.

What is skipped for the third reason stays within the tolerance all together: bounds are added up,
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
    """What a scene can show, radiances in W/m2/sr/um on the scene's own grid."""

    low: float
    high: float
    # The largest difference between neighbours in a column, the periodic border included.
    step_along: float
    height: int
    width: int
    oversampling: int


def scene_stats(radiance: np.ndarray, oversampling: int) -> SceneStats:
    """Statistics of a scene's radiance (H, W), in one pass over it."""
    low = float(radiance.min())
    high = float(radiance.max())
    step = max(
        float(np.abs(radiance[1:] - radiance[:-1]).max()),
        float(np.abs(radiance[0] - radiance[-1]).max()),
    )
    height, width = radiance.shape
    return SceneStats(low, high, step, height, width, oversampling)


def ringing_of(sensor: Instrument, stats: SceneStats) -> float:
    """Sum of the absolute values of the blur's kernel on the scene's grid: 1 without ringing.

    A blurrier sensor is a sharper one followed by a positive kernel of sum 1, which cannot enlarge
    the sum: so the MTF is rounded up to the next whole percent, and sensors share what was computed
    once. Of two axes rounded each by itself that would not hold, nor of a table or a point-spread
    function: they are taken as they are.
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
    """Of the smear's kernel less a unit pulse: half its absolute sum, and its absolute first moment
    in pixels.
    """
    fy = np.fft.fftfreq(height, 1 / oversampling)
    kernel = np.fft.ifft(smear_response(fy, length_px)).real
    kernel[0] -= 1
    distance = np.minimum(np.arange(height), height - np.arange(height))
    return float(np.abs(kernel).sum()) / 2, float((np.abs(kernel) * distance).sum())


def behind(name: str, change_dn: float, sensor: Instrument) -> float:
    """What a change of the signal by the effect `name` may become through those that come after it.

    Spilling adds its share, PRNU its largest gain, and noise changes with the signal under it:
    |sqrt(a) - sqrt(b)| <= min(sqrt|a - b|, |a - b| / (2 sqrt(beta))).
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
"""Before digitising; a quarter of a digital number is below the converter's own rounding."""

Choice = Literal["applied", "not called for", "neutral", "cannot show"]

PIXEL_EFFECTS = {name: kind for name, kind in TABLES.items() if issubclass(kind, PixelEffect)}


def costs(acts_on: str) -> dict[str, str]:
    """Of the effects on radiance, or on DN."""
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
"""That of the light."""

UNSEEN = {"mtf": "the scene is constant"} | {
    name: kind.unseen for name, kind in PIXEL_EFFECTS.items()
}
"""Why an effect whose bound is zero cannot show, where that is the scene's doing."""


@dataclass(frozen=True)
class Decision:
    """What becomes of one effect, and why."""

    effect: str
    choice: Choice
    why: str
    # None where it is applied without asking, or not there to be bounded.
    bound_dn: float | None
    cost: str


@dataclass(frozen=True)
class Plan:
    """The decisions of one acquisition, in the order of the light."""

    decisions: tuple[Decision, ...]
    tolerance_dn: float

    @property
    def skipped(self) -> frozenset[str]:
        """The effects that are left out."""
        return frozenset(d.effect for d in self.decisions if d.choice != "applied")

    def to_json(self) -> dict[str, object]:
        """The plan as a dataset's manifest keeps it."""
        return {"tolerance_dn": self.tolerance_dn, "decisions": [asdict(d) for d in self.decisions]}


def make_plan(sensor: Instrument, stats: SceneStats, tolerance_dn: float = TOLERANCE_DN) -> Plan:
    """Decide for every effect of a sensor on a scene of these statistics."""
    bounds = effect_bounds(sensor, stats)
    spent = 0.0
    negligible = set()
    # Smallest first: as many effects as the tolerance can pay for are left out.
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
    """Largest change of any pixel by each effect that can be left out, in DN, through all that
    comes after it.
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
    bounds = {}
    if "smear" in sensor.effects:
        # The smear's kernel less a pulse sums to 0: it sees at most half its size times the span,
        # or steps times moment; the blur behind it enlarges that by its ringing.
        size, moment = smear_moments(stats.height, stats.oversampling, sensor.smear_px)
        direct = gain * ringing * min(size * span, moment * stats.step_along)
        bounds["smear"] = behind("smear", direct, sensor)
        # The smear widens the range that every later effect may meet, whether it is applied or left
        # out.
        low = low - direct / gain
        high = high + direct / gain
        # Its kernel is a unit pulse and all that differs from it.
        total *= 1 + 2 * size
    # The blurred pixel and the plain mean of its scene pixels lie in one range: they differ by its
    # width at most.
    bounds["mtf"] = behind("mtf", gain * (1 + total) / 2 * span, sensor)
    for name, effect in pixel_effects(sensor.effects, "radiance").items():
        direct = effect.bound_dn(sensor, low, high)
        bounds[name] = behind(name, direct, sensor)
        # Later effects may meet this range, whether the effect is applied or not.
        low = low - direct / gain
        high = high + direct / gain
    noise = gain * NOISE_LIMIT * sensor.noise_sigma(max(high, 0.0))
    bounds["noise"] = behind("noise", noise, sensor)
    low = low - noise / gain
    high = high + noise / gain
    for name, effect in pixel_effects(sensor.effects, "DN").items():
        direct = effect.bound_dn(sensor, low, high)
        bounds[name] = behind(name, direct, sensor)
        low = low - direct / gain
        high = high + direct / gain
    return bounds


def _decide(
    name: str,
    sensor: Instrument,
    bounds: dict[str, float],
    negligible: set[str],
    tolerance_dn: float,
) -> tuple[Choice, str, float | None]:
    """What becomes of an effect, why, and its bound."""
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
