"""What a study says: the best point for a budget or a need, what a step along a front costs, and how to read it.

The paper's two runs stand beside as points: their times on the board compare, their pictures do not.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from deploy.bench.tables import PAPER, PAPER_TILE_PX, Swath
from deploy.tradeoff.accuracy import BenchmarkSet
from deploy.tradeoff.board import PAIR_QUANTILE, DpuRun, pair_error
from deploy.tradeoff.host_time import ROUNDS
from deploy.tradeoff.host_time import TILE_PX as HOST_TILE_PX
from deploy.tradeoff.methods import PATCH_PX, PATCHES
from deploy.tradeoff.outcome import COSTS, DIRECTIONS, Outcome, Place, Plane, Results, dominated, front
from deploy.tradeoff.points import EXACT, Demand, Point, Variant, on_dpu, shortfall
from deploy.tradeoff.study import Front
from model.evaluation.scores import NOTE
from model.metrics.bootstrap import LEAST_SITES
from profiles.figures import Figure, number, published, unavailable

QUALITY = "PSNR"
ALIKE_DB = 0.05
"""Within it a cheaper point is chosen where the images tell none apart."""


@dataclass(frozen=True)
class Choice:
    """What was chosen, None where nothing keeps every demand, and sentences about it."""

    outcome: Outcome | None
    advice: tuple[str, ...]


def choose(results: Results, budget: Sequence[Demand], need: Sequence[Demand]) -> Choice:
    """Within a budget the best PSNR; for a need alone the least board latency, or host time where none has one."""
    demands = [*budget, *need]
    goal = Goal(QUALITY, -1) if budget else Goal(_cost(results), 1)
    ranked = [each for each in results.outcomes.values() if each.value(goal.key) is not None]
    kept = [each for each in ranked if not shortfall(each.figures, demands)]
    asked = " and ".join(map(str, demands))
    if not kept:
        return Choice(None, (_nearest(ranked or list(results.outcomes.values()), demands, asked),))
    best = chosen = min(kept, key=goal.of)
    if goal.key == QUALITY:
        paid = next((demand.key for demand in budget if demand.key in COSTS), _cost(results))
        chosen = min(_alike(results, best, kept), key=lambda each: each.value(paid) or math.inf)
    found = f"{chosen.name} (sensor: {chosen.text['sensor']}), {figures_words(chosen, demands, goal.key)}"
    sentences = [f"For {asked}: {found}; {_why(chosen, best, goal, len(kept))}."]
    sentences += _unsure(chosen, demands)
    sentences.append(_better(best, ranked, demands, goal))
    return Choice(chosen, tuple(sentences))


def _alike(results: Results, best: Outcome, kept: Sequence[Outcome]) -> list[Outcome]:
    """Points near the best that the images cannot tell from it."""
    least = (best.value(QUALITY) or 0.0) - ALIKE_DB
    near = [each for each in kept if (each.value(QUALITY) or 0.0) >= least]
    return [each for each in near if results.gain(best.name, each.name, QUALITY)[0] <= 0]


def _why(chosen: Outcome, best: Outcome, goal: "Goal", count: int) -> str:
    if chosen is best:
        return f"it has the {goal.words} of the {count} points that keep it"
    higher = f"{best.name}, {figure_words(best.figures[goal.key])}"
    beside = "is not distinguishable from it, and costs more"
    return f"the {goal.words} of the {count} points that keep it, of {higher}, {beside}"


def _cost(results: Results) -> str:
    had = (key for key in COSTS if any(each.value(key) is not None for each in results.outcomes.values()))
    return next(had, COSTS[0])


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


def figures_words(outcome: Outcome, demands: Sequence[Demand], *more: str) -> str:
    """The figures that matter, each with its unit."""
    keys = dict.fromkeys([*more, *(demand.key for demand in demands)])
    return ", ".join(f"{key} {figure_words(outcome.figures[key])}" for key in keys)


def figure_words(figure: Figure) -> str:
    """A figure with its interval and unit."""
    unit = "" if figure.unit in ("ratio", "distance") else f" {figure.unit}"
    return f"{figure}{unit if figure.value is not None else ''}"


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


BESIDE = {"board latency": ("board energy",), "board energy": ("board latency",), "host p50": ()}
"""What else a step costs."""


def fronts(results: Results) -> tuple[Front, ...]:
    """A front for each pair of a cost and a quality that some points have."""
    return tuple(_fronts(results))


def _fronts(results: Results) -> Iterator[Front]:
    for y in DIRECTIONS:
        for x in COSTS:
            found = places(results, x, y)
            if found:
                members = front(found)
                steps = apart(results, members, x, y)
                yield Front(
                    x, y, members, steps, dominated(found, Plane(results, x, y)), prices(results, steps, x, y)
                )


def places(results: Results, x: str, y: str) -> list[Place]:
    """The points that have both figures."""
    return [place for outcome in results.outcomes.values() if (place := outcome.place(x, y))]


def prices(results: Results, steps: tuple[str, ...], x: str, y: str) -> tuple[str, ...]:
    """A sentence for each step, from cheap to dear."""
    found = list(pairwise(steps))
    return tuple(_price(results, *step, x, y, last=step == found[-1]) for step in found)


def apart(results: Results, members: Sequence[str], x: str, y: str) -> tuple[str, ...]:
    """Members that are better and dearer than the one before beyond the intervals; of those as dear the best."""
    kept = list(members[:1])
    for name in members[1:]:
        if results.gain(name, kept[-1], y)[0] <= 0:
            continue
        if results.ratio(name, kept[-1], x)[0] <= 1:
            kept.pop()
        kept.append(name)
    return tuple(kept)


def _price(results: Results, cheap: str, dear: str, x: str, y: str, *, last: bool) -> str:
    times = " and ".join(times_words(results, dear, cheap, key) for key in (x, *BESIDE[x]))
    bought = f"{'The last' if last else 'A step of'} {gain_words(results, dear, cheap, y)}"
    return f"{bought}, from {cheap} to {dear}, costs {times}."


GAINED = {"dB": "dB", "%": "points"}
"""Unit of a difference, by that of the figures; none of others."""


def gain_words(results: Results, better: str, worse: str, key: str) -> str:
    """By how much one point is better, with its interval where there is one: "0.32 dB [0.2, 0.5] of PSNR"."""
    values = [results.outcomes[name].figures[key] for name in (better, worse)]
    gain = DIRECTIONS[key] * ((values[0].value or 0.0) - (values[1].value or 0.0))
    low, high = results.gain(better, worse, key)
    unit = GAINED.get(values[0].unit, "")
    interval = f"[{number(low, 2)}, {number(high, 2)}]" if math.isfinite(high - low) else ""
    return " ".join(f"{number(gain, 2)} {unit} {interval} of {key}".split())


def times_words(results: Results, a: str, b: str, key: str) -> str:
    """How many times as much one point costs: "2.1 times [1.7, 2.6] the board latency"."""
    low, high = results.ratio(a, b, key)
    return f"{number(results.times(a, b, key), 2)} times [{number(low, 2)}, {number(high, 2)}] the {key}"


EQUAL_DB = 0.1
ENERGY_SHARE = 0.1
LATENCY, ENERGY = "board latency", "board energy"


def papers_point(results: Results, is_papers: Callable[[str], bool], configuration: str) -> Outcome | None:
    """The paper's network among the outcomes; `is_papers` tells it by a method's name."""
    for outcome in results.outcomes.values():
        point = outcome.point
        usual = (point.tile_px, point.halo, point.configuration) == (PAPER_TILE_PX, EXACT, configuration)
        if usual and on_dpu(point.variant) and is_papers(point.variant.method) and outcome.board:
            return outcome
    return None


def findings(results: Results, paper: Outcome | None) -> tuple[str, ...]:
    """As sentences; without the paper's network the reason why there are none."""
    if paper is None:
        return (
            "The paper's network (16 blocks of 64 features) is not among the networks: nothing is held against it.",
        )
    best, throughout = (as_good(results, paper, whole_interval=whole) for whole in (False, True))
    sentences = [equal_quality(results, paper, best, f"within {EQUAL_DB} dB")]
    if throughout is not best:
        sentences.append(equal_quality(results, paper, throughout, f"within {EQUAL_DB} dB over the whole interval"))
    return (*sentences, tenth_energy(results, paper))


