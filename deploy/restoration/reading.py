"""How the pixels of an image are understood, and what is demanded of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from beers_deploy.profiles.sensor import Sensor


@dataclass(frozen=True)
class Reading:
    """How the pixels of an image are understood.

    Attributes:
        sensors: that the user names, by band; under no name where one is for all, empty where none
            is named.
        full_scale: the pixel value that is 1.0 to a network; None leaves it to `radiometry`.
        strict: whether an image is refused that contradicts its sensor.
        force: whether an image is accepted that was restored already, an index may lead to tiles
            outside its folder and at URLs, and any result is written.
        memory_bytes: budget of this process; None is what is free.
        fix_detectors: the list of faulty detectors to replace, or 'found'; empty to replace none.
    """

    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    full_scale: float | None = None
    strict: bool = False
    force: bool = False
    memory_bytes: int | None = None
    fix_detectors: str = ""

    @property
    def sensor_bits(self) -> int | None:
        """Bits of a digital number, where a sensor is named."""
        return min((int(sensor.bits.low) for sensor in self.sensors.values()), default=None)
