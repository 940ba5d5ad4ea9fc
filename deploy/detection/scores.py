"""How well objects are found: average precision, precision and recall, by class and by size, under any weights.

Everything is a sum over images, each times its weight: with weights of 1 the average precision is that of
pycocotools, with the counts of a bootstrap draw it is that of the images drawn (`differences`). A figure of no
object is NaN.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from deploy.detection.matching import ALL, CONFIDENCES, OVERLAPS, SIZES_PX, ClassMatches, Matched

RECALLS = np.linspace(0.0, 1.0, 101)
"""Where COCO reads precision off, to average it."""


@dataclass(frozen=True)
class Curve:
    """Means over classes at each of `CONFIDENCES`, at an overlap of one half.

    Attributes:
        precision: (1001,) share of what is found that is there; 1 of a class of which nothing is found, as
            Ultralytics has it.
        recall: (1001,) share of what is there that is found.
        f1: (1001,) mean over classes of the harmonic mean of the two.
    """

    precision: np.ndarray
    recall: np.ndarray
    f1: np.ndarray

    def best(self) -> float:
        """The confidence of the largest F1, the lowest one of several; NaN where nothing is labelled."""
        return float("nan") if np.isnan(self.f1).any() else float(CONFIDENCES[np.argmax(self.f1)])

    def at(self, confidence: float) -> tuple[float, float]:
        """Precision and recall at a confidence of 0 to 1; NaN at a NaN."""
        if np.isnan(confidence):
            return float("nan"), float("nan")
        level = int(np.searchsorted(CONFIDENCES, confidence - 1e-9))
        return float(self.precision[level]), float(self.recall[level])


@dataclass(frozen=True)
class Scores:
    """The figures of one row; NaN where there is no object to be found.

    Attributes:
        ap50: average precision at an overlap of 0.5, mean over classes.
        ap: mean of it over overlaps of 0.5 to 0.95 (COCO's AP).
        confidence: that of the row's own best F1.
        own: precision and recall there.
        fixed: precision and recall at the confidence asked for; as `own` where none was.
        by_class: average precision at 0.5, by name.
        by_size: average precision at 0.5, mean over classes, by the keys of `SIZES_PX` other than all.
    """

    ap50: float
    ap: float
    confidence: float
    own: tuple[float, float]
    fixed: tuple[float, float]
    by_class: Mapping[str, float]
    by_size: Mapping[str, float]

    def figures(self) -> dict[str, float]:
        """Every figure by a name of its own."""
        names = ("precision", "recall")
        return {
            "ap50": self.ap50,
            "ap": self.ap,
            **dict(zip(names, self.fixed, strict=True)),
            **{f"own {name}": value for name, value in zip(names, self.own, strict=True)},
            **{f"ap50 of {name}": value for name, value in self.by_class.items()},
            **{f"ap50 {size}": value for size, value in self.by_size.items()},
        }


def score(matched: Matched, weights: np.ndarray | None = None, confidence: float | None = None) -> Scores:
    """Every figure of a row.

    Args:
        matched: of the row.
        weights: (I,) whole numbers, how often each image counts; once where None.
        confidence: where `fixed` is read; the row's own best where None.
    """
    counts = np.ones(len(matched.sites), np.int64) if weights is None else np.asarray(weights, np.int64)
    by_class = np.array([average_precisions(one, counts) for one in matched.by_size[ALL]]).reshape(-1, len(OVERLAPS))
    curve = confidence_curve(matched, counts)
    best = curve.best()
    small = {size: ap50(matched, counts, size) for size in SIZES_PX if size != ALL}
    return Scores(
        ap50=mean(by_class[:, 0]),
        ap=mean(by_class.mean(axis=1)),
        confidence=best,
        own=curve.at(best),
        fixed=curve.at(best if confidence is None else confidence),
        by_class=dict(zip(matched.names, by_class[:, 0].tolist(), strict=True)),
        by_size=small,
    )


def ap50(matched: Matched, weights: np.ndarray, size: str = ALL) -> float:
    """Average precision at an overlap of one half alone, mean over classes; NaN where there is no object.

    Args:
        matched: of a row.
        weights: (I,) how often each image counts.
        size: of the objects, a key of `SIZES_PX`.
    """
    return mean([average_precisions(one, weights, 1)[0] for one in matched.by_size[size]])


def mean(values: Sequence[float] | np.ndarray) -> float:
    """Mean of those that are there; NaN of none."""
    known = np.asarray(values, np.float64)
    known = known[~np.isnan(known)]
    return float(known.mean()) if len(known) else float("nan")


def average_precisions(matches: ClassMatches, weights: np.ndarray, levels: int = len(OVERLAPS)) -> np.ndarray:
    """Average precision of a class at the first `levels` of `OVERLAPS`, (levels,); NaN where it has no object."""
    return np.asarray(precisions(matches, weights, levels).mean(axis=1))


def precisions(matches: ClassMatches, weights: np.ndarray, levels: int = 1) -> np.ndarray:
    """Precision of a class at each of `RECALLS`: the best that is had at that recall or more (COCO).

    Args:
        matches: of the class.
        weights: (I,) how often each image counts.
        levels: how many of `OVERLAPS`, from the first.

    Returns:
        (levels, 101); NaN where the class has no object.
    """
    total = int(weights @ matches.truths)
    if total == 0:
        return np.full((levels, len(RECALLS)), np.nan)
    each = weights[matches.images]
    so_far = np.cumsum(each)
    found = []
    for hits, passed, passed_before in matches.places[:levels]:
        true = np.cumsum(each[hits])
        counted = so_far[hits] - np.concatenate([[0], np.cumsum(each[passed])])[passed_before]
        precision = np.divide(true, counted, out=np.zeros(len(true)), where=counted > 0)
        best = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)  # beyond the last hit there is none
        found.append(best[np.searchsorted(true / total, RECALLS)])
    return np.array(found)


def confidence_curve(matched: Matched, weights: np.ndarray) -> Curve:
    """Precision and recall by confidence, means over the classes of which there is an object.

    Args:
        matched: of the row.
        weights: (I,) how often each image counts.
    """
    known = [one for one in matched.by_size[ALL] if weights @ one.truths > 0]
    if not known:
        nothing = np.full(len(CONFIDENCES), np.nan)
        return Curve(nothing, nothing, nothing)
    precision, recall = np.array([_precision_recall(one, weights) for one in known]).transpose(1, 0, 2)
    both = precision + recall
    f1 = np.divide(2 * precision * recall, both, out=np.zeros_like(both), where=both > 0)
    return Curve(precision.mean(axis=0), recall.mean(axis=0), f1.mean(axis=0))


def _precision_recall(matches: ClassMatches, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    true, counted = matches.steps
    found, hit = (np.bincount(level, weights[image], len(CONFIDENCES)) for level, image in (counted, true))
    found, hit = (np.cumsum(one[::-1])[::-1] for one in (found, hit))
    precision = np.divide(hit, found, out=np.ones(len(CONFIDENCES)), where=found > 0)
    return precision, hit / (weights @ matches.truths)
