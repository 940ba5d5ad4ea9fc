"""The battery's outcomes as rows: case by stage, worst measure by check, and the known limitations met."""

import math
from collections.abc import Iterable

from deploy.results import Figure, Row, by_table, measured, unavailable
from deploy.stress.battery import Outcome, worst
from deploy.stress.checks import Measure

COUNT, COUNTED = "count", ("px", "runs", "figures", "layers")
SOURCE = "stress: worst over the images of the case"


def battery_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """A row a case, a word a stage."""
    verdicts: dict[str, dict[str, str]] = {}
    for outcome in outcomes:
        verdicts.setdefault(outcome.case.name, {})[outcome.stage] = outcome.verdict
    return [Row("battery", name, {}, stages) for name, stages in verdicts.items()]


def bound_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """A row for each check of each stage, a table for each unit: its worst value over all cases."""
    found: dict[tuple[str, str], list[tuple[Measure, Outcome]]] = {}
    for outcome in outcomes:
        for measure in outcome.measures:
            found.setdefault((outcome.stage, measure.check), []).append((measure, outcome))
    rows = [_bound_row(stage, check, seen) for (stage, check), seen in found.items()]
    return [row for same in by_table(rows).values() for row in same]


def _bound_row(stage: str, check: str, seen: list[tuple[Measure, Outcome]]) -> Row:
    (chosen,) = worst(measure for measure, _ in seen)
    case = next(outcome.case.name for measure, outcome in seen if measure is chosen)
    unit = COUNT if chosen.unit in COUNTED and chosen.allowed == 0 else chosen.unit or "ratio"
    text = {"allowed": f"{chosen.allowed:.4g} {chosen.unit}".strip(), "worst case": case}
    text["verdict"] = "holds" if chosen.holds else "does not hold"
    return Row(f"worst, {unit}", f"{stage}: {check}", {"worst": _figure(chosen, unit)}, text)


def limitation_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """A row for each known limitation that was met, with its largest size."""
    rows: dict[str, Row] = {}
    for outcome in outcomes:
        for measure in outcome.measures:
            limit = next((known for known in outcome.limitations if measure.check in known.checks), None)
            if measure.holds or limit is None:
                continue
            name = f"{limit.name} ({outcome.stage}, {measure.check})"
            before = rows.get(name)
            if before is None or measure.value > (before.figures["largest"].value or 0):
                text = {"in": outcome.case.name, "fails beyond": f"{limit.ceiling:g}", "means": limit.meaning}
                rows[name] = Row("limitations", name, {"largest": _figure(measure, measure.unit or "ratio")}, text)
    return list(rows.values())


def finding_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """Every figure of every case at every stage, for the document."""
    return [
        Row(
            "findings",
            f"{outcome.case.name}, {outcome.stage}",
            {measure.check: _figure(measure, measure.unit or "ratio") for measure in outcome.measures},
            {"verdict": outcome.verdict, **({"why": outcome.reason} if outcome.reason else {})},
        )
        for outcome in outcomes
    ]


def _figure(measure: Measure, unit: str) -> Figure:
    if not math.isfinite(measure.value):
        return unavailable(unit, f"{measure.check} is not finite")
    return measured(measure.value, unit, SOURCE)
