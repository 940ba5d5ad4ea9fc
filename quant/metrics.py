"""The metrics by which a user judges results against references."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.untrusted import times

SCALE = "of full scale"


@dataclass(frozen=True)
class Metric:
    """A figure by which a user judges results, such as SSIM.

    Attributes:
        unit: the unit of the figure.
        larger_is_better: True if a larger value is better.
        value: function of a result (1, C, H, W) and its reference of the same shape, both in shares
            of full scale.
    """

    unit: str
    larger_is_better: bool
    value: Callable[[np.ndarray, np.ndarray], float]


METRICS: Mapping[str, Metric] = {
    "psnr": Metric("dB", True, lambda result, reference: psnr_db(result, reference, 1.0)),
    # SSIM is that of one band, so it is the mean over the bands.
    "ssim": Metric(
        "ratio",
        True,
        lambda result, reference: float(
            np.mean([ssim(*pair, 1.0) for pair in zip(result[0], reference[0], strict=True)])
        ),
    ),
    "mae": Metric(SCALE, False, lambda result, reference: float(np.abs(result - reference).mean())),
}


def metric_value(name: str, result: np.ndarray, reference: np.ndarray) -> float:
    """Compare one result with its reference by a metric.

    Args:
        name: one of `METRICS`.
        result: (1, C, H, W) in shares of full scale.
        reference: the image that the result should be, of the same shape.

    Returns:
        The value in the unit of the metric.

    Raises:
        OptionError: the reference is not of the size of the result.
    """
    if reference.size != result.size:
        raise OptionError(
            f"The `metric` {name!r} needs references of {times(result.shape)}, the size of the "
            f"results, but they have {times(reference.shape)}. Give such references, or leave "
            "`metric` out."
        )
    return METRICS[name].value(result, reference)
