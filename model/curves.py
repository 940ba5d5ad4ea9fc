"""Draw MTF curves for training, in addition to the formula's, because instruments of equal contrast
at Nyquist differ.

A curve is the MTF of the optics, times sinc(f) of the square detector. The optics are one of:

    formula     exp(-gamma f)
    Gaussian    exp(-a f^2): optics and electronics with several small blurs
    pupil       the autocorrelation of a circular pupil, with or without a central obscuration
    bent        the formula, less or more by a smooth hill at middle frequencies

Along the track any of them is also multiplied by sinc(s f), the motion during an exposure. Each is
scaled so that it has the requested contrast at Nyquist.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from beers_deploy.profiles.response import NYQUIST, MtfTable

Curve = NDArray[np.float64]

FREQUENCIES: Curve = np.linspace(0, NYQUIST, 26)
"""Frequencies of a drawn table, in cycles per target pixel."""

OBSCURATIONS = (0.0, 0.15, 0.3, 0.45)
"""Diameter of the central obscuration over that of the pupil."""
DEEPEST_BEND = 0.25
LONGEST_SMEAR_PX = 1.0
PUPIL_GRID = 256
"""Samples across twice the pupil, from which its autocorrelation is computed."""


def draw_table(across: float, along: float, generator: np.random.Generator) -> MtfTable:
    """Draw a random MTF curve whose shape differs from the formula's.

    Args:
        across: contrast at Nyquist across the track, in (0, 1).
        along: contrast at Nyquist along it. Both curves have optics of the same kind.
        generator: draws the kind of the optics, their parameters and the motion.

    Returns:
        The MTF at FREQUENCIES, across and along the track.
    """
    optics = _drawn_optics(generator)
    smear_px = float(generator.choice([0.0, generator.uniform(0, LONGEST_SMEAR_PX)]))
    detector = np.sinc(FREQUENCIES)
    motion = np.sinc(smear_px * FREQUENCIES)
    # Optics only reduce contrast, however much the motion has reduced it.
    contrast_along = min(along / float(detector[-1] * motion[-1]), 1.0)
    curves = (
        optics(across / float(detector[-1])) * detector,
        optics(contrast_along) * detector * motion,
    )
    return MtfTable(*(tuple(values.tolist()) for values in (FREQUENCIES, *curves)))


def _drawn_optics(generator: np.random.Generator) -> Callable[[float], Curve]:
    """Draw a kind of optics, and return a function of the contrast at Nyquist.

    The function returns the contrast at FREQUENCIES.
    """
    kind = generator.choice(["Gaussian", "pupil", "bent"], p=[0.25, 0.35, 0.4])
    share = FREQUENCIES / NYQUIST
    if kind == "Gaussian":
        return lambda contrast: np.asarray(contrast ** (share**2))
    if kind == "pupil":
        obscuration = float(generator.choice(OBSCURATIONS))
        return lambda contrast: pupil_contrast(contrast, obscuration)
    depth = float(generator.uniform(-DEEPEST_BEND, DEEPEST_BEND))
    middle = float(generator.uniform(0.3, 0.6))
    width = float(generator.uniform(0.15, 0.35))
    hill = np.exp(-(((share - middle) / width) ** 2)) * np.sin(math.pi * share)
    return lambda contrast: np.asarray(np.minimum(contrast**share * (1 + depth * hill), 1.0))


def pupil_contrast(contrast: float, obscuration: float) -> Curve:
    """Compute the contrast at FREQUENCIES of a pupil.

    Its cut-off frequency is chosen such that the contrast at Nyquist is `contrast`.
    """
    frequency, contrasts = _pupil(obscuration)
    # It falls, except for rounding, so it can be searched backwards.
    at_nyquist = float(np.interp(contrast, contrasts[::-1], frequency[::-1]))
    return np.interp(FREQUENCIES / NYQUIST * at_nyquist, frequency, contrasts)


@lru_cache
def _pupil(obscuration: float) -> tuple[Curve, Curve]:
    """Compute the MTF of a pupil with a central obscuration.

    Returns:
        Frequencies relative to the cut-off frequency, and the contrast at each.
    """
    # The grid is twice as wide as the pupil: its autocorrelation does not wrap around.
    place = (np.arange(2 * PUPIL_GRID) - PUPIL_GRID + 0.5) / (PUPIL_GRID / 2)
    radius = np.hypot(place[:, None], place[None, :])
    pupil = ((radius <= 1) & (radius >= obscuration)).astype(np.float64)
    overlap = np.fft.ifft2(np.abs(np.fft.fft2(pupil)) ** 2).real[0, : PUPIL_GRID + 1]
    contrast = np.minimum.accumulate(np.maximum(overlap / overlap[0], 0.0))
    return np.linspace(0, 1, PUPIL_GRID + 1), np.asarray(contrast)
