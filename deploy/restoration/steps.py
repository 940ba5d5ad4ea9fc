"""The steps around a network that a run takes: its exposures, and the consistency step.

Both depend on what is known of the sensor. Exposures need a network that is conditioned on its
sensor; the consistency step needs a known sensor, and a network that gives one pixel of the same
band for each pixel.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain

import onnx

from beers_deploy.model.consistency import Consistency
from beers_deploy.model.raster.facts import Raster
from beers_deploy.network import Network
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.quant.tiling.walk import Tiling
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.runtime import Infer
from beers_deploy.restoration.tiles.exposures import ExposedNetwork

OFF = "off"
NO_SENSOR = f"{OFF}: no sensor is named"
OTHER_PIXELS = f"{OFF}: the network makes other pixels or bands"


def exposures_of(network: Network, options: Options) -> Mapping[int, Network]:
    """Return a network at higher exposures by factor; empty if none is to be used."""
    return network.exposures if options.exposure else {}


def exposed_networks(
    networks: Sequence[Network],
    options: Options,
    tiling: Tiling,
    full_scale: float,
    opened: Callable[[onnx.ModelProto, bool], Infer],
) -> tuple[ExposedNetwork, ...]:
    """Build the network of each band at its exposures.

    Args:
        networks: one for all bands or one for each.
        options: what the user chose.
        tiling: how the networks meet an image.
        full_scale: the pixel value that is 1.0 to a network.
        opened: makes a network ready to run, at its first call if so asked.
    """
    built = []
    for network in networks:
        others = exposures_of(network, options)
        infers = {factor: opened(other.model, True) for factor, other in others.items()}
        offset = 0.0
        if network.profile is not None and others:
            offset = offset_of(network.profile, full_scale)
        first = opened(network.model, False)
        built.append(ExposedNetwork({1: first, **infers}, tiling.halo_px, offset))
    return tuple(built)


def offset_of(sensor: Sensor, full_scale: float) -> float:
    """Return the pixel value of the dark."""
    instrument = sensor.nominal()
    return instrument.offset_dn * full_scale / instrument.max_dn


def consistency_steps(
    options: Options, raster: Raster, tiling: Tiling, full_scale: float
) -> tuple[tuple[Consistency | None, ...], str]:
    """Build the consistency step, one for all bands or one for each, and say in words whether it is
    taken.

    "blind" is the name of no sensor: a band of that name has None.
    """
    if not options.consistency:
        return (), OFF
    blind = [band for band, sensor in options.sensors.items() if sensor.name == BLIND]
    if len(blind) == len(options.sensors):
        return (), NO_SENSOR
    if not keeps_pixels(tiling):
        return (), OTHER_PIXELS
    sensors = in_order(options.sensors, raster)
    steps = tuple(
        None if sensor.name == BLIND else step_for(sensor, full_scale) for sensor in sensors
    )
    return steps, f"on; {', '.join(blind)} {NO_SENSOR}" if blind else "on"


def keeps_pixels(tiling: Tiling) -> bool:
    """Return True if a network gives one pixel of the same band for each pixel, as the consistency
    step needs.
    """
    return tiling.scale == 1 and tiling.channels_in == tiling.channels_out


def step_for(sensor: Sensor, full_scale: float) -> Consistency:
    """Build the consistency step for the middle of a sensor's ranges and its reference."""
    return Consistency.of(sensor.nominal(), sensor.reference.nominal(), full_scale)


def factor_words(networks: Iterable[Network], options: Options) -> str:
    """Return the factors that may be used, in words; empty if there is only one."""
    factors = sorted(set(chain.from_iterable(exposures_of(each, options) for each in networks)))
    return ", ".join(f"x{factor}" for factor in (1, *factors)) if factors else ""
