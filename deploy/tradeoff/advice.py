"""What a study advises: the best point for a budget or a need, and what the next step costs; how to read it.

A dearer point is advised only where the images tell it apart from a cheaper one: where the interval of the paired
difference leaves 0 out. Of fewer sites than an interval takes, values alone decide, and it is said.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from deploy.tradeoff.accuracy import BenchmarkSet
from deploy.tradeoff.board import PAIR_QUANTILE, pair_error
from deploy.tradeoff.host_time import ROUNDS
from deploy.tradeoff.host_time import TILE_PX as HOST_TILE_PX
from deploy.tradeoff.methods import PATCH_PX, PATCHES
from deploy.tradeoff.outcome import COSTS, DIRECTIONS, Outcome, Place, Results, front
from deploy.tradeoff.points import Demand, shortfall
from deploy.tradeoff.study import CHEAPER, apart, figure_words, gain_words, places
from model.metrics.bootstrap import LEAST_SITES
from profiles.figures import Figure, Row, number, unavailable

QUALITY = "PSNR"
ALIKE = {"PSNR": 0.05}
"""Where the sites are too few to tell points apart, a cheaper one within it is chosen."""
KNEE = 2
"""A front of more steps than that has a knee."""


@dataclass(frozen=True)
class Choice:
    """What was chosen, None where nothing keeps every demand, and sentences about it."""

    outcome: Outcome | None
    advice: tuple[str, ...]


def choose(results: Results, budget: Sequence[Demand], need: Sequence[Demand]) -> Choice:
    """Within a budget the best PSNR; for a need alone the least board latency, or host time where none has one."""
    demands = [*budget, *need]
    goal = best_of(QUALITY) if budget else Goal(_cost(results), 1)
    ranked = [each for each in results.outcomes.values() if each.value(goal.key) is not None]
    kept = [each for each in ranked if not shortfall(each.figures, demands)]
    asked = " and ".join(map(str, demands))
    if not kept:
        return Choice(None, (_nearest(ranked or list(results.outcomes.values()), demands, asked),))
    best, chosen = _best_and_taken(results, kept, goal, _paid(results, budget))
    found = f"{chosen.name} (sensor: {chosen.text['sensor']}), {figures_words(chosen, demands, goal.key)}"
    sentences = [f"For {asked}: {found}; {_why(chosen, best, goal, len(kept))}."]
    sentences += _unsure(chosen, demands)
    sentences.append(_better(best, ranked, demands, goal))
    return Choice(chosen, tuple(sentences))


def _best_and_taken(results: Results, kept: Sequence[Outcome], goal: "Goal", cost: str) -> tuple[Outcome, Outcome]:
    """The best of some points, and the cheapest of those that the images cannot tell from it."""
    best = min(kept, key=lambda each: (goal.of(each), each.value(cost) or math.inf))
    if goal.key not in DIRECTIONS:
        return best, best
    near = [each for each in kept if each is best or not told_better(results, best, each, goal.key)]
    return best, min(near, key=lambda each: each.value(cost) or math.inf)


def told_better(results: Results, a: Outcome, b: Outcome, key: str) -> bool:
    """Whether `a` is better than `b` over the whole paired interval; by value where there is none."""
    low, high = results.gain(a.name, b.name, key)
    if math.isfinite(high - low):
        return low > 0
    return DIRECTIONS[key] * ((a.value(key) or 0.0) - (b.value(key) or 0.0)) > ALIKE.get(key, 0.0)


def _why(chosen: Outcome, best: Outcome, goal: "Goal", count: int) -> str:
    if chosen is best:
        return f"it has the {goal.words} of the {count} points that keep it"
    higher = f"{best.name}, {figure_words(best.figures[goal.key])}"
    beside = "is not distinguishable from it, and costs more"
    return f"the {goal.words} of the {count} points that keep it, of {higher}, {beside}"


def _cost(results: Results) -> str:
    had = (key for key in COSTS if any(each.value(key) is not None for each in results.outcomes.values()))
    return next(had, COSTS[0])


def _paid(results: Results, budget: Sequence[Demand]) -> str:
    """What a budget is about; board latency where it names no cost, or host time where none has one."""
    return next((demand.key for demand in budget if demand.key in COSTS), _cost(results))


@dataclass(frozen=True)
class Goal:
    """What is best: the highest (-1) or the lowest (1) of a figure."""

    key: str
    sign: int

    @property
    def words(self) -> str:
        """The goal in words: "highest PSNR"."""
        return f"{'highest' if self.sign < 0 else 'lowest'} {self.key}"

    def of(self, outcome: Outcome) -> float:
        """What to make small: the figure's value, turned round where more of it is better."""
        return self.sign * (outcome.value(self.key) or 0.0)


