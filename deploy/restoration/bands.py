"""Bands of several sensors: `B0=a.toml,B1=b.toml` gives each band its own network.

If the image names its bands, each is found by its name. Otherwise they are sorted by the number at
the end of their names, or used in the order given.
"""

import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from beers_deploy.conditioned_file import to_run_on
from beers_deploy.model.raster.facts import Raster
from beers_deploy.network import Network, NetworkLike
from beers_deploy.network_files import other_sensor
from beers_deploy.profiles.errors import ModelError, OptionError, counted, printable
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.profiles.shipped import BLIND

logger = logging.getLogger(__name__)

Each = TypeVar("Each")


def sensors_of(sensor: SensorLike | Mapping[str, SensorLike]) -> dict[str, Sensor]:
    """Load the sensors that a user names for an image.

    Args:
        sensor: one sensor for all bands (a `Sensor`, a name or the path of a profile), a mapping
            from the band's name to its sensor, or a text BAND=PROFILE,BAND=PROFILE.

    Returns:
        The sensor of each band by the band's name, or one under the key "" for all bands.

    Raises:
        OptionError: the text lacks a band or a profile, or names a band twice.
        BeersError: a profile cannot be loaded.
    """
    if isinstance(sensor, Mapping):
        if not sensor:
            raise OptionError("`sensor` names no band. Name each band with its sensor.")
        for band in sensor:
            if not isinstance(band, str):
                raise OptionError(
                    f"`sensor` must have texts as names of bands, got {printable(repr(band))}. "
                    "Write them as the image names them, or 'B1', 'B2'."
                )
        return {band: Sensor.load(profile) for band, profile in sensor.items()}
    # The path of one profile may have an equals sign in it.
    if not isinstance(sensor, str) or "=" not in sensor or Path(sensor).is_file():
        return {"": Sensor.load(sensor)}
    pairs = [part.partition("=") for part in sensor.split(",")]
    profiles = {name.strip(): profile.strip() for name, _, profile in pairs}
    if not all((*profiles, *profiles.values())) or len(profiles) < len(pairs):
        raise OptionError(
            f"`sensor` must be BAND=PROFILE,BAND=PROFILE, got {printable(repr(sensor))}. Name each "
            "band once."
        )
    return {band: Sensor.load(profile) for band, profile in profiles.items()}


def is_unknown(sensors: Mapping[str, Sensor]) -> bool:
    """Return True if the user names no sensor, so that the profile "blind" stands for all bands.

    Args:
        sensors: the sensor by the name of the band; a sensor for all bands has the key "".
    """
    return list(sensors) == [""] and sensors[""].name == BLIND


def networks_of(
    network: NetworkLike | None, sensors: Mapping[str, Sensor], full_scale: float | None
) -> dict[str, Network]:
    """Load a network for each sensor, and log which network restores.

    Args:
        network: the network for all bands, which is conditioned on each sensor in turn; None for
            the default network.
        sensors: the sensor by the name of the band; a sensor for all bands has the key "".
        full_scale: the pixel value that is full scale if the user states it, else None.

    Returns:
        The networks with the same keys as `sensors`.

    Raises:
        OptionError: there are several sensors for a network that was made for one, or sensors of
            different bit depths and no full scale.
    """
    networks = {
        band: to_run_on(Network.load(network, sensor=sensor), sensor)
        for band, sensor in sensors.items()
    }
    first = next(iter(networks.values()))
    if first.weights is None and len(sensors) > 1:
        raise OptionError(
            f"`sensor` names a sensor for each band, but {first.label} was made for one sensor. "
            "Give one sensor for all bands, or use a shipped network, or weights of 'train "
            "--conditioned' or their INT8 file."
        )
    bits = {int(sensor.bits.low) for sensor in sensors.values()}
    if len(bits) > 1 and full_scale is None:
        raise OptionError(
            f"The sensors have different bits ({', '.join(map(str, sorted(bits)))}). Give "
            "`full_scale`, or restore such bands separately."
        )
    if first.weights is None:
        (sensor,) = sensors.values()
        warning = other_sensor(first.model, sensor)
        if warning:
            logger.warning(warning)
    elif is_unknown(sensors):
        logger.info(
            "network: %s, for an unknown sensor: the result may be worse than the image if your "
            "sensor is sharper or noisier than assumed. Name it with `sensor`",
            first.name,
        )
    else:
        names = ", ".join(sensor.name for sensor in sensors.values())
        logger.info("network: %s, conditioned on %s", first.name, names)
    return networks


def in_order(items: Mapping[str, Each], raster: Raster) -> list[Each]:
    """Sort sensors, networks or other items in the order of the image's bands.

    Args:
        items: an item for each band by the name of the band, or one for all bands under "".
        raster: the description of the image, which may name its bands. If it does not, items are
            sorted by the number at the end of their names, or stay in the given order.

    Returns:
        One item for each band of the image, or the only item for all bands.

    Raises:
        OptionError: the names are not those of the image's bands, or there is another number of
            them.
    """
    if "" in items:
        return [items[""]]
    stored_names = raster.band_names
    names: Iterable[str] = stored_names or items
    # Names that end in a number, such as B2, are sorted by it.
    if not stored_names and all(re.fullmatch(r"\D*\d{1,6}", name) for name in items):
        names = sorted(items, key=lambda name: int(re.sub(r"\D", "", name)))
    if len(items) != raster.bands or set(names) != set(items):
        names_text = f" ({printable(', '.join(stored_names))})" if stored_names else ""
        raise OptionError(
            f"`sensor` must name a sensor for each of {counted(raster.bands, 'band')}{names_text}, "
            f"got {printable(', '.join(items))}. Name every band of the image; "
            "pansharpening is out of scope."
        )
    return [items[name] for name in names]


def by_band(
    sensors: Mapping[str, Sensor], raster: Raster, build: Callable[[Sensor], Each]
) -> tuple[Each, ...]:
    """Build something for the sensor of each band, in the order of the bands.

    Args:
        sensors: the sensor by the name of the band; a sensor for all bands has the key "".
        raster: the description of the image.
        build: called once for each sensor.

    Returns:
        One item for each band of the image, the same for all bands of one sensor.

    Raises:
        OptionError: the sensors are not those of the image's bands.
    """
    built = tuple(build(sensor) for sensor in in_order(sensors, raster))
    return built * (raster.bands // len(built))


def require_alike(networks: Sequence[Network]) -> None:
    """Raise ModelError if an image cannot be cut into the same tiles for all networks of its bands.

    Args:
        networks: one network for all bands, which is accepted, or one for each. Several must read
            one band each and have equal tilings: halo, stride, scale, bands and accepted sizes.
    """
    tilings = [network.geometry for network in networks]
    if len(networks) > 1 and (len(set(map(repr, tilings))) > 1 or tilings[0].channels_in != 1):
        raise ModelError(
            "Networks for single bands must each have one band and differ only in their weights, "
            "but these have several bands or different halos. Give one network for all bands."
        )
