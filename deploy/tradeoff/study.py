"""What one run of `tradeoff` found: its fronts with what their steps cost, and all else that its report shows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from deploy.tradeoff.outcome import (
    COSTS,
    DIFFERENCE_UNITS,
    DIRECTIONS,
    Outcome,
    Place,
    Plane,
    Results,
    dominated,
    front,
)
from profiles.figures import Figure, Row, number, unavailable


@dataclass(frozen=True)
class Difference:
    """The quality of a point less that of another, with the interval of the paired difference."""

    against: str
    figure: Figure


@dataclass(frozen=True)
class Front:
    """The points that none dominates in two figures.

    Attributes:
        x: key of the figure that is paid, "board latency".
        y: key of the figure that is bought, "PSNR".
        members: names of the points on the front by their values, along x from cheap to dear.
        steps: those of them that are better and dearer than the one before beyond the intervals.
        dominated: name of a point to the name of one that dominates it beyond the intervals.
        prices: a sentence on what each step costs.
        alike: a sentence on each two neighbours on the front that the images cannot tell apart.
        differences: of a point from the front just before it: the dearest member that costs no more than it does.
    """

    x: str
    y: str
    members: tuple[str, ...]
    steps: tuple[str, ...]
    dominated: Mapping[str, str]
    prices: tuple[str, ...]
    alike: tuple[str, ...] = ()
    differences: Mapping[str, Difference] = field(default_factory=dict)


@dataclass(frozen=True)
class Crop:
    """The same place of one image as a point restores it; also the degraded input and the reference.

    Attributes:
        point: name of the point, "degraded" or "reference".
        title: what to write above it.
        dn: (h, w) float32 digital numbers.
        psnr_db: of this crop against the reference's; None for the reference.
    """

    point: str
    title: str
    dn: np.ndarray
    psnr_db: float | None


@dataclass(frozen=True)
class Study:
    """All that one run of `tradeoff` found.

    Attributes:
        headline: one sentence for a project manager: which point to take, and what the next step costs.
        points: a row of the table "points" each.
        fronts: one for each pair of axes.
        advice: sentences: the best point for the budget or the need, and what it would take to do better.
        crops: pictures of chosen points.
        layers: time of each layer on the board, by network.
        placement: what runs where, by network.
        notes: limits, and how to read it.
        boards: the networks on every configuration of the boards asked for, a row of the table "boards" each.
        recommended: what to take on each board for each quality, a row each with its sentence.
        against: the point that all are held against; empty where there is none.
        differences: the qualities of each point less those of that one, a row each.
    """

    headline: str
    points: tuple[Row, ...]
    fronts: tuple[Front, ...]
    advice: tuple[str, ...]
    crops: tuple[Crop, ...]
    layers: Mapping[str, tuple[Row, ...]]
    placement: Mapping[str, tuple[Row, ...]]
    notes: tuple[str, ...]
    boards: tuple[Row, ...] = ()
    recommended: tuple[Row, ...] = ()
    against: str = ""
    differences: tuple[Row, ...] = ()


BESIDE = {"board latency": ("board energy",), "board energy": ("board latency",), "host p50": ()}
"""What else a step costs."""
CHEAPER = {"board latency": "faster", "board energy": "thriftier", "host p50": "faster"}
"""What a point is called that costs less."""


def fronts(results: Results) -> tuple[Front, ...]:
    """A front for each pair of a cost and a quality that some points have."""
    return tuple(_fronts(results))


def _fronts(results: Results) -> Iterator[Front]:
    for y in DIRECTIONS:
        for x in COSTS:
            found = places(results, x, y)
            if found:
                yield _front(results, found, x, y)


def _front(results: Results, found: Sequence[Place], x: str, y: str) -> Front:
    members = front(found)
    steps = apart(results, members, x, y)
    beaten = dominated(found, Plane(results, x, y))
    words = prices(results, steps, x, y), alike(results, members, x, y)
    return Front(x, y, members, steps, beaten, *words, differences(results, found, members, y))


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


def alike(results: Results, members: Sequence[str], x: str, y: str) -> tuple[str, ...]:
    """A sentence for each two neighbours whose paired interval holds 0."""
    return tuple(
        f"{cheap} and {dear} cannot be told apart on these images: {gain_words(results, dear, cheap, y)}. "
        f"Take {cheap}, the {CHEAPER[x]}."
        for cheap, dear in pairwise(members)
        if -math.inf < results.gain(dear, cheap, y)[0] <= 0
    )


def differences(results: Results, found: Sequence[Place], members: Sequence[str], y: str) -> Mapping[str, Difference]:
    """Of each point from the front just before it; none of the cheapest."""
    cost, before = {place.name: place.cost for place in found}, dict[str, str]()
    for place in found:
        reached = [name for name in members if cost[name] <= place.cost and name != place.name]
        before |= {place.name: reached[-1]} if reached else {}
    return {name: Difference(other, results.difference(name, other, y)) for name, other in before.items()}


def held_against(results: Results, method: str | None) -> str:
    """The point of a method with the best PSNR; of the traditional chains, which know both sensors, if None.

    Empty where none has a PSNR.
    """
    known = [each for each in results.outcomes.values() if each.value("PSNR") is not None]
    chosen = [each for each in known if method in (None, each.point.variant.method)]
    rivals = [each for each in chosen if method or each.point.variant.kind == "chain"]
    return max(rivals, key=lambda each: each.value("PSNR") or 0.0).name if rivals else ""


def difference_rows(results: Results, against: str) -> tuple[Row, ...]:
    """Each point's qualities less those of another point, on the same images."""
    if not against:
        return ()
    return tuple(
        Row("differences", name, _differences(results, outcome, against), {"against": against})
        for name, outcome in results.outcomes.items()
    )