def as_good(results: Results, paper: Outcome, *, whole_interval: bool) -> Outcome | None:
    """The fastest of the points that reach its PSNR within EQUAL_DB: by value, or over the whole interval."""

    def lead_db(each: Outcome) -> float:
        by_value = (each.value("PSNR") or 0.0) - (paper.value("PSNR") or 0.0)
        return min(results.gain(each.name, paper.name, "PSNR")[0], by_value) if whole_interval else by_value

    found = [each for each in _rivals(results, paper) if lead_db(each) >= -EQUAL_DB]
    return min(found, key=lambda each: each.value(LATENCY) or 0.0, default=None)


def equal_quality(results: Results, paper: Outcome, best: Outcome | None, how: str) -> str:
    """That the fastest of the points that are as good is faster, or that none is."""
    start = f"The paper's shape with the weights of {paper.point.variant.method}, {_of(paper, 'PSNR', LATENCY)}"
    if best is None or (best.value(LATENCY) or 0.0) >= (paper.value(LATENCY) or 0.0):
        return f"{start}: no point that knows as much of the sensor reaches its PSNR {how} in less time."
    half = results.ratio(best.name, paper.name, LATENCY)[1] <= 0.5
    halved = "; less than half the time over the whole interval" if half else ""
    beside = _beside(results, best, paper, LATENCY, ENERGY)
    return f"{start}, is matched {how} by {best.name} ({_of(best, 'PSNR', LATENCY)}): {beside}{halved}."


