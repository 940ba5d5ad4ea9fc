"""Check that one instrument can have all the numbers of a sensor profile."""

from collections.abc import Mapping

import numpy as np

from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.effects import EffectTable
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.instrument import mtf_limit, snr_0_bounds
from beers_deploy.profiles.response import MtfTable, PointSpread
from beers_deploy.profiles.sensor_file import LEAST

Pair = tuple[Constant, Constant]
MaybePair = tuple[Constant | None, Constant | None]


def require_possible_noise(radiances: Pair, snrs: MaybePair, variances: MaybePair) -> None:
    """Raise ValueError if the noise is stated in neither way or in both, or is physically
    impossible.

    Args:
        radiances: `radiance_0` and `radiance_1`.
        snrs: `snr_0` and `snr_1`, or None.
        variances: `alpha` and `beta`, or None.
    """
    begun = [way for way in (snrs, variances) if any(way)]
    if len(begun) != 1 or not all(begun[0]):
        raise ValueError("noise must have snr_0 and snr_1, or alpha and beta. Give two of them.")
    dark, bright = (radiance.low for radiance in radiances)
    if not dark < bright:
        raise ValueError(
            f"noise.radiance_0 must be below radiance_1, {bright:g} W/m2/sr/um, but it is "
            f"{dark:g}. Name the darker of the two points radiance_0."
        )
    alpha, beta = variances
    if alpha and beta and max(alpha.high, beta.high) < LEAST:
        raise ValueError(
            "noise.alpha and noise.beta must not both be 0. Give the variance in the dark as beta."
        )
    snr_0, snr_1 = snrs
    if snr_0 and snr_1:
        # Both bounds grow with snr_1, so it suffices to check its two ends.
        lowest = snr_0_bounds(dark, bright, snr_1.low)[0]
        highest = snr_0_bounds(dark, bright, snr_1.high)[1]
        if snr_0.high < lowest or snr_0.low > highest:
            raise ValueError(impossible_snr(radiances, (snr_0, snr_1)))


def impossible_snr(radiances: Pair, snrs: Pair) -> str:
    """Return the error message for SNRs that no alpha and beta can have.

    Args:
        radiances: `radiance_0` and `radiance_1`.
        snrs: `snr_0` and `snr_1`.
    """
    radiance_0, radiance_1 = radiances
    snr_0, snr_1 = snrs
    low, high = snr_0_bounds(radiance_0.low, radiance_1.low, snr_1.high)
    return (
        f"noise.snr_0, at {radiance_0} W/m2/sr/um, must be {low:g} to {high:g} with "
        f"noise.snr_1 = {snr_1.high:g} at {radiance_1} (variance alpha L + beta with "
        f"alpha, beta >= 0), but it is {snr_0}. Correct one of the two; both are linear "
        "ratios, not dB."
    )


def require_possible_blur(
    axes: Pair, response: MtfTable | PointSpread | None, effects: Mapping[str, EffectTable]
) -> None:
    """Raise ValueError if the response contradicts the contrasts, or if they exceed the anti-alias
    filter.

    Args:
        axes: the contrasts at the Nyquist frequency across the track and along it.
        response: the complete blur, if it is known.
        effects: the tables of the effects by name.
    """
    if response and not np.allclose([c.low for c in axes], response.at_nyquist):
        raise ValueError(
            f"mtf has the contrasts {axes[0]} and {axes[1]} at Nyquist, but the {response} has "
            "others. Generate the file again."
        )
    if "antialias" not in effects:
        return
    if response:
        raise ValueError(
            f"must have no table antialias, because the {response} already includes the filter. "
            "Remove the table, or the effect from the scene or the option that adds it."
        )
    sigma = effects["antialias"]["sigma_px"]
    limit = mtf_limit(sigma.high)
    for key, mtf in zip(("mtf_nyquist", "mtf_nyquist_along"), axes, strict=True):
        if mtf.high > limit:
            raise ValueError(
                f"mtf.{key} must be at most {limit:.4g}, which an anti-alias filter of "
                f"{sigma.high:g} px leaves, but it is {mtf}. Lower one of the two."
            )


def require_possible_offset(bits: int, offset_dn: float) -> None:
    """Raise ValueError if the offset alone saturates every pixel.

    Args:
        bits: the number of bits of a pixel.
        offset_dn: the digital number in the dark.
    """
    largest_dn = 2**bits - 1
    if offset_dn >= largest_dn:
        raise ValueError(
            f"offset.offset_dn must be below {largest_dn}, the largest digital number of "
            f"{counted(bits, 'bit')}, but it is {offset_dn:g}. Correct one of the "
            "two."
        )