def best_of(quality: str) -> Goal:
    """The best of a quality, whichever way it runs."""
    return Goal(quality, -DIRECTIONS[quality])


def figures_words(outcome: Outcome, demands: Sequence[Demand], *more: str) -> str:
    """The figures that matter, each with its unit."""
    keys = dict.fromkeys([*more, *(demand.key for demand in demands)])
    return ", ".join(f"{key} {figure_words(outcome.figures[key])}" for key in keys)


def _unsure(best: Outcome, demands: Sequence[Demand]) -> list[str]:
    """Demands that the value keeps, and its interval does not."""
    unsure = [demand for demand in demands if not demand.kept_throughout(best.figures[demand.key])]
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


@dataclass(frozen=True)
class Recommendation:
    """What to take on one board for one quality, in a sentence.

    Attributes:
        quality: key of the figure that is bought.
        board: the target's name.
        sentence: what a manager needs: what to take, how good it is, how long it takes, what the next step costs.
        taken: the point; None where nothing keeps the demands.
        following: the cheapest dearer point that the images tell to be better; None where there is none.
        figures: of the point, and what the next step gains and costs.
    """

    quality: str
    board: str
    sentence: str
    taken: Outcome | None
    following: Outcome | None
    figures: Mapping[str, Figure]

    @property
    def row(self) -> Row:
        """For a document and the page."""
        names = {"take": self.taken, "next": self.following}
        text = {key: each.name if each else "none" for key, each in names.items()}
        words = {"board": self.board, **text, "sentence": self.sentence}
        return Row("recommendations", f"{self.quality} on {self.board}", self.figures, words)


def recommendations(
    results: Results, budget: Sequence[Demand], need: Sequence[Demand], board: str
) -> list[Recommendation]:
    """One for each quality that points have beside the cost, PSNR first."""
    asked = [Question(results, key, board, tuple(budget), tuple(need)) for key in DIRECTIONS]
    return [question.answer() for question in asked if question.ranked]


