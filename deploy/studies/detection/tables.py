"""The table of a detection study: its rows of figures, next to the paper's."""

from collections.abc import Mapping, Sequence
from itertools import chain
from math import isnan
from pathlib import Path

import numpy as np

from beers_deploy.model.metrics.statistics import too_few
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.figures import Figure, Row, measured, published, unavailable
from beers_deploy.results import Table
from beers_deploy.studies.detection.average_precision import DRAWS, interval, sites_note
from beers_deploy.studies.detection.detector import Detector
from beers_deploy.studies.detection.matching import SIZES_PX
from beers_deploy.studies.detection.study import REFERENCE, Comparison, LabelledScene
from beers_deploy.studies.evaluation.methods import DEGRADED

PERCENT = "%"
POINTS = "points"
"""The units of a share, and of a difference of two shares."""

MAIN = "detection"
OWN = "each at its own best confidence"
BY_CLASS = "mAP50 by class"
BY_SIZE = "mAP50 by size"
"""The beginning of each table's name, which the sensor's name follows."""

NO_OBJECT = "no object to be found"
NO_LOSS = "no significant loss: the interval of reference minus degraded contains 0"

GAIN = "gain over degraded"
LOSS = "loss to reference"
REGAINED = "share of loss regained"


def detection_table(
    compared: Sequence[Comparison],
    file: Path,
    detector: Detector,
    scenes: Sequence[LabelledScene],
    notes: Sequence[str],
) -> Table:
    """Arrange the figures of a detection study as a table of results.

    Args:
        compared: the results under each sensor.
        file: the path of the detector's file.
        detector: the detector that ran on the scenes.
        scenes: the scenes with their labels.
        notes: sentences that a reader must know about the labels.
    """
    rows = (*chain.from_iterable(map(detection_rows, compared)), *paper_rows())
    remarks = (detector.flag, sites_note(compared[0].sites), *notes, headline(compared))
    tables = {row.table for row in rows}
    return Table(
        inputs=(file, *(scene.path for scene in scenes if scene.path is not None)),
        rows=rows,
        notes=tuple(filter(None, remarks)),
        details=frozenset(name for name in tables if not name.startswith((MAIN, PAPER_TABLE))),
    )


def detection_rows(comparison: Comparison) -> list[Row]:
    """Return the rows of all tables on one sensor.

    The tables are the main result, precision and recall of each row at the confidence that is best
    for it, mAP50 by class, and mAP50 by size of the objects.
    """
    # A class without a labelled object has no average precision.
    by_class = {
        name: key
        for name, key in ((name, f"mAP50 of {name}") for name in comparison.names)
        if not isnan(comparison.figures[REFERENCE][key][0])
    }
    by_size = {name: f"mAP50 {name}" for name in list(SIZES_PX)[1:]}
    own = {"precision": "own precision", "recall": "own recall"}
    rows = [_main_row(comparison, row) for row in comparison.methods]
    for table, keys in ((OWN, own), (BY_CLASS, by_class), (BY_SIZE, by_size)):
        for row in comparison.methods:
            figures = _values(comparison, row, keys)
            if table == OWN:
                confidence = float(comparison.figures[row]["own confidence"][0])
                figures["confidence"] = (
                    unavailable("ratio", NO_OBJECT)
                    if isnan(confidence)
                    else measured(confidence, "ratio", "largest mean F1")
                )
            rows.append(Row(f"{table}, {comparison.name}", row, figures))
    return rows


def _main_row(comparison: Comparison, row: str) -> Row:
    """Return precision and recall at one confidence for all rows, and gains and losses in mAP50,
    paired by draw.
    """
    keys = ("mAP50", "mAP50-95", "precision", "recall")
    figures = _values(comparison, row, dict(zip(keys, keys, strict=True)))
    reference, degraded, own = (
        comparison.figures[name]["mAP50"] for name in (REFERENCE, DEGRADED, row)
    )
    method = comparison.methods[row]
    words = {"sensor": method.sensor_known} if method else {}
    if row != REFERENCE:
        figures[LOSS] = _figure(comparison, reference - own, POINTS)
    if row not in (REFERENCE, DEGRADED):
        figures[GAIN] = _figure(comparison, own - degraded, POINTS)
        figures[REGAINED] = _regained(comparison, own - degraded, reference - degraded)
        words["against degraded"] = verdict(own - degraded, comparison.sites)
    return Row(f"{MAIN}, {comparison.name}", row, figures, words)