def tenth_energy(results: Results, paper: Outcome) -> str:
    """The best of the points that take a tenth of its energy, or that there is none."""
    most = ENERGY_SHARE * (paper.value(ENERGY) or 0.0)
    found = [each for each in _rivals(results, paper) if (each.value(ENERGY) or 0.0) <= most]
    start = f"At a tenth of its energy ({number(most, 3)} of {number(paper.value(ENERGY) or 0.0, 3)} J)"
    if not found:
        cheapest = min(_rivals(results, paper), key=lambda each: each.value(ENERGY) or 0.0, default=paper)
        return f"{start} there is no point; the least takes {cheapest.name}, {_of(cheapest, ENERGY, 'PSNR')}."
    best = max(found, key=lambda each: each.value("PSNR") or 0.0)
    return f"{start} the best is {best.name} ({_of(best, 'PSNR', ENERGY)}): {_beside(results, best, paper, ENERGY)}."


def headline(results: Results, paper: Outcome | None) -> str:
    """One sentence for a project manager."""
    best = as_good(results, paper, whole_interval=False) if paper else None
    if paper is None or best is None or (best.value(LATENCY) or 0.0) >= (paper.value(LATENCY) or 0.0):
        return _plain_headline(list(results.outcomes.values()))
    seconds = "in {} instead of {} s on the board (predicted)"
    swift = seconds.format(*(number(each.value(LATENCY) or 0.0, 2) for each in (best, paper)))
    decibels = " beside ".join(f"{each.value('PSNR') or 0.0:.2f}" for each in (best, paper))
    where = f"tiles of {best.point.tile_px} on {best.point.configuration}"
    return (
        f"{best.point.variant} in {where} restores the swath {swift}, within {EQUAL_DB} dB of the paper's shape: "
        f"PSNR {decibels} dB on the same pairs."
    )


def _plain_headline(outcomes: Sequence[Outcome]) -> str:
    known = [each for each in outcomes if each.value("PSNR") is not None]
    if not known:
        return "No point could be measured."
    best = max(known, key=lambda each: each.value("PSNR") or 0.0)
    timed = [each for each in known if isinstance(each.board, DpuRun)]
    sentence = f"Of {len(known)} points {best.name} is best, {_of(best, 'PSNR')}"
    if not timed:
        return f"{sentence}; none has a time on the board."
    fastest = min(timed, key=lambda each: each.value(LATENCY) or 0.0)
    return f"{sentence}; the fastest on the board is {fastest.name}, {_of(fastest, LATENCY, 'PSNR')}."


def _rivals(results: Results, paper: Outcome) -> list[Outcome]:
    """The points that compare with the paper's network: see the module."""
    return [
        each
        for each in results.outcomes.values()
        if each is not paper
        and isinstance(each.board, DpuRun)
        and each.point.configuration == paper.point.configuration
        and each.text["sensor"] == paper.text["sensor"]
    ]


def _beside(results: Results, a: Outcome, b: Outcome, *costs: str) -> str:
    times = " and ".join(times_words(results, a.name, b.name, key) for key in costs)
    more = (a.value("PSNR") or 0.0) >= (b.value("PSNR") or 0.0)
    better, worse = (a, b) if more else (b, a)
    return f"{gain_words(results, better.name, worse.name, 'PSNR')} {'more' if more else 'less'}, for {times}"


def _of(outcome: Outcome, *keys: str) -> str:
    return ", ".join(f"{key} {figure_words(outcome.figures[key])}" for key in keys)


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


SIZE_PX = (13600, 9016)
RUNS = {
    "paper: ConvBEERS on the DPU": ("INT8", (42, 7.2, 29.6, 98965)),
    "paper: traditional on the board's CPU": ("float32", (1724, 0.2, 22.5, 3161)),
}
"""Precision; latency, throughput, power and efficiency as printed."""


def paper_outcomes(swath: Swath, units: Mapping[str, str]) -> list[Outcome]:
    """Both runs, where the swath is the paper's; else none. `units`: of every figure of a point."""
    if (swath.width_px, swath.height_px) != SIZE_PX:
        return []
    return [_outcome(name, precision, values, units) for name, (precision, values) in RUNS.items()]


def _outcome(
    name: str, precision: str, values: tuple[float, float, float, float], units: Mapping[str, str]
) -> Outcome:
    latency_s, rate, power_w, efficiency = values
    printed = {"latency": latency_s, "throughput": rate, "power": power_w, "efficiency": efficiency}
    found = {f"board {key}": published(value, units[f"board {key}"], PAPER) for key, value in printed.items()}
    found["board energy"] = published(latency_s * power_w, "J", f"{PAPER}: latency x power")
    figures: dict[str, Figure] = {key: found.get(key) or unavailable(unit, NOTE) for key, unit in units.items()}
    text = dict.fromkeys(("halo", "tile", "configuration", "runtime"), "not stated")
    text |= {"method": name, "kind": "paper", "precision": precision, "sensor": "not stated"}
    return Outcome(Point(Variant(name, "paper", precision)), figures, text)
