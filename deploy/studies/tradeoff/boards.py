"""The best point of each board within the budget compared with the recommended one, or the reason
why it has none.
"""

from collections.abc import Sequence

from beers_deploy.profiles.figures import Row
from beers_deploy.studies.tradeoff.advice import Constraint, Question, choose, nearest, within
from beers_deploy.studies.tradeoff.front import (
    BOARDS,
    Comparison,
    Measured,
    figures_to_compare,
    placed,
)

VERDICT = "verdict"


def board_rows(
    points: Sequence[Measured], boards: Sequence[str], recommended: Measured | None, asked: Question
) -> list[Row]:
    """Return a row for each board: the figures of its best point, and how it compares with the
    recommended one.

    Args:
        points: of all boards.
        boards: names, in the order of the rows.
        recommended: None if there is none.
        asked: budget and need.
    """
    cost = asked.cost(points)
    rows: list[Row] = []
    for board in boards:
        here = [point for point in points if point.text.get("board") == board]
        candidates = within(here, asked.constraints, cost)
        if not candidates:
            reasons = [why_not(here, asked.constraints, cost), *refusals(points, board)]
            rows.append(Row(BOARDS, board, {}, {"point": "none", VERDICT: "; ".join(reasons)}))
            continue
        if recommended is not None and recommended.text.get("board") == board:
            best = recommended
            verdict = "this is the recommended point"
        else:
            best, _ = choose(candidates, asked)
            verdict = _compared(best, recommended, cost, asked.compare)
        words = {"point": best.name, VERDICT: verdict}
        rows.append(Row(BOARDS, board, figures_to_compare(best, cost), words))
    return rows


def refusals(points: Sequence[Measured], board: str) -> list[str]:
    """Return sentences on the networks that a board's DPU refuses, and the reasons."""
    return [
        f"{point.name} does not fit its DPU: {point.point.reason}"
        for point in points
        if point.point is not None and point.point.refused_by == board
    ]


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the rows as sentences: those of several boards, or that of a single one if it has no
    point.
    """
    return [f"{row.name}: {_sentence(row)}" for row in rows if len(rows) > 1 or not row.figures]


def _sentence(row: Row) -> str:
    return f"{row.text['point']}: {row.text[VERDICT]}" if row.figures else row.text[VERDICT]


def why_not(points: Sequence[Measured], constraints: Sequence[Constraint], cost: str) -> str:
    """Return a sentence on the limits that no point of a board complies with, and the closest
    point.
    """
    here = placed(points, cost)
    if not here:
        return f"no point has both a PSNR and a {cost}"
    limits = " and ".join(map(str, constraints))
    return f"no point keeps {limits}{nearest(here, constraints)}"


def _compared(point: Measured, recommended: Measured | None, cost: str, compare: Comparison) -> str:
    if recommended is None:  # its cost or PSNR is missing where another board's points are compared
        return "within the limits"
    difference = compare.difference(point, recommended)
    ratio = point.value(cost) / recommended.value(cost)
    quality = f"PSNR {difference} dB against" if difference.value else "the PSNR of"
    return f"{quality} the recommended point, for {ratio:.3g} times its {cost}"
