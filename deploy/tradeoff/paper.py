"""The paper's network beside a study's points: what is as good in less time, what a tenth of its energy buys.

The paper's two printed runs stand beside as points: their times on the board compare, their pictures do not.
"""

from collections.abc import Callable, Mapping, Sequence

from deploy.bench.tables import PAPER, PAPER_TILE_PX, Swath
from deploy.tradeoff.board import DpuRun
from deploy.tradeoff.outcome import Outcome, Results
from deploy.tradeoff.points import EXACT, Point, Variant, on_dpu
from deploy.tradeoff.study import figure_words, gain_words, times_words
from model.evaluation.scores import NOTE
from profiles.figures import Figure, number, published, unavailable

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


def at_a_glance(results: Results, paper: Outcome | None) -> str:
    """One sentence: what is as good in less time, or without such a point the best and the fastest."""
    best = as_good(results, paper, whole_interval=False) if paper else None
    if paper is None or best is None or (best.value(LATENCY) or 0.0) >= (paper.value(LATENCY) or 0.0):
        return _best_and_fastest(list(results.outcomes.values()))
    seconds = "in {} instead of {} s on the board (predicted)"
    swift = seconds.format(*(number(each.value(LATENCY) or 0.0, 2) for each in (best, paper)))
    decibels = " beside ".join(f"{each.value('PSNR') or 0.0:.2f}" for each in (best, paper))
    where = f"tiles of {best.point.tile_px} on {best.point.configuration}"
    return (
        f"{best.point.variant} in {where} restores the swath {swift}, within {EQUAL_DB} dB of the paper's shape: "
        f"PSNR {decibels} dB on the same pairs."
    )


def _best_and_fastest(outcomes: Sequence[Outcome]) -> str:
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
