"""Define the reference sensor that a restoration aims at, in the digital numbers of the degraded
one.
"""

import logging
import os

from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE

logger = logging.getLogger(__name__)


def describe_units(profile: Sensor) -> str:
    """Return a phrase on the meaning of a digital number of a sensor: its gain, bits and offset."""
    gain, bits, offset_dn = profile.units
    return f"{gain:g} DN per W/m2/sr/um, {counted(int(bits), 'bit')}" + (
        f", {offset_dn:g} DN of offset" if offset_dn else ""
    )


def reference_for(degraded: Sensor, named: Sensor | str | os.PathLike[str] | None) -> Sensor:
    """Load the reference, the better sensor that a restoration aims at, and convert it to the
    digital numbers of the degraded sensor.

    Args:
        degraded: the sensor whose images are restored.
        named: the reference that the user names; None for the shipped one. If its gain, bits or
            offset are others, the conversion is logged.

    Raises:
        ProfileError: `named` is not a valid profile.
    """
    profile = Sensor.load(named or REFERENCE)
    reference = profile.in_units_of(degraded)
    if named is not None and reference is not profile:
        units = f"{describe_units(degraded)}, as {degraded.name} has them"
        own = describe_units(profile)
        logger.info("the reference %s (%s) is converted to %s", profile.name, own, units)
    return reference
