"""The best point for a budget or a need, why it is, and what it would take to do better."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from deploy.results import Figure, number
from deploy.tradeoff.demands import Demand, shortfall
from deploy.tradeoff.outcome import COSTS, Arena, Outcome

QUALITY = "PSNR"
ALIKE_DB = 0.05
"""Within it a cheaper point is chosen where the images tell none apart."""


@dataclass(frozen=True)
class Choice:
    """What was chosen, None where nothing keeps every demand, and sentences about it."""

    outcome: Outcome | None
    advice: tuple[str, ...]


def choose(arena: Arena, budget: Sequence[Demand], need: Sequence[Demand]) -> Choice:
    """Within a budget the best PSNR; for a need alone the least board latency, or host time where none has one."""
    demands = [*budget, *need]
    goal = Goal(QUALITY, -1) if budget else Goal(_cost(arena), 1)
    ranked = [each for each in arena.outcomes.values() if each.value(goal.key) is not None]
    kept = [each for each in ranked if not shortfall(each.figures, demands)]
    asked = " and ".join(map(str, demands))
    if not kept:
        return Choice(None, (_nearest(ranked or list(arena.outcomes.values()), demands, asked),))
    best = chosen = min(kept, key=goal.of)
    if goal.key == QUALITY:
        paid = next((demand.key for demand in budget if demand.key in COSTS), _cost(arena))
        chosen = min(_alike(arena, best, kept), key=lambda each: each.value(paid) or math.inf)
    found = f"{chosen.name} (told: {chosen.text['told']}), {figures_words(chosen, demands, goal.key)}"
    sentences = [f"For {asked}: {found}; {_why(chosen, best, goal, len(kept))}."]
    sentences += _doubts(chosen, demands)
    sentences.append(_better(best, ranked, demands, goal))
    return Choice(chosen, tuple(sentences))


def _alike(arena: Arena, best: Outcome, kept: Sequence[Outcome]) -> list[Outcome]:
    """Points near the best that the images cannot tell from it."""
    least = (best.value(QUALITY) or 0.0) - ALIKE_DB
    near = [each for each in kept if (each.value(QUALITY) or 0.0) >= least]
    return [each for each in near if arena.gain(best.name, each.name, QUALITY)[0] <= 0]


def _why(chosen: Outcome, best: Outcome, goal: "Goal", count: int) -> str:
    if chosen is best:
        return f"it has the {goal.words} of the {count} points that keep it"
    higher = f"{best.name}, {figure_words(best.figures[goal.key])}"
    return f"the {goal.words} of the {count} points that keep it, of {higher}, cannot be told from it, and costs more"


def _cost(arena: Arena) -> str:
    had = (key for key in COSTS if any(each.value(key) is not None for each in arena.outcomes.values()))
    return next(had, COSTS[0])


@dataclass(frozen=True)
class Goal:
    """What is best: the highest (-1) or the lowest (1) of a figure."""

    key: str
    sign: int

    @property
    def words(self) -> str:
        """As a person says it."""
        return f"{'highest' if self.sign < 0 else 'lowest'} {self.key}"

    def of(self, outcome: Outcome) -> float:
        """The smaller the better."""
        return self.sign * (outcome.value(self.key) or 0.0)


def figures_words(outcome: Outcome, demands: Sequence[Demand], *more: str) -> str:
    """The figures that matter, each with its unit."""
    keys = dict.fromkeys([*more, *(demand.key for demand in demands)])
    return ", ".join(f"{key} {figure_words(outcome.figures[key])}" for key in keys)


def figure_words(figure: Figure) -> str:
    """A figure with its interval and unit."""
    unit = "" if figure.unit in ("ratio", "distance") else f" {figure.unit}"
    return f"{figure}{unit if figure.value is not None else ''}"


def _doubts(best: Outcome, demands: Sequence[Demand]) -> list[str]:
    """Demands that the value keeps, and its interval does not."""
    unsure = [demand for demand in demands if not demand.surely_kept(best.figures[demand.key])]
    if not unsure:
        return []
    return [f"Its value keeps {' and '.join(map(str, unsure))}, but not the whole interval."]


def _better(best: Outcome, ranked: Sequence[Outcome], demands: Sequence[Demand], goal: Goal) -> str:
    """The point beyond the demands that would be better, and asks for the least."""
    above = [
        each for each in ranked if goal.of(each) < goal.of(best) and math.isfinite(shortfall(each.figures, demands))
    ]
    if not above:
        return f"No point that has the figures asked for has a {'higher' if goal.sign < 0 else 'lower'} {goal.key}."
    nearest = min(above, key=lambda each: shortfall(each.figures, demands))
    missed = [demand for demand in demands if demand.short_by(nearest.figures.get(demand.key))]
    return (
        f"To do better, give up {' and '.join(map(str, missed))}: {nearest.name} has {goal.key} "
        f"{figure_words(nearest.figures[goal.key])}, with {figures_words(nearest, missed)}."
    )


def _nearest(outcomes: Sequence[Outcome], demands: Sequence[Demand], asked: str) -> str:
    nearest = min(outcomes, key=lambda each: shortfall(each.figures, demands))
    miss = shortfall(nearest.figures, demands)
    if math.isinf(miss):
        return f"No point keeps {asked}: none has every figure asked for."
    return (
        f"No point keeps {asked}; nearest comes {nearest.name}, with {figures_words(nearest, demands)}: "
        f"{number(100 * miss, 2)} % off the limit that it misses most."
    )
