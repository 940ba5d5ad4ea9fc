"""The steps around a network that a run uses: its exposures, and the consistency step.

Both depend on the sensor. Exposures need a network that is conditioned on its sensor. The
consistency step needs a known sensor, and a network that returns one pixel of the same band for
each pixel.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import onnx

from beers_deploy.model.consistency.step import Consistency
from beers_deploy.model.raster.facts import Raster
from beers_deploy.network import Network
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.input_range import Ranges, from_shares, to_shares
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.runtime import Infer
from beers_deploy.restoration.tiles.exposures import ExposedNetwork

OFF = "off"
NO_SENSOR = f"{OFF}: no sensor is named"
OTHER_PIXELS = f"{OFF}: the network makes other pixels or bands"


@dataclass(frozen=True)
class Around:
    """The user's choice of the two steps around a network, which a run uses where possible.

    Attributes:
        consistency: True to smooth the dark and make the result agree with the raw image at low
            spatial frequencies (the consistency step).
        exposure: True to restore dark parts of the image, and strong edges, at exposures of their
            own: they are multiplied by a factor before the network and divided by it afterwards.
    """

    consistency: bool = True
    exposure: bool = True


BOTH: Around = Around()


def exposures_of(network: Network, around: Around) -> Mapping[float, Network]:
    """Return the versions of a network for pixels that are multiplied by a factor before it.

    Args:
        network: a network. Only one that is conditioned on its sensor may have such versions.
        around: the steps that the user chooses.

    Returns:
        The networks by the factor; empty if the network has none, or the user omits exposure.
    """
    return network.exposures if around.exposure else {}


def in_ranges(infer: Infer, ranges: Ranges, image: np.ndarray) -> np.ndarray:
    """Run a network whose file states other ranges of values than [0, 1] for its channels.

    Args:
        infer: the network, ready to run.
        ranges: the range of values that the network reads and returns, for each channel.
        image: (1, C, h, w) float32, as shares of full scale.

    Returns:
        The network's result, as shares of full scale, too.
    """
    return to_shares(infer(from_shares(image, ranges)), ranges)


def exposed_networks(
    networks: Sequence[Network],
    around: Around,
    tiling: Tiling,
    full_scale: float,
    opened: Callable[[onnx.ModelProto], Infer],
) -> tuple[ExposedNetwork, ...]:
    """Open the networks of a run, each with its versions for other exposures, where parts of the
    image are multiplied by a factor before the network.

    Args:
        networks: one network for all bands, or one for each.
        around: the steps that the user chooses, of which this function uses `exposure`.
        tiling: the networks' tiling geometry.
        full_scale: the pixel value that is 1.0 to a network.
        opened: returns a network ready to run, given its ONNX model.

    Returns:
        The opened networks in the given order. Without exposures a network has the factor 1 alone.

    Raises:
        ModelError: the ranges of a network were found in samples, so that full scale is not known.
    """
    built = []
    for network in networks:
        ranges = network.stated_ranges
        others = exposures_of(network, around)
        infers = {factor: opened(other.model) for factor, other in others.items()}
        offset = 0.0
        if network.profile is not None and others:
            offset = network.profile.nominal().dark_value(full_scale)
        infer = opened(network.model)
        infers = {1: partial(in_ranges, infer, ranges) if ranges else infer, **infers}
        built.append(ExposedNetwork(infers, tiling.halo_px, offset))
    return tuple(built)


def consistency_steps(
    around: Around,
    sensors: Mapping[str, Sensor],
    raster: Raster,
    tiling: Tiling,
    full_scale: float,
) -> tuple[tuple[Consistency | None, ...], str]:
    """Build the consistency step of a run, which makes the result agree with the raw image at low
    spatial frequencies: one step for all bands, or one for each.

    Args:
        around: the steps that the user chooses, of which this function uses `consistency`.
        sensors: the sensor by the name of the band; a sensor for all bands has the key "". The
            sensor named "blind" is unknown.
        raster: the description of the image, whose bands set the order.
        tiling: the network's tiling geometry.
        full_scale: the pixel value that is the largest digital number of a sensor.

    Returns:
        The steps in the order of the bands, None for a band of an unknown sensor, and a text that
        states if they are used. No steps are returned if the option is off, no sensor is known, or
        the network does not return one pixel of the same band for each pixel.
    """
    if not around.consistency:
        return (), OFF
    blind = [band for band, sensor in sensors.items() if sensor.name == BLIND]
    if len(blind) == len(sensors):
        return (), NO_SENSOR
    if not keeps_pixels(tiling):
        return (), OTHER_PIXELS
    steps = tuple(
        None if sensor.name == BLIND else step_for(sensor, full_scale)
        for sensor in in_order(sensors, raster)
    )
    return steps, f"on; {', '.join(blind)} {NO_SENSOR}" if blind else "on"


def keeps_pixels(tiling: Tiling) -> bool:
    """Return True if a network with this tiling geometry returns one pixel of the same band for
    each pixel of the image. The consistency step needs that, because it compares pixel by pixel.
    """
    return tiling.scale == 1 and tiling.channels_in == tiling.channels_out


def step_for(sensor: Sensor, full_scale: float) -> Consistency:
    """Build the consistency step of a band.

    Args:
        sensor: the profile of the sensor that acquired the image, which also states the reference
            sensor that the restoration aims at. The middle of each of their ranges is used.
        full_scale: the pixel value that is the sensor's largest digital number.
    """
    return Consistency.of(sensor.nominal(), sensor.reference.nominal(), full_scale)
