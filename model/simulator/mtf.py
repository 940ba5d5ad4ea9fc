"""Compute the modulation transfer function: the contrast that an instrument transfers at each
spatial frequency.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.instrument import MTF_NYQUIST_MAX, Instrument, mtf_limit
from beers_deploy.profiles.response import Frequencies, PointSpread, Response


def gamma_from_mtf(mtf_nyquist: float, antialias_sigma_px: float = 0.0) -> float:
    """Solve MTF(0.5, 0) = mtf_nyquist for gamma: gamma = -2 ln(mtf_nyquist * pi / (2 G)) (paper,
    section 3.3).

    G is the anti-alias filter's own gain at Nyquist: the filter is part of the budget, so that the
    product has the MTF that its profile states. Limits: 2 G / pi gives 0 (the square detector
    alone); towards 0 it grows without bound.
    """
    limit = mtf_limit(antialias_sigma_px)
    if not 0 < mtf_nyquist <= limit:
        filter_gain = limit / MTF_NYQUIST_MAX
        with_filter = (
            f" (with an anti-alias filter of gain {filter_gain:.3f})" if antialias_sigma_px else ""
        )
        raise OptionError(
            f"The MTF at Nyquist must be a ratio above 0 and up to {limit:.4f}{with_filter}, got "
            f"{mtf_nyquist!r}. A ratio of 0.07 means 7 %."
        )
    # At the limit itself the rounding of the ratio may fall on either side of 1.
    return max(-2 * math.log(mtf_nyquist / limit), 0.0)


Blur = float | tuple[float, float] | Response
"""The parameters of an MTF: its contrast at Nyquist, one for both axes or (across the track, along
it), that is horizontal and vertical; or a complete table or point-spread function.
"""


def mtf(
    fx: ArrayLike, fy: ArrayLike, blur: Blur, antialias_sigma_px: float = 0.0
) -> NDArray[np.inexact]:
    """Compute MTF(fx, fy) = exp(-gamma * sqrt(fx^2 + fy^2)) * sinc(fx) * sinc(fy) * G(fx, fy)
    (paper, section 3.3).

    With a second MTF, along the track, gamma * sqrt(fx^2 + fy^2) becomes sqrt((gamma_x fx)^2 +
    (gamma_y fy)^2). Each axis then has its stated contrast, and equal contrasts give the paper's
    formula to the last bit. A table or a point-spread function is evaluated directly: see
    `profiles.response`.

    Args:
        fx: horizontal frequencies (1, W) in cycles per TARGET pixel, float64; for the formula any
            shape that broadcasts against fy.
        fy: vertical frequencies (H, 1), likewise. Beyond 1 the sinc is negative, and remains so.
        blur: contrast at 0.5 cycles per pixel, the anti-alias filter G included; or the complete
            response.
        antialias_sigma_px: standard deviation of that filter in target pixels; 0 is none (G = 1).

    Returns:
        (H, W) float64; complex128 for a point-spread function.
    """
    fx = np.asarray(fx, np.float64)
    fy = np.asarray(fy, np.float64)
    if isinstance(blur, Response):
        if antialias_sigma_px:
            raise OptionError(
                f"The anti-alias filter of {antialias_sigma_px:g} px cannot be combined with the "
                f"{blur}, which is the whole response and includes the filter. Leave the filter "
                "out."
            )
        return blur.at(fx, fy)
    across, along = blur if isinstance(blur, tuple) else (blur, blur)
    gamma_x, gamma_y = (gamma_from_mtf(value, antialias_sigma_px) for value in (across, along))
    radius = np.hypot(fx, fy)
    # One gamma is the usual case, in which gamma * radius is exactly the paper's formula:
    # hypot(gamma fx, gamma fy) rounds otherwise.
    optics = np.exp(
        -gamma_x * radius if gamma_x == gamma_y else -np.hypot(gamma_x * fx, gamma_y * fy)
    )
    # Beyond frequency 1 the sinc is negative: the contrast is reversed there, and its sign stays.
    response = np.asarray(optics * np.sinc(fx) * np.sinc(fy))
    if not antialias_sigma_px:
        return response
    # The transform of a Gaussian filter.
    return np.asarray(response * np.exp(-2 * (math.pi * antialias_sigma_px * radius) ** 2))


def frequency_grid(side: int) -> tuple[Frequencies, Frequencies]:
    """Return the frequencies fx (1, N) and fy (N, 1) of a spectrum of N x N in cycles per pixel, in
    the order of a Fourier transform.
    """
    frequency = np.fft.fftfreq(side)
    return frequency[None], frequency[:, None]


def smear_response(fy: ArrayLike, length_px: float) -> NDArray[np.float64]:
    """Compute the MTF of uniform motion along the track during an exposure.

    It is sin(pi x) / (pi x) with x = length_px * fy, for fy of any shape in cycles per pixel of the
    sensor, and 1 for a length of 0.
    """
    return np.sinc(length_px * np.asarray(fy, np.float64))


def sensor_mtf(fx: ArrayLike, fy: ArrayLike, sensor: Instrument) -> NDArray[np.inexact]:
    """Compute the MTF (H, W) of a sensor's blur and smear.

    The frequencies fx (1, W) and fy (H, 1) are in cycles per pixel of the sensor. For a
    point-spread function the result is complex.
    """
    response = mtf(fx, fy, sensor.blur, sensor.antialias_px)
    return response * smear_response(fy, sensor.smear_px) if sensor.smear_px else response


def sensor_transfer(
    height: int, width: int, oversampling: int, sensor: Instrument
) -> NDArray[np.inexact]:
    """Compute the transfer function (H, W // 2 + 1) of all linear, shift-invariant effects of a
    sensor.
    """
    return transfer_function(
        height, width, oversampling, sensor.blur, sensor.antialias_px, sensor.smear_px
    )


@lru_cache(maxsize=64)
def transfer_function(
    height: int,
    width: int,
    oversampling: int,
    blur: Blur,
    antialias_sigma_px: float = 0.0,
    smear_px: float = 0.0,
) -> NDArray[np.inexact]:
    """Compute MTF and smear on the half spectrum of a scene: (H, W // 2 + 1) float32, to multiply
    an rfft2.

    `height` and `width` are in scene pixels, and `oversampling` scene pixels make one target pixel,
    the unit of `antialias_sigma_px` and `smear_px`. For a point-spread function, which may be
    asymmetric or inclined to the axes, the result is complex64.
    """
    aslant = isinstance(blur, PointSpread)
    # Only a transfer that is even in fy can be computed from half of the rows.
    vertical = np.fft.fftfreq if aslant else np.fft.rfftfreq
    fy = vertical(height, 1 / oversampling)
    fx = np.fft.rfftfreq(width, 1 / oversampling)
    transfer = mtf(fx[None, :], fy[:, None], blur, antialias_sigma_px)
    if smear_px:
        transfer = transfer * smear_response(fy[:, None], smear_px)
    if aslant:
        return transfer.astype(np.complex64)
    upper = transfer.astype(np.float32)
    # The transfer is even in fy: the rows below mirror those above.
    return np.concatenate([upper, upper[1 : (height + 1) // 2][::-1]])
