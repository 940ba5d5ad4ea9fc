"""The battery's outcomes as rows and as Markdown, and what is proven of the pair for every image beside them."""

import math
from collections.abc import Iterable, Sequence

from deploy.stress.battery import Outcome, worst
from deploy.stress.cases import FULL_DN
from deploy.stress.checks import Measure
from deploy.stress.subject import Subject
from profiles.errors import BeersError
from profiles.figures import Figure, Row, by_table, measured, predicted, unavailable
from quant.bounds import Bound, bound_anywhere, bound_inside, correction_bound, layer_bounds
from quant.core import IntCore
from quant.ends import GAIN
from quant.integer import INT32_BITS

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


WRITTEN = "0 to 4095 DN, clipped"
INTERVALS = "proven for every image: interval arithmetic on the file's own weights"


def proof_rows(subject: Subject, outcomes: Iterable[Outcome]) -> list[Row]:
    """Bounds of both networks; where there is none, why."""
    outcomes = list(outcomes)
    return [*_float_rows(subject, outcomes), *_int8_rows(subject, outcomes)]


def overflow_proven(subject: Subject) -> bool:
    """Whether no accumulator of the INT8 file can overflow; True where there is no core to look at."""
    if not isinstance(subject.core, IntCore):
        return True
    return all(bound.bits < INT32_BITS for bound in layer_bounds(subject.core))


def layer_rows(subject: Subject) -> list[Row]:
    """Each integer layer: bits that its accumulator needs at most, and whether it might saturate."""
    if not isinstance(subject.core, IntCore):
        return []
    return [
        Row(
            "integer layers",
            bound.name,
            {"accumulator": _proven(bound.bits, "bits")},
            {
                "can it overflow int32": "no" if bound.bits < INT32_BITS else "YES",
                "can it saturate int8": "perhaps" if bound.saturates else "never",
            },
        )
        for bound in layer_bounds(subject.core)
    ]


def _float_rows(subject: Subject, outcomes: list[Outcome]) -> list[Row]:
    gain = _largest(outcomes, "float32", ("gain", "gain, steepest"))
    if isinstance(subject.graph, BeersError):
        why = str(subject.graph)
        return [Row("proofs", "float32", {"low": unavailable("DN", why), "gain, measured": gain})]
    rows = []
    for name, bound in (("anywhere", bound_anywhere(subject.graph)), ("inside", bound_inside(subject.graph))):
        figures = {**_range(bound), "gain, measured": gain}
        rows.append(Row("proofs", f"float32 before the clip, {name}", figures, {"as written": WRITTEN}))
    return rows


def _int8_rows(subject: Subject, outcomes: list[Outcome]) -> list[Row]:
    if not isinstance(subject.core, IntCore):
        why = "no INT8 file given" if subject.core is None else str(subject.core)
        return [Row("proofs", "INT8", {"low": unavailable("DN", why)})]
    size = FULL_DN * correction_bound(subject.core, GAIN)
    figures = _range(Bound(-size / FULL_DN, 1 + size / FULL_DN, 2 * size + 1))
    figures["gain, measured"] = _largest(outcomes, "INT8", ("gain",))
    return [Row("proofs", "INT8 before the clip", figures, {"as written": WRITTEN})]


def _range(bound: Bound) -> dict[str, Figure]:
    return {
        "low": _proven(FULL_DN * bound.low, "DN"),
        "high": _proven(FULL_DN * bound.high, "DN"),
        "gain, proven": _proven(bound.gain, "DN per DN"),
    }


def _proven(value: float, unit: str) -> Figure:
    """A bound has no interval: it is arithmetic, and true."""
    if not math.isfinite(value):
        return unavailable(unit, "weights that are not finite bound nothing")
    return predicted(value, unit, (value, value), INTERVALS)


def _largest(outcomes: list[Outcome], stage: str, checks: tuple[str, ...]) -> Figure:
    values = [m.value for o in outcomes if o.stage == stage for m in o.measures if m.check in checks]
    if not values:
        return unavailable("DN per DN", f"no case was looked at in {stage}")
    return measured(max(values), "DN per DN", "stress: the largest over the cases")


TITLES = {
    "battery": "Cases and stages",
    "limitations": "Known limitations met",
    "proofs": "Proven for every image",
    "integer layers": "Integer layers",
    "bit flips": "Quality against bit flips",
    "bit flips by layer": "One flip, by layer",
    "bit flips by bit": "One flip, by bit",
    "guards": "What guards cost on the board",
}
NOTES = {
    "battery": "`ok`: every check holds; `limit`: only what a known limitation explains does not; `-`: not looked "
    "at, for whole numbers know no missing pixels and the others are refused before.",
    "proofs": "Loose, but true of every image and every size. `inside` is farther from the border than the receptive "
    "radius.",
    "bit flips": "PSNR, mean and range over patches and injections; one kind of memory at a time. `clamped`: ReLU6 "
    "and the limit of the correction. `all guards`: scrubbing and triple modular redundancy too, before the image; "
    "what flips in the weights after that stays for this tile.",
    "bit flips by layer": "How far one bit moves the restored image, root mean square over a crop of half the "
    "patch's side, no guard on: mean and worst over one number drawn for each of its bits, and over all bits of the "
    "layer's shifts. A flip in a map stays near its place, so a larger crop would make its figure smaller.",
    "bit flips by bit": "The same, over all layers. A shift has six bits.",
    "guards": "ReLU6 only where calibration stays below 96 units. Three rows are the host's time; the DPU is busy "
    "meanwhile, so nothing is lost while the host has time left.",
    "integer layers": "Intervals of whole numbers through the file's weights: true of every image.",
}


def title(table: str) -> str:
    """The title of a table's section: what is shown for its name in the document."""
    return TITLES.get(table, f"{table[:1].upper()}{table[1:]}")


def markdown(rows: Sequence[Row]) -> str:
    """A section for each table."""
    parts = []
    for table, found in by_table(rows).items():
        parts += [f"## {title(table)}\n", *([NOTES[table], ""] if table in NOTES else []), *_table(found), ""]
    return "\n".join(parts)


def _table(rows: Sequence[Row]) -> list[str]:
    keys = list(dict.fromkeys(key for row in rows for key in row.figures))
    words = list(dict.fromkeys(word for row in rows for word in row.text))
    lines = [_line(["", *(_head(key, rows) for key in keys), *words]), _line(["---"] * (1 + len(keys) + len(words)))]
    for row in rows:
        figures = [_cell(row.figures.get(key), alike=len(_kinds(key, rows)) == 1) for key in keys]
        lines.append(_line([row.name, *figures, *(row.text.get(word, "") for word in words)]))
    return lines


def _kinds(key: str, rows: Sequence[Row]) -> set[str]:
    """Unit and mode of a column's figures; a bound that is proven says so."""
    return {_kind(row.figures[key]) for row in rows if key in row.figures}


def _kind(figure: Figure) -> str:
    mode = "proven" if figure.source.startswith("proven") else figure.mode
    return f"{figure.unit}, {mode}"


def _head(key: str, rows: Sequence[Row]) -> str:
    kinds = _kinds(key, rows)
    return f"{key} ({kinds.pop()})" if len(kinds) == 1 else key


def _cell(figure: Figure | None, alike: bool) -> str:
    if figure is None:
        return ""
    if figure.value is None:
        return f"unavailable: {figure.reason}"
    size = abs(figure.value)
    digits = f"{figure.value:.3g}" if size >= 1e6 or 0 < size < 1e-3 else str(figure)
    return digits if alike else f"{digits} {_kind(figure)}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
