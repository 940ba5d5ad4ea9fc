"""Every case through every stage: what was measured, what it is judged to be, and the tables of
both.
"""

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from beers_deploy.model.progress import steps
from beers_deploy.model.traditional.rows import one_thread_per_operation
from beers_deploy.profiles.errors import BeersError, OptionError, printable
from beers_deploy.profiles.figures import Check, Figure, Row, by_table, measured, predicted
from beers_deploy.quant.bounds import layer_bounds
from beers_deploy.quant.integer.reference import INT32_BITS
from beers_deploy.studies.stress.cases import CASES, SIDE_PX, Case
from beers_deploy.studies.stress.checks import Limitation, Measure, limitation_of
from beers_deploy.studies.stress.networks import STAGES, Subject
from beers_deploy.tables.markdown import markdown_table


@dataclass(frozen=True)
class StageResult:
    """One case at one stage: the worst of each check over its images, or why the stage was not
    looked at.
    """

    case: Case
    stage: str
    measures: tuple[Measure, ...]
    reason: str = ""

    @property
    def broken(self) -> list[tuple[Measure, Limitation | None]]:
        """What does not hold, each with the known limitation that explains it."""
        return [
            (m, limitation_of(self.stage, self.case.name, m)) for m in self.measures if not m.holds
        ]

    @property
    def limitations(self) -> list[Limitation]:
        """The known limitations that were met."""
        return list(dict.fromkeys(limit for _, limit in self.broken if limit is not None))

    @property
    def failed(self) -> list[Measure]:
        """What does not hold, and no limitation explains."""
        return [measure for measure, limit in self.broken if limit is None]

    @property
    def verdict(self) -> str:
        """In a word or two."""
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
    """Look at every case at every stage.

    Args:
        subject: the networks.
        cases: what they restore.
        stages: names of STAGES.
        seed: of the images.
        side_px: of images whose case has no size of its own.
    """
    results = []
    reasons = {stage: _cannot_be_looked_at(subject, stage) for stage in stages}
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


def _cannot_be_looked_at(subject: Subject, stage: str) -> str:
    """Why a stage has nothing to look at; empty where it has."""
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
        # A network that refuses a sound image has failed.
        return [Measure(f"refused: {error}", 1, 0, "runs")]
    return measures


def worst(measures: Iterable[Measure]) -> list[Measure]:
    """Of each check the measure that is largest beside what is allowed; NaN is the worst."""
    by_check: dict[str, list[Measure]] = {}
    for measure in measures:
        by_check.setdefault(measure.check, []).append(measure)
    return [max(alike, key=_excess) for alike in by_check.values()]


def _excess(measure: Measure) -> float:
    return math.inf if math.isnan(measure.value) else measure.value - measure.allowed


def chosen(names: str | Sequence[str] | None, known: Iterable[str], option: str) -> list[str]:
    """Return names of a list, or of text with commas; all if None.

    Raises:
        OptionError: a name that is not known.
    """
    every = list(known)
    if names is None:
        return every
    parts = names.split(",") if isinstance(names, str) else names
    selection = [name.strip() for name in parts]
    for name in selection:
        if name not in every:
            raise OptionError(
                f"`{option}` must be some of {', '.join(every)}, separated by commas, but it has "
                f"{printable(repr(name))}."
            )
    return selection


SOURCE = "stress: worst over the images of the case"
INTERVALS = "proven for every image: interval arithmetic on the file's own weights"


def shown_rows(subject: Subject, results: Sequence[StageResult]) -> list[Row]:
    """The tables of a battery in reading order, its findings left out."""
    return [
        *battery_rows(results),
        *worst_rows(results),
        *limitation_rows(results),
        *layer_rows(subject),
    ]


def battery_rows(results: Iterable[StageResult]) -> list[Row]:
    """A row a case, a word a stage."""
    verdicts: dict[str, dict[str, str]] = {}
    for result in results:
        verdicts.setdefault(result.case.name, {})[result.stage] = result.verdict
    return [Row("battery", name, {}, stages) for name, stages in verdicts.items()]


def worst_rows(results: Iterable[StageResult]) -> list[Row]:
    """A row for each check of each stage: its worst value over all cases."""
    by_name: dict[str, list[tuple[Measure, str]]] = {}
    for result in results:
        for measure in result.measures:
            by_name.setdefault(f"{result.stage}: {measure.check}", []).append(
                (measure, result.case.name)
            )
    rows = []
    for name, sizes in by_name.items():
        largest, case = max(sizes, key=lambda pair: _excess(pair[0]))
        text = {"allowed": f"{largest.allowed:.4g} {largest.unit}", "worst case": case}
        text["verdict"] = "holds" if largest.holds else "does not hold"
        rows.append(Row("worst", name, {"worst": _figure(largest)}, text))
    return rows


