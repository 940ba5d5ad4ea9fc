"""Run every case through every stage, evaluate the measurements, and make the tables of both."""

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.model.traditional.rows import one_thread_per_operation
from beers_deploy.profiles.errors import BeersError, OptionError, listed, printable
from beers_deploy.profiles.figures import Check, Figure, Row, measured, predicted
from beers_deploy.quant.bounds import layer_bounds
from beers_deploy.quant.integer.reference import INT32_BITS
from beers_deploy.results import Table
from beers_deploy.studies.stress.cases import CASES, SIDE_PX, Case
from beers_deploy.studies.stress.checks import Limitation, Measure, limitation_of
from beers_deploy.studies.stress.networks import Subject
from beers_deploy.studies.stress.stages import STAGES


@dataclass(frozen=True)
class StageResult:
    """The result of one hard case at one stage, one way of running the networks.

    Attributes:
        case: the hard case, a kind of images.
        stage: the name of the stage, one of `STAGES`.
        measures: the worst value of each check over the images of the case; empty if nothing was
            checked.
        reason: the reason why the stage could not be checked; empty if it could.
    """

    case: Case
    stage: str
    measures: tuple[Measure, ...]
    reason: str = ""

    @property
    def broken(self) -> list[tuple[Measure, Limitation | None]]:
        """The measures that exceed their bounds, each with the known limitation that explains it,
        or with None if it is a failure.
        """
        return [
            (m, limitation_of(self.stage, self.case.name, m)) for m in self.measures if not m.holds
        ]

    @property
    def limitations(self) -> list[Limitation]:
        """The known limitations that explain measures outside their bounds, each once."""
        return list(dict.fromkeys(limit for _, limit in self.broken if limit is not None))

    @property
    def failed(self) -> list[Measure]:
        """The measures that exceed their bounds and that no limitation explains."""
        return [measure for measure, limit in self.broken if limit is None]

    @property
    def verdict(self) -> str:
        """The result in a few words, as tables show it: ok, a limitation, FAILED, or - if nothing
        was checked.
        """
        if self.failed:
            return "FAILED: " + ", ".join(measure.check for measure in self.failed)
        if self.limitations:
            return "limit: " + ", ".join(limit.name for limit in self.limitations)
        return "ok" if self.measures else "-"


def run_battery(
    subject: Subject,
    cases: Sequence[Case] = CASES,
    stages: Sequence[str] = tuple(STAGES),
    seed: int = 0,
    side_px: int = SIDE_PX,
) -> list[StageResult]:
    """Draw the images of every hard case, and check the networks on them at every stage.

    Args:
        subject: the networks under test.
        cases: the hard cases.
        stages: the names of the stages, from `STAGES`.
        seed: the seed of the images.
        side_px: the side in pixels of images whose case states no size.

    Returns:
        A result for each case at each stage, case by case. Failures are part of the results; they
        raise no error.
    """
    results = []
    reasons = {stage: _obstacle(subject, stage) for stage in stages}
    # On images this small a second thread only waits.
    with one_thread_per_operation(), steps("stressing", len(cases) * len(stages)) as bar:
        for case in cases:
            # Seeded by its name: a case draws the same images whichever others are asked for.
            generator = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
            images = case.draw(side_px, generator)
            for stage in stages:
                measures = [] if reasons[stage] else _measures(subject, case, stage, images)
                results.append(StageResult(case, stage, tuple(worst(measures)), reasons[stage]))
                bar.advance(1, f"{case.name}, {stage}")
    return results


def _obstacle(subject: Subject, stage: str) -> str:
    """Return the reason why a stage cannot be checked, or "" if it can."""
    try:
        if stage == "INT8":
            _ = subject.quantized
        elif stage == "INT8 reference":
            _ = subject.core
    except BeersError as error:
        return str(error)
    return ""


def _measures(
    subject: Subject, case: Case, stage: str, images: Iterable[np.ndarray]
) -> list[Measure]:
    measures: list[Measure] = []
    try:
        for image in images:
            measures += STAGES[stage](subject, case, image)
    except BeersError as error:
        # A network that refuses a valid image has failed.
        return [Measure(f"refused: {error}", 1, 0, "runs")]
    return measures


def worst(measures: Iterable[Measure]) -> list[Measure]:
    """Return for each check, of all its measures, the one that exceeds its bound most. NaN counts
    as the worst.
    """
    by_check: dict[str, list[Measure]] = {}
    for measure in measures:
        by_check.setdefault(measure.check, []).append(measure)
    return [max(alike, key=_excess) for alike in by_check.values()]


def _excess(measure: Measure) -> float:
    return math.inf if math.isnan(measure.value) else measure.value - measure.allowed


def chosen(names: str | Sequence[str] | None, available: Iterable[str], option: str) -> list[str]:
    """Return the names that a user chooses from the available ones.

    Args:
        names: a list of names, or a text of names separated by commas; None chooses all.
        available: the names that may be chosen.
        option: the name of the option, for messages.

    Raises:
        OptionError: a name is not available.
    """
    every = list(available)
    if names is None:
        return every
    selection = listed(names)
    for name in selection:
        if name not in every:
            raise OptionError(
                f"`{option}` has no {printable(repr(name))}. Give some of {', '.join(every)}, "
                "separated by commas."
            )
    return selection


SOURCE = "stress: worst over the images of the case"
INTERVALS = "proven for every image: interval arithmetic on the file's own weights"
HEADINGS = {
    "battery": "Cases and stages",
    "worst": "Worst of each check",
    "limitations": "Known limitations met",
    "integer layers": "Integer layers",
}
LEGEND = (
    "ok: every check holds; limit: only what a known limitation explains does not; -: not "
    "checked, because integers cannot represent missing pixels, and other invalid pixels are "
    "refused earlier."
)