def verdict(difference: np.ndarray, sites: int) -> str:
    """State in words if a difference of two rows is a gain, a loss, or none because its interval
    contains 0.

    Args:
        difference: the difference on all images, then on each bootstrap draw, (1 + draws,).
        sites: the number of different sites; with too few there is no interval, and no conclusion.
    """
    ends = interval(difference, sites)
    if ends is None:
        return "not known: no interval"
    if ends[0] <= 0 <= ends[1]:
        return "no difference: the interval holds 0"
    return "a gain" if difference[0] > 0 else "a loss"


def _regained(comparison: Comparison, gain: np.ndarray, loss: np.ndarray) -> Figure:
    """Return the share of a loss that a gain recovers; unavailable if the loss is not
    significant.
    """
    if too_few(comparison.sites):
        return unavailable(PERCENT, too_few(comparison.sites))
    if verdict(loss, comparison.sites) not in ("a gain", "a loss"):
        return unavailable(PERCENT, NO_LOSS)
    # A draw without a loss has no share: it is NaN, and the interval leaves it out.
    return _figure(
        comparison, np.divide(gain, loss, out=np.full(gain.shape, np.nan), where=loss != 0)
    )


def _values(comparison: Comparison, row: str, keys: Mapping[str, str]) -> dict[str, Figure]:
    return {
        column: _figure(comparison, comparison.figures[row][key]) for column, key in keys.items()
    }


def _figure(comparison: Comparison, values: np.ndarray, unit: str = PERCENT) -> Figure:
    """Return a share of 0 to 1, or a difference of two, (1 + draws,), times 100, with its interval
    if there are enough sites.
    """
    if isnan(values[0]):
        return unavailable(unit, NO_OBJECT)
    source = f"{counted(len(comparison.scenes), 'image')} of {counted(comparison.sites, 'site')}"
    ends = interval(values, comparison.sites)
    if ends is None:
        return measured(100 * float(values[0]), unit, source)
    source = f"{source}, 95 % bootstrap interval over sites ({DRAWS} draws)"
    return measured(100 * float(values[0]), unit, source, (100 * ends[0], 100 * ends[1]))


PAPER_TABLE = "the paper's detection"
SOURCE = "ConvBEERS paper, table on DIOR"
DIFFERS = "one YOLOv11n retrained for each row; DIOR, a split of its own"
PAPER = {
    "paper: reference": (75.90, 54.10, 86.60, 69.30),
    "paper: degraded, medium": (73.33, 51.5, 85.00, 66.93),
    "paper: restored, medium": (75.52, 53.88, 87.47, 68.32),
    "paper: degraded, high": (67.30, 46.29, 63.80, 60.70),
    "paper: restored, high": (72.37, 50.57, 85.03, 66.36),
}
PAPER_COLUMNS = ("mAP50", "mAP90 (sic)", "precision", "recall")
"""In %. The paper calls the second one mAP90."""


def paper_rows() -> list[Row]:
    """Return the rows of the detection table that the ConvBEERS paper prints, each with words on
    what differs from this study.
    """
    rows = []
    for name, values in PAPER.items():
        figures = [published(value, PERCENT, SOURCE) for value in values]
        columns = dict(zip(PAPER_COLUMNS, figures, strict=True))
        rows.append(Row(PAPER_TABLE, name, columns, {"what differs": DIFFERS}))
    return rows


PAPER_NOTES = (
    (
        "The paper retrains its detector for each row; here one detector is shown all of them: "
        "another question."
    ),
    "The paper's split of DIOR is its own, of one run each, and no interval is given.",
    (
        "mAP90 (sic): the paper does not define it. At 0.69 to 0.71 of mAP50 in all rows it is "
        "likely mAP50-95."
    ),
    (
        "The paper's precision of 63.80 is doubtful: F1 is 5.1 points below mAP50 there, elsewhere "
        "1.1 to 2.2 above."
    ),
)


def headline(compared: Sequence[Comparison]) -> str:
    """Return the sentences at the top of the page, one for each sensor: the loss of mAP50 by
    degradation, and the part of it that the last of the methods recovers.
    """
    sentences = []
    for comparison in compared:
        rows = {row: _main_row(comparison, row) for row in comparison.methods}
        text = (
            f"{comparison.name}: mAP50 is {rows[REFERENCE].figures['mAP50']} % on reference images "
            f"and {rows[DEGRADED].figures[LOSS]} points less on degraded ones"
        )
        last = list(rows.values())[-1]
        if GAIN in last.figures:
            text += f"; {last.name} changes it by {last.figures[GAIN]} points "
            text += f"({last.text['against degraded']}"
            share = last.figures[REGAINED]
            text += f", {share} % of the loss regained)" if share.value is not None else ")"
        sentences.append(f"{text} (measured).")
    return " ".join(sentences)