def limitation_rows(results: Iterable[StageResult]) -> list[Row]:
    """A row for each known limitation that was met, with its largest size."""
    rows: dict[str, Row] = {}
    for result in results:
        for measure, limit in result.broken:
            name = f"{limit.name} ({result.stage}, {measure.check})" if limit else ""
            if limit and (
                name not in rows or measure.value > (rows[name].figures["largest"].value or 0)
            ):
                text = {
                    "in": result.case.name,
                    "fails beyond": f"{limit.ceiling:g}",
                    "means": limit.meaning,
                }
                rows[name] = Row("limitations", name, {"largest": _figure(measure)}, text)
    return list(rows.values())


def finding_rows(results: Iterable[StageResult]) -> list[Row]:
    """Every figure of every case at every stage, for the document."""
    rows = []
    for result in results:
        figures = {measure.check: _figure(measure) for measure in result.measures}
        words = {"verdict": result.verdict} | ({"why": result.reason} if result.reason else {})
        rows.append(Row("findings", f"{result.case.name}, {result.stage}", figures, words))
    return rows


def _figure(measure: Measure) -> Figure:
    return measured(measure.value, measure.unit, SOURCE)


def layer_rows(subject: Subject) -> list[Row]:
    """Each integer layer: bits that its accumulator needs at most, and whether
    it might saturate.
    """
    if _cannot_be_looked_at(subject, "INT8 reference"):
        return []
    rows = []
    for bound in layer_bounds(subject.core):
        bits = predicted(bound.bits, "bits", (bound.bits, bound.bits), INTERVALS)
        overflows = "no" if bound.bits < INT32_BITS else "YES"
        text = {
            "can it overflow int32": overflows,
            "can it saturate int8": "perhaps" if bound.saturates else "never",
        }
        rows.append(Row("integer layers", bound.name, {"accumulator": bits}, text))
    return rows


TITLES = {  # of the sections that are shown, by the names of their tables in the document
    "battery": "Cases and stages",
    "worst": "Worst of each check",
    "limitations": "Known limitations met",
    "integer layers": "Integer layers",
    "bit flips": "Quality against bit flips",
    "guards": "What guards cost on the board",
}
NOTES = {
    "battery": "`ok`: every check holds; `limit`: only what a known limitation explains does "
    "not; `-`: not checked, because integers cannot represent missing pixels, and other invalid "
    "pixels are refused earlier.",
    "bit flips": "PSNR, mean and range over patches and injections; one kind of memory at a "
    "time. `clamped`: ReLU6 "
    "and the limit of the correction. `all guards`: scrubbing and triple modular redundancy "
    "too, before the image; "
    "what flips in the weights after that stays for this tile.",
    "guards": "ReLU6 only where calibration stays below 96 units. Three rows are the host's "
    "time; the DPU is busy "
    "meanwhile, so nothing is lost while the host has time left.",
    "integer layers": "Intervals of integers through the file's weights: true of every image.",
}


def battery_checks(subject: Subject, results: Sequence[StageResult]) -> list[Check]:
    """Return the verdict: what failed, and sums that might overflow."""
    failed = [result for result in results if result.failed]
    words = "; ".join(
        f"{result.case.name}, {result.stage}: {result.verdict.removeprefix('FAILED: ')}"
        for result in failed
    )
    checks = [Check("failures", len(failed), 0, "result", detail=words)]
    # A sum that might overflow is a failure, even if no case makes it overflow.
    overflowing = [
        row.name for row in layer_rows(subject) if row.text["can it overflow int32"] != "no"
    ]
    layers = ", ".join(overflowing)
    checks.append(Check("sums that might overflow", len(overflowing), 0, "layer", detail=layers))
    return checks


def skipped(results: Sequence[StageResult]) -> list[str]:
    """Return a sentence for each reason why a stage was not checked."""
    reasons = dict.fromkeys(result.reason for result in results if result.reason)
    return [f"not checked: {reason}" for reason in reasons]


def markdown(rows: Sequence[Row]) -> str:
    """Return a section for each table."""
    parts = []
    for table, table_rows in by_table(rows).items():
        parts += [
            f"## {TITLES[table]}\n",
            *([NOTES[table], ""] if table in NOTES else []),
            *markdown_table(table_rows),
            "",
        ]
    return "\n".join(parts)
