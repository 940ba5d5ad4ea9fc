"""What a detection study found as rows of figures, with the paper's beside."""

from collections.abc import Mapping, Sequence
from math import isnan

from deploy.detection.differences import DRAWS, Estimate
from deploy.detection.study import REFERENCE, Comparison
from model.evaluation.methods import DEGRADED
from model.metrics.bootstrap import LEAST_SITES
from profiles.figures import Figure, Row, measured, published, unavailable

PERCENT, POINTS = "%", "points"
"""Units: a share, and a difference of two shares."""

MAIN = "detection"
"""What the tables that answer the question begin with."""

NO_OBJECT = "no object to be found"
NO_LOSS = "no loss that can be told from 0: the interval of reference less degraded holds it"

GAIN, LOSS, REGAINED = "gain over degraded", "loss to reference", "share of loss regained"


def detection_rows(found: Comparison) -> list[Row]:
    """The tables of one sensor: the answer, each row at its own confidence, by class and by size."""
    names = list(found.methods)
    known = {name: method.sensor_known if method else "" for name, method in found.methods.items()}
    scores = found.differences.scores[REFERENCE]
    by_class = {f"ap50 of {name}": name for name, value in scores.by_class.items() if not isnan(value)}
    by_size = {f"ap50 {size}": size for size in scores.by_size}
    return [
        *(_main_row(found, name, known[name]) for name in names),
        *(_own_row(found, name) for name in names),
        *(_split_row(found, "mAP50 by class", name, by_class) for name in names),
        *(_split_row(found, "mAP50 by size", name, by_size) for name in names),
    ]


def main_table(sensor: str) -> str:
    """The name of the table that answers the question for a sensor."""
    return f"{MAIN}, {sensor}"


def _main_row(found: Comparison, name: str, known: str) -> Row:
    """Precision and recall at one confidence for all rows; gains and losses in mAP50, paired."""
    keys = {"mAP50": "ap50", "mAP50-95": "ap", "precision": "precision", "recall": "recall"}
    figures, words = _values(found, name, keys), {"sensor": known} if known else {}
    if name != REFERENCE:
        figures[LOSS] = _figure(found, found.differences.difference(REFERENCE, name, "ap50"), POINTS)
    if name not in (REFERENCE, DEGRADED):
        gain = found.differences.difference(name, DEGRADED, "ap50")
        figures[GAIN] = _figure(found, gain, POINTS)
        figures[REGAINED] = _regained(found, name)
        words["against degraded"] = verdict(gain, found.differences.sites)
    return Row(main_table(found.name), name, figures, words)


def verdict(gain: Estimate, sites: int) -> str:
    """What a paired difference over so many sites says, in a word: a gain whose interval holds 0 is none."""
    if gain.interval is None or sites < LEAST_SITES:
        return "not known: no interval"
    if not gain.told_from_zero:
        return "no difference: the interval holds 0"
    return "a gain" if gain.value > 0 else "a loss"


def _regained(found: Comparison, name: str) -> Figure:
    if found.differences.sites < LEAST_SITES:
        return unavailable(PERCENT, few_sites(found.differences.sites))
    share = found.differences.regained(name, DEGRADED, REFERENCE, "ap50")
    return unavailable(PERCENT, NO_LOSS) if share is None else _figure(found, share)


def few_sites(sites: int) -> str:
    """Why no interval is shown: the rule of `model.metrics.bootstrap`."""
    return f"no interval over sites is shown: of {sites}, fewer than {LEAST_SITES}, none could be trusted"


def _own_row(found: Comparison, name: str) -> Row:
    figures = _values(found, name, {"precision": "own precision", "recall": "own recall"})
    own = found.differences.scores[name].confidence
    known = measured(own, "ratio", "largest mean F1")
    figures["confidence"] = unavailable("ratio", NO_OBJECT) if isnan(own) else known
    return Row(f"each at its own best confidence, {found.name}", name, figures)


def _split_row(found: Comparison, table: str, name: str, keys: Mapping[str, str]) -> Row:
    return Row(f"{table}, {found.name}", name, _values(found, name, {shown: key for key, shown in keys.items()}))


def _values(found: Comparison, name: str, keys: Mapping[str, str]) -> dict[str, Figure]:
    """Scores of a row by the names that are shown."""
    return {shown: _figure(found, found.differences.value(name, key)) for shown, key in keys.items()}


def _figure(found: Comparison, estimate: Estimate, unit: str = PERCENT) -> Figure:
    return share_figure(estimate, len(found.views), found.differences.sites, unit)


def share_figure(estimate: Estimate, images: int, sites: int, unit: str = PERCENT) -> Figure:
    """A share of 0 to 1, or a difference of shares, times 100; with its interval where there are sites enough."""
    if isnan(estimate.value):
        return unavailable(unit, NO_OBJECT)
    source, ends = f"{images} images of {sites} sites", estimate.interval
    if ends is None or sites < LEAST_SITES:
        return measured(100 * estimate.value, unit, source)
    source = f"{source}, 95 % bootstrap interval over sites ({DRAWS} draws)"
    return measured(100 * estimate.value, unit, source, (100 * ends[0], 100 * ends[1]))


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
"""mAP50, what it calls mAP90, precision and recall, in %."""


def paper_rows() -> list[Row]:
    """The paper's table as printed, with what differs."""
    keys = ("mAP50", "mAP90 (sic)", "precision", "recall")
    return [
        Row(
            PAPER_TABLE,
            name,
            {key: published(value, PERCENT, SOURCE) for key, value in zip(keys, values, strict=True)},
            {"what differs": DIFFERS},
        )
        for name, values in PAPER.items()
    ]


PAPER_NOTES = (
    "The paper retrains its detector for each row; here one detector is shown all of them: another question.",
    "The paper's split of DIOR is its own, of one run each, and no interval is given.",
    "mAP90 (sic): the paper does not define it. At 0.69 to 0.71 of mAP50 in all rows it is likely mAP50-95.",
    "The paper's precision of 63.80 is doubtful: F1 is 5.1 points below mAP50 there, elsewhere 1.1 to 2.2 above.",
)


def headline(compared: Sequence[Comparison]) -> str:
    """A sentence a sensor: what was lost, and what the last of the methods brought back."""
    return " ".join(_sentence(found) for found in compared)


def _sentence(found: Comparison) -> str:
    rows = {row.name: row for row in detection_rows(found) if row.table == main_table(found.name)}
    text = f"{found.name}: mAP50 is {rows[REFERENCE].figures['mAP50']} % on reference images"
    text += f" and {rows[DEGRADED].figures[LOSS]} points less on degraded ones"
    last = list(rows.values())[-1]
    if GAIN in last.figures:
        share = last.figures[REGAINED]
        text += f"; {last.name} changes it by {last.figures[GAIN]} points ({last.text['against degraded']}"
        text += f", {share} % of the loss regained)" if share.value is not None else ")"
    return f"{text} (measured)."