def _differences(results: Results, outcome: Outcome, against: str) -> dict[str, Figure]:
    had = [key for key in DIRECTIONS if key in outcome.figures]
    return {f"{key} difference": results.difference(outcome.name, against, key) for key in had}


def front_rows(study: Study, front: Front) -> tuple[Row, ...]:
    """A front's members, each with its paired differences from the one before and from what all are held against."""
    points, held = ({row.name: row.figures for row in rows} for rows in (study.points, study.differences))
    return tuple(
        Row(
            f"front of {front.y} against {front.x}",
            name,
            {key: points[name][key] for key in (front.x, front.y)} | _beside(front, name, held.get(name, {})),
            {"before": front.differences[name].against if name in front.differences else "none"},
        )
        for name in front.members
    )


def _beside(front: Front, name: str, held: Mapping[str, Figure]) -> dict[str, Figure]:
    before, key = front.differences.get(name), f"{front.y} difference"
    step = before.figure if before else unavailable("", "the cheapest point of the front: none is before it")
    return {f"{key} from the one before": step} | ({key: held[key]} if key in held else {})


def _price(results: Results, cheap: str, dear: str, x: str, y: str, *, last: bool) -> str:
    times = " and ".join(times_words(results, dear, cheap, key) for key in (x, *BESIDE[x]))
    bought = f"{'The last' if last else 'A step of'} {gain_words(results, dear, cheap, y)}"
    return f"{bought}, from {cheap} to {dear}, costs {times}."


def gain_words(results: Results, better: str, worse: str, key: str) -> str:
    """By how much one point is better, with its interval where there is one: "0.32 dB [0.2, 0.5] of PSNR"."""
    values = [results.outcomes[name].figures[key] for name in (better, worse)]
    gain = DIRECTIONS[key] * ((values[0].value or 0.0) - (values[1].value or 0.0))
    low, high = results.gain(better, worse, key)
    unit = DIFFERENCE_UNITS.get(values[0].unit, "dB" if values[0].unit == "dB" else "")
    interval = f"[{number(low, 2)}, {number(high, 2)}]" if math.isfinite(high - low) else ""
    return " ".join(f"{number(gain, 2)} {unit} {interval} of {key}".split())


def times_words(results: Results, a: str, b: str, key: str) -> str:
    """How many times as much one point costs: "2.1 times [1.7, 2.6] the board latency"."""
    low, high = results.ratio(a, b, key)
    return f"{number(results.times(a, b, key), 2)} times [{number(low, 2)}, {number(high, 2)}] the {key}"


def figure_words(figure: Figure) -> str:
    """A figure with its interval and unit."""
    unit = "" if figure.unit in ("ratio", "distance") else f" {figure.unit}"
    return f"{figure}{unit if figure.value is not None else ''}"
