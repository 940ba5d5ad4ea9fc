"""Average precision, precision and recall, by class and by size, with a bootstrap over sites.

Every figure is a weighted sum over images of what `matching` found. With weights of 1 the average
precision is that of pycocotools. With the counts of a bootstrap draw it is that of the images drawn
(Everingham et al., IJCV 111, 2015, section 3.5). A mean average precision is not a mean over
images, so each draw is scored again.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array

from beers_deploy.model.metrics.statistics import LEAST_SITES, percentiles, too_few
from beers_deploy.profiles.errors import counted
from beers_deploy.studies.detection.matching import ALL, OVERLAPS, SIZES_PX, Hits

RECALLS = np.linspace(0.0, 1.0, 101)
"""The recalls at which COCO samples precision, to average it."""
CONFIDENCES = np.linspace(0.0, 1.0, 1001)
"""The confidences at which precision and recall are sampled. A detection counts at confidences up
to its score.
"""
DRAWS = 1000
FEW_SITES = 10
"""With fewer sites the percentiles of a bootstrap are too narrow to be trusted, and a note reports
it.
"""

Figures = Mapping[str, np.ndarray]
"""The figures of a row by name, (1 + draws,) each: on all images, then on each draw. They are NaN
if there is no object.
"""


def site_weights(sites: Sequence[str], seed: int) -> np.ndarray:
    """Draw the weights of images for a bootstrap over sites, which gives the intervals of figures.

    Args:
        sites: the site of each of I images; images of one site resemble one another.
        seed: the seed of the draws.

    Returns:
        The weights, (1 + DRAWS, I) integers: a row of ones for the figure itself, then for each
        draw, with replacement of as many sites as there are, the number of times that it contains
        the site of the image.
    """
    names, site = np.unique(np.array(sites), return_inverse=True)
    generator = np.random.default_rng(seed)
    counts = generator.multinomial(len(names), np.full(len(names), 1 / len(names)), size=DRAWS)
    # Images of one site share its count: the bootstrap draws whole sites.
    return np.vstack([np.ones(len(sites), np.int64), counts[:, site]])


def interval(values: np.ndarray, sites: int) -> tuple[float, float] | None:
    """Return the 95 % interval of a figure, or of a difference of two figures, from its bootstrap.

    Args:
        values: the figure on all images, then on each draw of the bootstrap, (1 + draws,).
        sites: the number of different sites.

    Returns:
        The percentiles of the draws; None if the figure is NaN, or if there are fewer than
        `LEAST_SITES` sites, because the interval could not be trusted.
    """
    defined = values[1:][~np.isnan(values[1:])]
    if np.isnan(values[0]) or sites < LEAST_SITES or not len(defined):
        return None
    return percentiles(defined)


def sites_note(sites: int) -> str:
    """Return a sentence for the reader of the results if bootstrap intervals over `sites` different
    sites are missing or too narrow to be trusted; else an empty text.
    """
    few = (
        f"Only {counted(sites, 'site')}: the intervals are too narrow to be trusted."
        if sites < FEW_SITES
        else ""
    )
    return too_few(sites) or few


def score_rows(
    rows: Mapping[str, Hits], names: Sequence[str], weights: np.ndarray
) -> tuple[dict[str, Figures], float]:
    """Compute all figures of several rows of a study, which show the same scenes in different ways.

    Precision and recall of all rows are sampled at one confidence, that of the best F1 of the first
    row on all images.

    Args:
        rows: the matched detections of each row, by the name of the row.
        names: the names of the classes.
        weights: the weights of the images, (W, I), as `site_weights` returns them.

    Returns:
        The figures of each row, as `score` returns them, and the confidence.
    """
    confidence = float(score(next(iter(rows.values())), names, weights[:1])["own confidence"][0])
    return {row: score(hits, names, weights, confidence) for row, hits in rows.items()}, confidence


def score(
    hits: Hits, names: Sequence[str], weights: np.ndarray, confidence: float = 0.0
) -> Figures:
    """Compute all figures of one row of a study: average precisions, precision and recall.

    Args:
        hits: the matched detections of the row.
        names: the names of the classes.
        weights: the weights of the images, (W, I) integers, as `site_weights` returns them.
        confidence: the confidence at which `precision` and `recall` are sampled. `own precision`
            and `own recall` are sampled at `own confidence`, that of the row's best F1.

    Returns:
        The figures by name, shares of 0 to 1, (W,) each: for each set of weights one value, NaN if
        there is no object.
    """
    every = len(OVERLAPS)
    by_class = np.array(
        [precisions(hits, kind, weights, ALL, every).mean(axis=-1) for kind in range(len(names))]
    )
    curves = _confidence_curves(hits, weights)
    # The confidence lies on the grid. The margin prevents that rounding selects the next level.
    fixed = np.searchsorted(CONFIDENCES, np.nan_to_num(confidence) - 1e-9)
    # It is 0 where nothing is labelled, and there the curves are NaN.
    own = np.argmax(curves[2], axis=-1)
    own_precision, own_recall, own_f1 = curves[:, np.arange(len(weights)), own]
    return {
        "mAP50": mean_known(by_class[..., 0]),
        "mAP50-95": mean_known(by_class.mean(axis=-1)),
        "precision": curves[0, :, fixed],
        "recall": curves[1, :, fixed],
        "own confidence": np.where(np.isnan(own_f1), np.nan, CONFIDENCES[own]),
        "own precision": own_precision,
        "own recall": own_recall,
        **{
            f"mAP50 of {name}": values for name, values in zip(names, by_class[..., 0], strict=True)
        },
        **{
            f"mAP50 {name}": map50(hits, weights, size)
            for size, name in enumerate(SIZES_PX)
            if size != ALL
        },
    }


def map50(hits: Hits, weights: np.ndarray, size: int = ALL) -> np.ndarray:
    """Compute mAP50, the average precision at an overlap of one half, mean over classes.

    Args:
        hits: the matched detections.
        weights: the weights of the images, (W, I), as `site_weights` returns them.
        size: the index of the range of object sizes in `SIZES_PX`; by default all sizes.

    Returns:
        The share of 0 to 1 for each set of weights, (W,); NaN if there is no object.
    """
    kinds = range(hits.objects.shape[1])
    return mean_known(
        np.array([precisions(hits, kind, weights, size)[:, 0].mean(axis=-1) for kind in kinds])
    )


def mean_known(values: np.ndarray) -> np.ndarray:
    """Return the mean over the first axis of the values that are not NaN, or NaN if there are
    none.
    """
    return np.asarray(np.ma.filled(np.ma.masked_invalid(values).mean(axis=0), np.nan))


def precisions(
    hits: Hits, kind: int, weights: np.ndarray, size: int, levels: int = 1
) -> np.ndarray:
    """Compute the precision of one class at each of `RECALLS`: the best precision at this recall or
    a higher one, as COCO defines it.

    Args:
        hits: the matched detections.
        kind: the index of the class.
        weights: the weights of the images, (W, I), as `site_weights` returns them.
        size: the index of the range of object sizes in `SIZES_PX`; by default all sizes.
        levels: the number of `OVERLAPS` to use, from the first; by default only one half.

    Returns:
        The precisions of 0 to 1, (W, levels, 101); NaN if the class has no object.
    """
    totals = weights @ hits.objects[size, kind]
    curves = np.full((len(weights), levels, len(RECALLS)), np.nan)
    for level in range(levels):
        counted = np.flatnonzero((hits.classes == kind) & ~hits.ignored[size, level])
        # Stable, so that equal scores keep the order of the images.
        counted = counted[np.argsort(-hits.scores[counted], kind="stable")]
        images = hits.images[counted]
        hit = np.flatnonzero(hits.hits[size, level, counted])
        for draw in np.flatnonzero(totals):
            # Precision peaks at hits alone, so a draw has to look at nothing else.
            image_weights = weights[draw, images]
            true = np.cumsum(image_weights[hit])
            so_far = np.cumsum(image_weights)[hit]
            precision = np.divide(true, so_far, out=np.zeros(len(true)), where=so_far > 0)
            # From each hit on the best precision at that recall or more; 0 beyond the last hit.
            best = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
            curves[draw, level] = best[np.searchsorted(true / totals[draw], RECALLS)]
    return curves


def _confidence_curves(hits: Hits, weights: np.ndarray) -> np.ndarray:
    """Return precision, recall and F1 at an overlap of half, (3, W, 1001): means over the classes
    that have an object.

    The precision of a class without detections is 1, as in Ultralytics.
    """
    total = np.zeros((3, len(weights), len(CONFIDENCES)))
    class_counts = np.zeros((len(weights), 1))
    levels = np.searchsorted(CONFIDENCES, hits.scores, side="right") - 1

    def reaching(which: np.ndarray) -> np.ndarray:
        places = (hits.images[which], levels[which])
        shape = (weights.shape[1], len(CONFIDENCES))
        # Added up from the highest confidence down: what reaches a level reaches all below it.
        by_level = weights @ csr_array((np.ones(len(places[0])), places), shape)
        return np.asarray(by_level[:, ::-1].cumsum(axis=1)[:, ::-1])

    for kind, objects in enumerate(hits.objects[ALL]):
        counts = (weights @ objects)[:, None]
        mine = hits.classes == kind
        true = reaching(mine & hits.hits[ALL, 0])
        detections = reaching(mine & ~hits.ignored[ALL, 0])
        precision = np.where(detections > 0, true / np.maximum(detections, 1), 1.0)
        recall = true / np.maximum(counts, 1)
        f1 = 2 * precision * recall / np.where(recall > 0, precision + recall, 1.0)
        total += np.where(counts > 0, [precision, recall, f1], 0.0)
        class_counts += counts > 0
    return np.where(class_counts > 0, total / np.maximum(class_counts, 1), np.nan)
