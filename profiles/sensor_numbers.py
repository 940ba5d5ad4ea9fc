"""Read the numbers of a sensor profile that determine its images, without their provenance."""

from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import TABLE_OF


def same_instrument(one: Sensor, other: Sensor) -> bool:
    """Return True if two profiles state the same numbers, and so produce the same images; names and
    sources may differ.
    """
    return numbers_of(one) == numbers_of(other)


def numbers_of(profile: Sensor) -> dict[str, object]:
    """Return the numbers of a profile in a form that can be compared.

    Returns:
        From the name of each constant to its (low, high) ends, or None if the profile lacks it; the
        key "response" has the complete blur as text.
    """
    constants: dict[str, Constant | None] = {key: getattr(profile, key) for key in TABLE_OF}
    for effect, table in profile.effects.items():
        constants |= {f"{effect}.{key}": constant for key, constant in table.items()}
    numbers: dict[str, object] = {
        key: constant and (constant.low, constant.high) for key, constant in constants.items()
    }
    # The representation contains all samples. The text of a response only contains a digest.
    return {**numbers, "response": repr(profile.response)}