@dataclass(frozen=True)
class Question:
    """What to take on one board for one quality, within a budget, for a need, or without either."""

    results: Results
    quality: str
    board: str
    budget: tuple[Demand, ...]
    need: tuple[Demand, ...]

    @property
    def cost(self) -> str:
        """The figure that is paid."""
        return _paid(self.results, self.budget)

    @property
    def ranked(self) -> list[Outcome]:
        """The points that have the quality and the cost."""
        had = (self.quality, self.cost)
        return [each for each in self.results.outcomes.values() if None not in map(each.value, had)]

    def answer(self) -> Recommendation:
        """The point, and the sentence about it."""
        demands = [*self.budget, *self.need]
        kept = [each for each in self.ranked if not shortfall(each.figures, demands)]
        asked = " and ".join(map(str, demands))
        if not kept:
            return self._nothing_fits(demands, asked)
        if not demands:
            steps = steps_of(self.results, self.quality, self.cost)
            taken = self.results.outcomes[knee(steps).name]
            why = "the knee of the front" if len(steps) > KNEE else "the cheapest on the front"
            return self._recommend(f"Without a budget take {taken.point.spoken}, {why}", taken, taken)
        goal = best_of(self.quality) if self.budget else Goal(self.cost, 1)
        best, taken = _best_and_taken(self.results, kept, goal, self.cost)
        return self._recommend(f"For {asked} take {taken.point.spoken}", taken, best)

    def _nothing_fits(self, demands: Sequence[Demand], asked: str) -> Recommendation:
        nearest = min(self.ranked, key=lambda each: shortfall(each.figures, demands))
        sentence = (
            f"Nothing in this study fits {asked}; nearest comes {nearest.point.spoken}: {self._words(nearest)}."
        )
        if math.isinf(shortfall(nearest.figures, demands)):
            sentence = _nearest(self.ranked, demands, asked)
        lacking = unavailable(nearest.figures[self.quality].unit, f"nothing fits {asked}")
        return Recommendation(self.quality, self.board, sentence, None, None, {self.quality: lacking})

    def _recommend(self, lead: str, taken: Outcome, best: Outcome) -> Recommendation:
        following = self._following(taken)
        step = self._step(taken, following)
        after = "nothing dearer in this study is shown to be better"
        if following:
            gain = gain_words(self.results, following.name, taken.name, self.quality)
            after = f"the next {gain}, with {following.point.spoken}, cost {figure_words(step['next cost'])} more"
        sentences = [f"{lead}: {self._words(taken)}; {after}.", *self._remarks(taken, best, following or best)]
        sentences += _unsure(taken, [*self.budget, *self.need])
        figures = {key: taken.figures[key] for key in (self.quality, self.cost)} | step
        return Recommendation(self.quality, self.board, " ".join(sentences), taken, following, figures)

    def _words(self, outcome: Outcome) -> str:
        good, paid = (outcome.figures[key] for key in (self.quality, self.cost))
        where = "this machine" if self.cost.startswith("host") else self.board
        value = figure_words(replace(good, interval=None))  # over sites: it is no measure of what differs
        return f"{self.quality} {value} at {figure_words(paid)} on {where} ({paid.mode})"

    def _following(self, taken: Outcome) -> Outcome | None:
        """The next step beyond a point: shown to be better, and of those as dear for all we know the best."""
        results, paid = self.results, taken.value(self.cost) or 0.0
        beyond = front([place for place in places(results, self.cost, self.quality) if place.cost >= paid])
        found: Outcome | None = None
        for each in (results.outcomes[name] for name in beyond):
            if not told_better(results, each, found or taken, self.quality):
                continue
            if found and results.ratio(each.name, found.name, self.cost)[0] > 1:
                break
            found = each
        return found

    def _step(self, taken: Outcome, following: Outcome | None) -> dict[str, Figure]:
        """What the next step gains and costs; the interval of the cost is that of the ratio of both."""
        paid = taken.figures[self.cost]
        if following is None:
            reason = f"no dearer point is shown to have a better {self.quality}"
            units = {"next gain": taken.figures[self.quality].unit, "next cost": paid.unit}
            return {key: unavailable(unit, reason) for key, unit in units.items()}
        now, then = (each.value(self.cost) or 0.0 for each in (taken, following))
        low, high = (now * (times - 1) for times in self.results.ratio(following.name, taken.name, self.cost))
        source = f"{self.cost} of {following.name} less that of {taken.name}, interval by the ratio of both"
        extra = Figure(then - now, paid.unit, paid.mode, source, (low, high))
        return {"next gain": self.results.difference(following.name, taken.name, self.quality), "next cost": extra}

    def _remarks(self, taken: Outcome, best: Outcome, following: Outcome) -> list[str]:
        """What is to be said of a point with a better value, and of sites too few to tell."""
        ends = [self.results.gain(each.name, taken.name, self.quality)[1] for each in (best, following)]
        if not all(map(math.isfinite, ends)):
            return [f"By value alone: of fewer than {LEAST_SITES} sites no difference can be trusted."]
        if best is taken:
            return []
        more = gain_words(self.results, best.name, taken.name, self.quality)
        better = f"{best.point.spoken} is better by {more}"
        return [f"{better}, but these images cannot tell the two apart: take the {CHEAPER[self.cost]}."]


