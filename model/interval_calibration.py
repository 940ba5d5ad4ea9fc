"""The calibration of the interval of a restored pixel: its exponents, and the factor of each level.

1. The exponents are fitted on some places, so that 90 % of the pixels lie within the half-width
   whatever their detail, light and sensor are: quantile regression of ln(|error| / sigma) (Koenker
   and Bassett, Econometrica 1978), as conformalized quantile regression takes it (Romano, Patterson
   and Candes, NeurIPS 2019). The least squares of these logarithms fit the middle of the errors,
   whose tails are longer for some sensors than for others.
2. q is the quantile of |error| / half-width at q = 1 on other places, where the network was not
   trained either: split conformal prediction (Lei et al., JASA 2018). Pixels of one acquisition
   resemble one another, so acquisitions are what is exchanged, and each has the same weight
   (hierarchical conformal prediction; Lee, Barber and Willett, arXiv 2306.06342).

So a pixel of one more acquisition, drawn as those of the calibration were, lies in its interval
with at least the stated probability. Nothing is stated of all pixels of an image jointly, nor of an
image that another sensor acquired than the named one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.interval import (
    Conditions,
    Exponents,
    PixelInterval,
    noise_and_detail,
)
from beers_deploy.model.levels import LEVELS
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.instrument import Instrument, pixel_noise
from beers_deploy.profiles.response import Array

LEAST_ERROR = 0.02
"""The least |error| / sigma in the fit, where the logarithm of 0 would not be finite."""

FITTED_SHARE = 0.9
"""The share of pixels that the fitted half-widths hold: that of the usual level."""

SMOOTHING = 0.1
"""The width over which the fit smooths the corner of its loss, in logarithms: a tenth of an error,
which no calibration resolves.
"""

BORDER_PX = 16
"""Pixels at the border of an image that the calibration leaves out: errors are larger there."""

SAMPLE_PX = 1 << 14
"""Pixels of one acquisition at most: more of them say little, because neighbours are alike."""


@dataclass(frozen=True)
class Sample:
    """Pixels of one restored acquisition whose truth is known.

    Attributes:
        conditions: those of the sensor that acquired them.
        noise: sigma of each, (n,).
        detail: s / sigma of each, (n,).
        error: the absolute error of each in the same units, (n,).
    """

    conditions: Conditions
    noise: Array
    detail: Array
    error: Array

    @classmethod
    def of(
        cls,
        raw: NDArray[np.float32],
        restored: NDArray[np.float32],
        truth: NDArray[np.float32],
        sensor: Instrument,
    ) -> "Sample":
        """Take the pixels of images (h, w) of digital numbers, without border and saturation.

        Args:
            raw: as the sensor acquired it.
            restored: from it.
            truth: the image that the restoration aims at.
            sensor: the instrument.
        """
        known = np.ones(restored.shape, bool)
        expected = pixel_noise(sensor, sensor.max_dn)
        noise, detail = noise_and_detail(restored, known, expected)
        counts = np.zeros(raw.shape, bool)
        counts[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
        counts &= raw < sensor.max_dn
        places = np.flatnonzero(counts)
        places = places[:: -(-places.size // SAMPLE_PX) or 1]
        error = np.abs(restored.astype(np.float64) - truth)
        return cls(
            conditions=Conditions.of(sensor, sensor.max_dn),
            noise=noise.flat[places],
            detail=detail.flat[places],
            error=error.flat[places],
        )

    def scores(self, exponents: Exponents) -> Array:
        """Return the nonconformity score of each pixel, (n,): its absolute error over its
        half-width.

        The half-width is the one that the exponents give for a quantile of 1. So a quantile of the
        scores is the factor that scales half-widths to a level.
        """
        half = exponents.half_widths(self.conditions, self.noise, self.detail)
        return self.error / half


def calibrated(fitted: Sequence[Sample], held_out: Sequence[Sample]) -> PixelInterval:
    """Calibrate the interval of a network by conformal prediction.

    Args:
        fitted: acquisitions that the exponents are fitted on.
        held_out: acquisitions of other places, from which the quantiles are computed.

    Returns:
        The exponents, and a quantile for each level that `held_out` is large enough for.

    Raises:
        OptionError: one of them has too few acquisitions with pixels that are not saturated.
    """
    fitted = [sample for sample in fitted if sample.error.size]
    held_out = [sample for sample in held_out if sample.error.size]
    if not fitted or not held_out:
        raise OptionError("`calibrate` needs pairs with pixels that are not saturated.")
    exponents = fit_exponents(fitted)
    scores = [sample.scores(exponents) for sample in held_out]
    quantiles = {level: conformal_quantile(scores, level) for level in LEVELS}
    known = {int(level): q for level, q in quantiles.items() if math.isfinite(q)}
    return PixelInterval(exponents, known, len(scores))


def fit_exponents(samples: Sequence[Sample]) -> Exponents:
    """Fit the exponents by quantile regression, each acquisition with the same weight.

    The loss of a half-width is FITTED_SHARE times its logarithmic distance from an error above it,
    and the rest times that from an error below it. A logistic kernel smooths the corner (smoothed
    quantile regression; He et al., J. Econometrics 2023), so that the loss has a gradient.

    A term that all samples agree in, such as the blur of one sensor, gets the exponent 0.
    """
    # SciPy's optimisers take a third of a second to import, and only a calibration needs them.
    from scipy.optimize import minimize

    columns = np.concatenate(
        [
            np.stack(np.broadcast_arrays(*each.conditions.terms(each.noise, each.detail)), axis=1)
            for each in samples
        ]
    )
    errors = np.concatenate([sample.error / sample.noise for sample in samples])
    logarithms_of_errors = np.log(np.maximum(errors, LEAST_ERROR))
    sizes = [sample.error.size for sample in samples]
    weight = np.repeat(1 / (np.array(sizes) * len(sizes)), sizes)
    # After centring, terms that are equal in all samples are 0, and only the last unknown is the
    # level.
    columns = np.append(columns - weight @ columns, np.ones((weight.size, 1)), axis=1)

    def loss_and_gradient(unknowns: Array) -> tuple[float, Array]:
        beyond = logarithms_of_errors - columns @ unknowns
        smoothed = SMOOTHING * np.logaddexp(0, beyond / SMOOTHING)
        loss = weight @ (smoothed - (1 - FITTED_SHARE) * beyond)
        share_beyond = (1 + np.tanh(beyond / (2 * SMOOTHING))) / 2
        return float(loss), -(weight * (share_beyond - (1 - FITTED_SHARE))) @ columns

    # Terms that are proportional for one sensor have no unique solution. From 0, where the steps
    # begin, each grows with its size.
    start = np.zeros(columns.shape[1])
    tolerances = {"ftol": 1e-12, "gtol": 1e-8}
    fitted = minimize(loss_and_gradient, start, jac=True, method="L-BFGS-B", options=tolerances)
    return Exponents(*map(float, fitted.x[:-1]))


def conformal_quantile(scores: Sequence[Array], level: float) -> float:
    """Return the conformal quantile of scores in groups, each group with the same weight.

    K groups leave the weight 1 / (K + 1) for a group to come, whose scores may be infinite. Of
    groups of one score this is the smallest of n scores that ceil((n + 1) level) of them do not
    exceed.

    Args:
        scores: the scores of each group, (n,).
        level: in percent.

    Returns:
        The quantile; infinite if there are too few groups for the level.
    """
    values = np.concatenate(scores)
    weights = np.concatenate([np.full(group.size, 1 / group.size) for group in scores])
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    # Rounding of the sum must not cost a score.
    needed = (len(scores) + 1) * level / 100 * (1 - 1e-12)
    place = int(np.searchsorted(reached, needed))
    return float(values[order][place]) if place < values.size else math.inf
