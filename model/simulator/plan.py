"""Which effects a scene calls for: decided, proven and explained before a pixel is made.

Each effect is applied, or skipped because

1. not called for: neither sensor nor scene has its table;
2. neutral: its parameters change nothing;
3. this scene cannot show it: a bound proves that no pixel changes by more than the tolerance.

What is skipped for the third reason stays within the tolerance all together: bounds are added up, the smallest first.
"""

from dataclasses import asdict, dataclass
from typing import Literal

from model.simulator.bounds import (
    SceneStats,
    behind,
    blur_bound_dn,
    blurred_range,
    effect_bound_dn,
    noise_bound_dn,
    ringing_of,
    smear_bound_dn,
    smear_ringing,
)
from profiles.effects import TABLES, Smear
from profiles.sensor import Sensor

TOLERANCE_DN = 0.25
"""Before digitising; a quarter of a digital number is below the converter's own rounding."""

Choice = Literal["applied", "not called for", "neutral", "cannot show"]

ORDER = (
    "mtf", "antialias", "smear", "sampling", "veil", "full_well", "prnu", "noise", "dsnu", "striping", "offset",
    "defects", "digitising",
)  # fmt: skip

COSTS = {
    "mtf": "2 transforms of the scene", "antialias": "none: part of the MTF", "smear": "none: part of the MTF",
    "sampling": "folding of the spectrum", "veil": "1 pass", "full_well": "1 pass, 1 convolution if it blooms",
    "prnu": "1 draw a column", "noise": "1 draw a pixel", "dsnu": "1 draw a column", "striping": "1 pass",
    "offset": "1 pass", "defects": "1 draw a pixel", "digitising": "1 pass",
}  # fmt: skip


UNSEEN = {"mtf": "the scene is constant", "full_well": "the brightest signal stays below the well"}
"""Why an effect whose bound is zero cannot show, where that is the scene's doing."""


@dataclass(frozen=True)
class Decision:
    """What becomes of one effect, and why."""

    effect: str
    choice: Choice
    why: str
    bound_dn: float | None  # None: applied without asking, or not there to be bounded
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


def make_plan(sensor: Sensor, stats: SceneStats, tolerance_dn: float = TOLERANCE_DN) -> Plan:
    """Decide for every effect of a sensor on a scene of these statistics."""
    bounds = effect_bounds(sensor, stats)
    spent, hidden = 0.0, set()
    for name, bound in sorted(bounds.items(), key=lambda item: item[1]):
        if bound > 0 and spent + bound <= tolerance_dn:
            spent += bound
            hidden.add(name)
    decisions = tuple(_decide(name, sensor, bounds, hidden, tolerance_dn) for name in ORDER)
    return Plan(decisions, tolerance_dn)


def effect_bounds(sensor: Sensor, stats: SceneStats) -> dict[str, float]:
    """Largest change of any pixel by each effect that can be left out, in DN, through all that comes after it."""
    gain, ringing = sensor.gain_dn_per_radiance, ringing_of(sensor, stats)
    low, high = blurred_range(stats, ringing)
    smear, total, bounds = sensor.effects.get("smear"), ringing, {}
    if isinstance(smear, Smear):
        direct = smear_bound_dn(smear, stats, ringing, gain)
        bounds["smear"] = behind(direct, sensor, _after("smear"))
        low, high, total = low - direct / gain, high + direct / gain, ringing * smear_ringing(smear, stats)
    bounds["mtf"] = behind(blur_bound_dn(stats, total, gain), sensor, _after("mtf"))
    for name in ("veil", "full_well", "prnu"):
        if name in sensor.effects:
            direct = effect_bound_dn(sensor.effects[name], sensor, low, high)
            bounds[name] = behind(direct, sensor, _after(name))
            low, high = low - direct / gain, high + direct / gain  # whether it is applied or not
    bounds["noise"] = noise_bound_dn(sensor, high)
    low, high = low - bounds["noise"] / gain, high + bounds["noise"] / gain
    for name in ("dsnu", "striping", "offset", "defects"):
        if name in sensor.effects:
            bounds[name] = effect_bound_dn(sensor.effects[name], sensor, low, high)
            low, high = low - bounds[name] / gain, high + bounds[name] / gain
    return bounds


def _after(name: str) -> tuple[str, ...]:
    return ORDER[ORDER.index(name) + 1 :]


def _decide(name: str, sensor: Sensor, bounds: dict[str, float], hidden: set[str], tolerance_dn: float) -> Decision:
    cost = COSTS[name]
    if name in ("sampling", "digitising"):
        return Decision(name, "applied", "every sensor has it", None, cost)
    if name in TABLES and name not in sensor.effects:
        return Decision(name, "not called for", "neither sensor nor scene has its table", None, "none")
    if name in ("antialias", "smear") and ("mtf" in hidden or bounds["mtf"] == 0):
        return Decision(name, "cannot show", "the scene is too flat for any blur to show", bounds["mtf"], "none")
    if name == "antialias":
        return Decision(name, "applied", "part of the MTF, and of its budget", None, cost)
    bound = bounds[name]
    if bound == 0:
        why = UNSEEN.get(name)
        return Decision(
            name, "cannot show" if why else "neutral", why or "its parameters change nothing", 0.0, "none"
        )
    if name in hidden:
        return Decision(
            name, "cannot show", f"no pixel changes by more than the {tolerance_dn:g} DN allowed", bound, "none"
        )
    return Decision(name, "applied", "it may change a pixel by up to the bound", bound, cost)