def knee(steps: Sequence[Place]) -> Place:
    """The step of a front farthest above the straight line from its first step to its last, the cost logarithmic.

    So Satopaa et al. find a knee ("Finding a Kneedle in a Haystack", ICDCS Workshops 2011): beyond it a doubling of
    the cost buys less than along the whole front. Of two steps the cheaper one.

    Args:
        steps: from cheap to dear, at least one, each with a cost above 0.
    """
    first, last = steps[0], steps[-1]
    gained, times = last.quality - first.quality or 1.0, math.log(last.cost / first.cost) or 1.0
    above = [(step.quality - first.quality) / gained - math.log(step.cost / first.cost) / times for step in steps]
    return steps[above.index(max(above))]


def steps_of(results: Results, quality: str, cost: str) -> list[Place]:
    """A front's members that are told apart, from cheap to dear; all of them where the sites are too few to tell."""
    found = {place.name: place for place in places(results, cost, quality)}
    members = front(list(found.values()))
    known = any(math.isfinite(results.gain(name, members[0], quality)[0]) for name in members[1:])
    return [found[name] for name in (apart(results, members, cost, quality) if known else members)]


def notes(
    benchmark: BenchmarkSet,
    sampled: str,
    small: Sequence[str],
    lacks: Mapping[str, str],
    calibrated_on: str,
    board: str,
) -> tuple[str, ...]:
    """Sentences, the most important first; `sampled` says at what oversampling, where that is not the profile's."""
    spread = f"{math.exp(pair_error(board)):.2f} times either way ({PAIR_QUANTILE:.0%} of published pairs)"
    found = [
        f"No board was used: figures of {board} are predicted, its power is an assumption that no network changes.",
        f"Pictures are judged on {len(benchmark.pairs)} whole images of {len(set(benchmark.sites))} sites.",
        "The paper's shape is judged with the weights of that shape at hand, not with the paper's own.",
        "Points are distinguished by the differences on the same images: their own intervals show how images differ.",
        "Without a budget the knee is advised: beyond it a doubling of the cost buys less than on the whole front.",
        f"Times on the board are distinguished by their ratio, none and all of the memory's hidden, and {spread}.",
        "Points of one network, tile and configuration are distinguished on the board by their count of tiles alone.",
        "Energies of two networks or configurations may also differ by the whole range assumed for the power.",
        "With the exact halo the picture does not depend on the tile.",
        "With less, seams were measured on images cut in four and weighed by the swath's seams: predicted.",
        f"Host times, {ROUNDS} rounds of a tile of {HOST_TILE_PX} px, interleaved, are no proxy for the board.",
        f"INT8 files made here: {PATCHES} patches of {PATCH_PX} x {PATCH_PX} from {calibrated_on}.",
        "Chains and peers know both sensors; what a network knows of them stands beside it.",
        "A chain on the board's CPU is CPU time here, each kind of its work scaled by published rates of its cores.",
        "Of other methods there the kinds are not known, nor how many cores they use: a wide interval.",
    ]
    sites = len(set(benchmark.sites))
    if sites < LEAST_SITES:
        found.append(
            f"No interval over sites is shown, and pictures distinguish no two points: of {sites}, fewer than "
            f"{LEAST_SITES}, none could be trusted."
        )
    found += [f"{sampled[0].upper()}{sampled[1:]}."] if sampled else []
    found += [f"Left out, too small: {', '.join(small)}."] if small else []
    return (*found, *(f"{variant} is not there: {reason}." for variant, reason in lacks.items()))
