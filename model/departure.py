"""Detect where the MTF of a sensor differs from the curves that networks were trained on."""

import math

import numpy as np

from beers_deploy.model.curves import (
    DEEPEST_BEND,
    FREQUENCIES,
    LONGEST_SMEAR_PX,
    OBSCURATIONS,
    Curve,
    pupil_contrast,
)
from beers_deploy.model.simulator.mtf import sensor_mtf
from beers_deploy.model.variants import Kernels
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST

CURVES = "convbeers-s-curves"
"""The shipped network that was trained on many curves of the MTF."""

EXPECTED = {"cut": "the formula's curve has", "fitted": "networks were trained on"}
"""The reference that a warning names for a curve, by the kind of banks."""

MARGIN = 0.05
"""The largest distance of a curve from the training curves, as a share. Beyond it networks lose
0.1 dB and more (measured).
"""


def departure(sensor: Instrument, kernels: Kernels) -> str:
    """Return a warning if a sensor's MTF curve differs from the one that networks were trained on.

    That is the curve of the formula exp(-gamma f) sinc f. Without a difference the text is empty.

    Args:
        sensor: the instrument whose MTF and smear are compared.
        kernels: the kind of the network's banks. Networks behind cut kernels were trained on the
            formula's curve only, those behind fitted ones on many.
    """
    off_formula = _outside(sensor, "cut")
    if not off_formula:
        return ""
    outside = _outside(sensor, "fitted")
    worse = "the network may restore worse than the traditional pipeline"
    if outside:
        return f"{outside}: {worse}"
    if kernels == "cut":
        return f"{off_formula}: {worse}. {CURVES} was trained on such curves"
    return f"{off_formula}: there {CURVES} is about level with the traditional pipeline (measured)"


def has_other_curve(sensor: Instrument) -> bool:
    """Return True if a sensor's MTF curve differs by more than `departure` allows from the curve
    exp(-gamma f) sinc f that has the same contrast at Nyquist.
    """
    return bool(_outside(sensor, "cut"))


def _outside(sensor: Instrument, kernels: Kernels) -> str:
    """Return where the MTF leaves the training curves of one kind of banks; "" if it does not."""
    zero = np.zeros((1, 1))
    frequency = FREQUENCIES[None]
    responses = sensor_mtf(frequency, zero, sensor), sensor_mtf(zero, frequency.T, sensor)
    for axis, contrast, response in zip(
        ("across", "along"), sensor.mtf_axes, responses, strict=True
    ):
        curve = np.abs(np.ravel(response))
        # The stated contrast does not include smear.
        smeared = axis == "along" and bool(sensor.smear_px)
        at_nyquist = float(curve[-1]) if smeared else contrast
        trained = np.stack(_known_curves(at_nyquist, kernels))
        low = trained.min(0) * (1 - MARGIN)
        high = trained.max(0) * (1 + MARGIN)
        outside = np.maximum(low / np.maximum(curve, 1e-9), curve / high)
        # The last frequency is Nyquist, where all these curves have one contrast.
        worst = int(outside[:-1].argmax())
        if outside[worst] > 1:
            return (
                f"the MTF {axis} the track is {curve[worst]:.3g} at {FREQUENCIES[worst]:.2g} "
                f"cycles per pixel, but {EXPECTED[kernels]} {low[worst]:.3g} to {high[worst]:.3g} "
                "for that contrast at Nyquist"
            )
    return ""


def _known_curves(contrast: float, kernels: Kernels) -> list[Curve]:
    """Compute curves at FREQUENCIES that enclose all training curves of a contrast at Nyquist."""
    detector = np.sinc(FREQUENCIES)
    share = FREQUENCIES / NYQUIST
    if kernels == "cut":
        return [np.asarray(min(contrast / float(detector[-1]), 1.0) ** share * detector)]
    # A hill in the middle raises or lowers the formula by no more than this.
    bend = DEEPEST_BEND * np.sin(math.pi * share)
    curves = list[Curve]()
    for smear_px in np.linspace(0, LONGEST_SMEAR_PX, 9):
        detector_and_motion = detector * np.sinc(smear_px * FREQUENCIES)
        optics_contrast = min(contrast / float(detector_and_motion[-1]), 1.0)
        formula = optics_contrast**share
        pupils = [pupil_contrast(optics_contrast, obscuration) for obscuration in OBSCURATIONS]
        optics = [
            optics_contrast ** (share**2),
            *pupils,
            formula * (1 - bend),
            np.minimum(formula * (1 + bend), 1.0),
        ]
        curves += [np.asarray(curve * detector_and_motion) for curve in optics]
    return curves
