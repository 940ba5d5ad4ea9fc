"""Fronts of an arena, and in words what each step along them costs."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from deploy.results import number
from deploy.tradeoff.outcome import COSTS, QUALITIES, Arena, Plane
from deploy.tradeoff.pareto import Place, beaten, front
from deploy.tradeoff.study import Front

BESIDE = {"board latency": ("board energy",), "board energy": ("board latency",), "host p50": ()}
"""What else a step costs."""


def fronts(arena: Arena) -> tuple[Front, ...]:
    """A front for each pair of a cost and a quality that some points have."""
    return tuple(_fronts(arena))


def _fronts(arena: Arena) -> Iterator[Front]:
    for y in QUALITIES:
        for x in COSTS:
            found = places(arena, x, y)
            if found:
                members = front(found)
                steps = apart(arena, members, x, y)
                yield Front(x, y, members, steps, beaten(found, Plane(arena, x, y)), prices(arena, steps, x, y))


def places(arena: Arena, x: str, y: str) -> list[Place]:
    """The points that have both figures."""
    return [place for outcome in arena.outcomes.values() if (place := outcome.place(x, y))]


def prices(arena: Arena, steps: tuple[str, ...], x: str, y: str) -> tuple[str, ...]:
    """A sentence for each step, from cheap to dear."""
    found = list(pairwise(steps))
    return tuple(_price(arena, *step, x, y, last=step == found[-1]) for step in found)


def apart(arena: Arena, members: Sequence[str], x: str, y: str) -> tuple[str, ...]:
    """Members that are surely better and surely dearer, each than the one before; of those as dear the best."""
    kept = list(members[:1])
    for name in members[1:]:
        if arena.gain(name, kept[-1], y)[0] <= 0:
            continue
        if arena.ratio(name, kept[-1], x)[0] <= 1:
            kept.pop()
        kept.append(name)
    return tuple(kept)


def _price(arena: Arena, cheap: str, dear: str, x: str, y: str, *, last: bool) -> str:
    times = " and ".join(times_words(arena, dear, cheap, key) for key in (x, *BESIDE[x]))
    bought = f"{'The last' if last else 'A step of'} {gain_words(arena, dear, cheap, y)}"
    return f"{bought}, from {cheap} to {dear}, costs {times}."


def gain_words(arena: Arena, better: str, worse: str, key: str) -> str:
    """By how much one point is better, with its interval where there is one: "0.32 dB [0.2, 0.5] of PSNR"."""
    values = [arena.outcomes[name].figures[key] for name in (better, worse)]
    gain = QUALITIES[key] * ((values[0].value or 0.0) - (values[1].value or 0.0))
    low, high = arena.gain(better, worse, key)
    unit = values[0].unit if values[0].unit == "dB" else ""
    interval = f"[{number(low, 2)}, {number(high, 2)}]" if math.isfinite(high - low) else ""
    return " ".join(f"{number(gain, 2)} {unit} {interval} of {key}".split())


def times_words(arena: Arena, a: str, b: str, key: str) -> str:
    """How many times as much one point costs: "2.1 times [1.7, 2.6] the board latency"."""
    low, high = arena.ratio(a, b, key)
    return f"{number(arena.times(a, b, key), 2)} times [{number(low, 2)}, {number(high, 2)}] the {key}"
