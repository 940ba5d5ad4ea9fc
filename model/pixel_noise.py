"""State the variance of a pixel's noise as a polynomial of its light, from a sensor's profile."""

from beers_deploy.profiles.effects import Dsnu, Prnu, Striping
from beers_deploy.profiles.instrument import Instrument


def noise_variances(
    sensor: Instrument, full_scale: float, patterns: float = 1
) -> tuple[float, float, float]:
    """Return the numbers a, b and c of the variance a + b x + c x^2 of a pixel's noise.

    x is the pixel value less that of the dark. a is in squared pixel values, b in pixel values.

    The differences of detectors that a profile states count as noise, because no single one of them
    is known. 1/12 DN^2, the variance of rounding to integers, is a part of a.

    Args:
        sensor: the instrument.
        full_scale: the pixel value that is the sensor's largest digital number.
        patterns: the factor with which differences between columns count: where pixels are summed,
            the number of rows of a sum, because the rows of a column differ alike.
    """
    unit = full_scale / sensor.max_dn
    gain = sensor.gain_dn_per_radiance
    dark = sensor.beta * gain**2 + 1 / 12
    square = 0.0
    for effect in sensor.effects.values():
        if isinstance(effect, Dsnu):
            dark += patterns * effect.rms_dn**2
        elif isinstance(effect, Striping):
            dark += (effect.odd_even_dn / 2) ** 2
        elif isinstance(effect, Prnu):
            square = patterns * effect.rms**2
    return dark * unit**2, sensor.alpha * gain * unit, square