def battery_table(
    subject: Subject, cases: Sequence[Case], stages: Sequence[str], seed: int, side_px: int
) -> Table:
    """Check the networks on every hard case, and return the results as `stress` reports them.

    The tables are a row for each case, the worst value of each check, the known limitations that
    were reached, the integer layers, and in detail every figure of every case at every stage. The
    checks of the table fail if a case fails or a sum of integers might overflow.

    Args:
        subject: the networks under test.
        cases: the hard cases.
        stages: the names of the stages, from `STAGES`.
        seed: the seed of the images.
        side_px: the side in pixels of images whose case states no size.

    Raises:
        OptionError: nothing is checked of these cases at these stages.
    """
    results = run_battery(subject, cases, stages, seed, side_px)
    reasons = dict.fromkeys(result.reason for result in results if result.reason)
    # Without a measurement every check would pass.
    if not any(result.measures for result in results):
        why = "".join(f" {reason}" for reason in reasons)
        raise OptionError(
            f"Nothing is checked of the chosen cases at {', '.join(stages)}."
            f"{why or ' Choose other `cases` or `stages`.'}"
        )
    layers = layer_rows(subject)
    failed = [
        f"{result.case.name}, {result.stage}: {result.verdict.removeprefix('FAILED: ')}"
        for result in results
        if result.failed
    ]
    # A sum that might overflow is a failure, even if no case makes it overflow.
    overflowing = [row.name for row in layers if row.text["can it overflow int32"] != "no"]
    checks = [Check("failures", len(failed), 0, "result", detail="; ".join(failed))]
    # A float network alone has no such sums.
    if layers:
        detail = ", ".join(overflowing)
        checks.append(
            Check("sums that might overflow", len(overflowing), 0, "layer", detail=detail)
        )
    return Table(
        command="stress",
        inputs=subject.inputs,
        rows=(
            *battery_rows(results),
            *worst_rows(results),
            *limitation_rows(results),
            *layers,
            *finding_rows(results),
        ),
        checks=tuple(checks),
        notes=tuple(f"not checked: {reason}" for reason in reasons),
        headings=HEADINGS,
        captions={HEADINGS["battery"]: LEGEND},
        details=frozenset({"findings"}),
    )


def battery_rows(results: Iterable[StageResult]) -> list[Row]:
    """Return a row for each hard case, with the verdict in words for each stage."""
    verdicts: dict[str, dict[str, str]] = {}
    for result in results:
        verdicts.setdefault(result.case.name, {})[result.stage] = result.verdict
    return [Row("battery", name, {}, stages) for name, stages in verdicts.items()]


def worst_rows(results: Iterable[StageResult]) -> list[Row]:
    """Return a row for each check of each stage: its worst value over all cases, the bound, and the
    case.
    """
    worst_of: dict[str, tuple[Measure, str]] = {}
    for result in results:
        for measure in result.measures:
            name = f"{result.stage}: {measure.check}"
            if name not in worst_of or _excess(measure) > _excess(worst_of[name][0]):
                worst_of[name] = measure, result.case.name
    rows = []
    for name, (largest, case) in worst_of.items():
        text = {
            "allowed": f"{largest.allowed:.4g} {largest.unit}",
            "worst case": case,
            "verdict": "holds" if largest.holds else "does not hold",
        }
        rows.append(Row("worst", name, {"worst": _figure(largest)}, text))
    return rows


def limitation_rows(results: Iterable[StageResult]) -> list[Row]:
    """Return a row for each known limitation that explains a measure outside its bound, with the
    largest such measure, the case, and its meaning for a user.
    """
    largest: dict[str, tuple[Measure, Limitation, str]] = {}
    for result in results:
        for measure, limit in result.broken:
            if limit is None:
                continue
            name = f"{limit.name} ({result.stage}, {measure.check})"
            if name not in largest or measure.value > largest[name][0].value:
                largest[name] = (measure, limit, result.case.name)
    rows = []
    for name, (measure, limit, case) in largest.items():
        text = {"in": case, "fails beyond": f"{limit.ceiling:g}", "means": limit.meaning}
        rows.append(Row("limitations", name, {"largest": _figure(measure)}, text))
    return rows


def finding_rows(results: Iterable[StageResult]) -> list[Row]:
    """Return a row for each case at each stage with all its figures, for the JSON document."""
    rows = []
    for result in results:
        figures = {measure.check: _figure(measure) for measure in result.measures}
        words = {"verdict": result.verdict} | ({"why": result.reason} if result.reason else {})
        rows.append(Row("findings", f"{result.case.name}, {result.stage}", figures, words))
    return rows


def _figure(measure: Measure) -> Figure:
    return measured(measure.value, measure.unit, SOURCE)


def layer_rows(subject: Subject) -> list[Row]:
    """Return a row for each integer layer of the INT8 network: the number of bits that its
    accumulator needs at most, and in words if it might overflow int32 or saturate int8.

    The rows hold for every image, by interval arithmetic. There are none without an integer core.
    """
    if _obstacle(subject, "INT8 reference"):
        return []
    rows = []
    for bound in layer_bounds(subject.core):
        bits = predicted(bound.bits, "bits", (bound.bits, bound.bits), INTERVALS)
        text = {
            "can it overflow int32": "no" if bound.bits < INT32_BITS else "YES",
            "can it saturate int8": "perhaps" if bound.saturates else "never",
        }
        rows.append(Row("integer layers", bound.name, {"accumulator": bits}, text))
    return rows
