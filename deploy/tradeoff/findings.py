"""What the study says of the paper's network: the points as good for less, and the best at a tenth of its energy.

The paper's network is its shape with the weights at hand, in tiles of 640 with exact seams, on the default
configuration. Compared are points on the same configuration (the power of others is not known) that were told no more
of the sensor.
"""

from collections.abc import Callable, Sequence

from deploy.bench import PAPER_TILE_PX
from deploy.results import number
from deploy.tradeoff.board import DpuRun
from deploy.tradeoff.choice import figure_words
from deploy.tradeoff.outcome import Arena, Outcome
from deploy.tradeoff.points import EXACT, on_dpu
from deploy.tradeoff.prices import gain_words, times_words

EQUAL_DB = 0.1
ENERGY_SHARE = 0.1
LATENCY, ENERGY = "board latency", "board energy"


def papers_point(arena: Arena, is_papers: Callable[[str], bool], configuration: str) -> Outcome | None:
    """The paper's network among the outcomes; `is_papers` tells it by a method's name."""
    for outcome in arena.outcomes.values():
        point = outcome.point
        usual = (point.tile_px, point.halo, point.configuration) == (PAPER_TILE_PX, EXACT, configuration)
        if usual and on_dpu(point.unit) and is_papers(point.unit.method) and outcome.board:
            return outcome
    return None


def findings(arena: Arena, paper: Outcome | None) -> tuple[str, ...]:
    """As sentences; without the paper's network the reason why there are none."""
    if paper is None:
        return (
            "The paper's network (16 blocks of 64 features) is not among the networks: nothing is held against it.",
        )
    best, sure = (as_good(arena, paper, surely=surely) for surely in (False, True))
    sentences = [equal_quality(arena, paper, best, f"within {EQUAL_DB} dB")]
    if sure is not best:
        sentences.append(equal_quality(arena, paper, sure, f"within {EQUAL_DB} dB over the whole interval"))
    return (*sentences, tenth_energy(arena, paper))


def as_good(arena: Arena, paper: Outcome, *, surely: bool) -> Outcome | None:
    """The fastest of the points that reach its PSNR within EQUAL_DB: by value, or over the whole interval."""

    def lead_db(each: Outcome) -> float:
        by_value = (each.value("PSNR") or 0.0) - (paper.value("PSNR") or 0.0)
        return min(arena.gain(each.name, paper.name, "PSNR")[0], by_value) if surely else by_value

    found = [each for each in _rivals(arena, paper) if lead_db(each) >= -EQUAL_DB]
    return min(found, key=lambda each: each.value(LATENCY) or 0.0, default=None)


def equal_quality(arena: Arena, paper: Outcome, best: Outcome | None, how: str) -> str:
    """That the fastest of the points that are as good is faster, or that none is."""
    start = f"The paper's shape with the weights of {paper.point.unit.method}, {_of(paper, 'PSNR', LATENCY)}"
    if best is None or (best.value(LATENCY) or 0.0) >= (paper.value(LATENCY) or 0.0):
        return f"{start}: no point told as much reaches its PSNR {how} in less time."
    half = arena.ratio(best.name, paper.name, LATENCY)[1] <= 0.5
    surely = "; less than half the time over the whole interval" if half else ""
    beside = _beside(arena, best, paper, LATENCY, ENERGY)
    return f"{start}, is matched {how} by {best.name} ({_of(best, 'PSNR', LATENCY)}): {beside}{surely}."


def tenth_energy(arena: Arena, paper: Outcome) -> str:
    """The best of the points that take a tenth of its energy, or that there is none."""
    most = ENERGY_SHARE * (paper.value(ENERGY) or 0.0)
    found = [each for each in _rivals(arena, paper) if (each.value(ENERGY) or 0.0) <= most]
    start = f"At a tenth of its energy ({number(most, 3)} of {number(paper.value(ENERGY) or 0.0, 3)} J)"
    if not found:
        cheapest = min(_rivals(arena, paper), key=lambda each: each.value(ENERGY) or 0.0, default=paper)
        return f"{start} there is no point; the least takes {cheapest.name}, {_of(cheapest, ENERGY, 'PSNR')}."
    best = max(found, key=lambda each: each.value("PSNR") or 0.0)
    return f"{start} the best is {best.name} ({_of(best, 'PSNR', ENERGY)}): {_beside(arena, best, paper, ENERGY)}."


def headline(arena: Arena, paper: Outcome | None) -> str:
    """One sentence for a project manager."""
    best = as_good(arena, paper, surely=False) if paper else None
    if paper is None or best is None or (best.value(LATENCY) or 0.0) >= (paper.value(LATENCY) or 0.0):
        return _plain_headline(list(arena.outcomes.values()))
    seconds = "in {} instead of {} s on the board (predicted)"
    swift = seconds.format(*(number(each.value(LATENCY) or 0.0, 2) for each in (best, paper)))
    decibels = " beside ".join(f"{each.value('PSNR') or 0.0:.2f}" for each in (best, paper))
    where = f"tiles of {best.point.tile_px} on {best.point.configuration}"
    return (
        f"{best.point.unit} in {where} restores the swath {swift}, within {EQUAL_DB} dB of the paper's shape: "
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


def _rivals(arena: Arena, paper: Outcome) -> list[Outcome]:
    """The points that compare with the paper's network: see the module."""
    return [
        each
        for each in arena.outcomes.values()
        if each is not paper
        and isinstance(each.board, DpuRun)
        and each.point.configuration == paper.point.configuration
        and each.text["told"] == paper.text["told"]
    ]


def _beside(arena: Arena, a: Outcome, b: Outcome, *costs: str) -> str:
    times = " and ".join(times_words(arena, a.name, b.name, key) for key in costs)
    more = (a.value("PSNR") or 0.0) >= (b.value("PSNR") or 0.0)
    better, worse = (a, b) if more else (b, a)
    return f"{gain_words(arena, better.name, worse.name, 'PSNR')} {'more' if more else 'less'}, for {times}"


def _of(outcome: Outcome, *keys: str) -> str:
    return ", ".join(f"{key} {figure_words(outcome.figures[key])}" for key in keys)
