"""What a user measures results by, beside references: of images, of classes, of classes of pixels."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.untrusted import times

Parts = tuple[np.ndarray, np.ndarray]
"""Numerators and denominators of one sample, for each class or for one: both are added up over the samples."""


@dataclass(frozen=True)
class Metric:
    """What a user measures results by.

    Attributes:
        unit: of the figure.
        larger_is_better: whether it is.
        of_classes: whether references are numbers of classes, for every result or for every pixel.
        parts: of a result and its reference.
    """

    unit: str
    larger_is_better: bool
    of_classes: bool
    parts: Callable[[np.ndarray, np.ndarray], Parts]


def _alone(value: float) -> Parts:
    return np.array([value]), np.ones(1)


def _similarity(result: np.ndarray, reference: np.ndarray) -> Parts:
    return _alone(float(np.mean([ssim(*pair, 1.0) for pair in zip(result[0], reference[0], strict=True)])))


def _hits(result: np.ndarray, reference: np.ndarray) -> Parts:
    right = result.argmax(1).ravel() == reference.ravel()
    return np.array([right.sum()]), np.array([right.size])


def _overlap(result: np.ndarray, reference: np.ndarray) -> Parts:
    """Of every class, the pixels that both say and those that one of them says."""
    said, meant = (np.arange(result.shape[1])[:, None] == each.ravel() for each in (result.argmax(1), reference))
    return (said & meant).sum(1), (said | meant).sum(1)


METRICS: Mapping[str, Metric] = {
    "psnr": Metric("dB", True, False, lambda result, reference: _alone(psnr_db(result, reference, 1.0))),
    "ssim": Metric("ratio", True, False, _similarity),
    "mae": Metric("of full scale", False, False, lambda result, reference: _alone(np.abs(result - reference).mean())),
    "top1": Metric("ratio", True, True, _hits),
    "iou": Metric("ratio", True, True, _overlap),
}
"""By name. iou is the mean over the classes of intersection over union."""


class Measured:
    """A metric over all samples of one network."""

    def __init__(self) -> None:
        self.parts: list[Parts] = []

    def add(self, name: str, result: np.ndarray, reference: np.ndarray) -> None:
        """One result (1, C, ...) more."""
        metric = METRICS[name]
        wanted = (len(result), *result.shape[2:]) if metric.of_classes else result.shape
        if reference.size != math.prod(wanted) or (metric.of_classes and result.shape[1] < 2):
            kind = "numbers of classes" if metric.of_classes else "references"
            got, remedy = (
                f"{times(reference.shape)} for results of {times(result.shape)}",
                "give these, or another metric",
            )
            raise OptionError("metric", expected=f"{kind} of {times(wanted)}", got=got, remedy=remedy)
        self.parts.append(metric.parts(result, reference))

    @property
    def value(self) -> float:
        """The metric over all that was added; NaN of nothing."""
        if not self.parts:
            return math.nan
        above, below = (np.sum(each, 0) for each in zip(*self.parts, strict=True))
        return float((above[below > 0] / below[below > 0]).mean())
