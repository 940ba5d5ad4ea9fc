"""What each board offers within the budget: its best point compared with the recommended one, or
why it has none.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from beers_deploy.profiles.figures import Row
from beers_deploy.studies.tradeoff.advice import (
    Comparison,
    Constraint,
    Measured,
    choose,
    chosen_cost,
    figures_to_compare,
    nearest,
    placed,
    within,
)

TABLE = "boards"
VERDICT = "verdict"


@dataclass(frozen=True)
class Question:
    """What was asked of all boards alike.

    Attributes:
        budget: what can be afforded.
        need: what must be reached.
        compare: tells which of two points is better.
    """

    budget: Sequence[Constraint]
    need: Sequence[Constraint]
    compare: Comparison

    @property
    def constraints(self) -> list[Constraint]:
        """Budget and need together."""
        return [*self.budget, *self.need]


def board_rows(
    points: Sequence[Measured], boards: Sequence[str], taken: Measured | None, asked: Question
) -> list[Row]:
    """Return a row for each board: the figures of its best point, and how it compares with the
    recommended one.

    Args:
        points: of all boards.
        boards: names, in the order of the rows.
        taken: the recommended point, None if there is none.
        asked: budget and need.
    """
    cost = chosen_cost(points, asked.budget)
    rows: list[Row] = []
    for board in boards:
        here = [point for point in points if point.text.get("board") == board]
        kept = within(here, asked.constraints, cost)
        if not kept:
            reasons = [why_not(here, asked.constraints, cost), *refusals(points, board)]
            rows.append(Row(TABLE, board, {}, {"point": "none", VERDICT: "; ".join(reasons)}))
            continue
        if taken is not None and taken.text.get("board") == board:
            best = taken
            verdict = "this is the recommended point"
        else:
            best, _ = choose(kept, asked.compare, cheapest=bool(asked.need) and not asked.budget)
            verdict = _compared(best, taken, cost, asked.compare)
        rows.append(
            Row(
                TABLE, board, figures_to_compare(best, cost), {"point": best.name, VERDICT: verdict}
            )
        )
    return rows


def refusals(points: Sequence[Measured], board: str) -> list[str]:
    """Say which networks a board's DPU refuses, and why."""
    refused = (each for each in points if each.point is not None and each.point.refused_by == board)
    return [
        f"{each.name} does not fit its DPU: {each.point.reason}" for each in refused if each.point
    ]


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the rows as sentences: those of several boards, and that of a single one only if it
    has no point.
    """
    shown = [row for row in rows if len(rows) > 1 or not row.figures]
    return [f"{row.name}: {_sentence(row)}" for row in shown]


def _sentence(row: Row) -> str:
    return f"{row.text['point']}: {row.text[VERDICT]}" if row.figures else row.text[VERDICT]


def why_not(points: Sequence[Measured], constraints: Sequence[Constraint], cost: str) -> str:
    """Say which constraint no point of a board keeps, and what comes closest to it."""
    here = placed(points, cost)
    if not here:
        return f"no point has both a PSNR and a {cost}"
    missed = [each for each in constraints if all(each.violation(point) for point in here)]
    if missed:
        return "; ".join(_missed(each, here) for each in missed)
    return (
        f"no point keeps {' and '.join(map(str, constraints))} at once{nearest(here, constraints)}"
    )


def _missed(constraint: Constraint, points: Sequence[Measured]) -> str:
    known = [point for point in points if not math.isnan(point.value(constraint.key))]
    if not known:
        figure = points[0].figures.get(constraint.key)
        return f"no point has the figure {constraint.key}{f': {figure.reason}' if figure else ''}"
    closest = min(known, key=constraint.violation)
    extreme = "least" if constraint.at_most else "most"
    found = closest.value(constraint.key)
    return (
        f"no point within {constraint}: the {extreme} is {constraint.in_words(found)} "
        f"({closest.name})"
    )


def _compared(point: Measured, taken: Measured | None, cost: str, compare: Comparison) -> str:
    if taken is None:  # its cost or PSNR is missing where another board's points are compared
        return "within the limits"
    difference = compare.difference(point, taken)
    ratio = point.value(cost) / taken.value(cost)
    quality = f"PSNR {difference} dB against" if difference.value else "the PSNR of"
    return f"{quality} the recommended point, for {ratio:.3g} times its {cost}"
