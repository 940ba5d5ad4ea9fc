"""The steps around a network that a run takes: its exposures, and the consistency step.

Both depend on what is known of the sensor. Exposures need a network that is conditioned on its
sensor; the consistency step needs a known sensor, and a network that gives one pixel of the same
band for each pixel.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import onnx

from beers_deploy.model.consistency import Consistency
from beers_deploy.model.raster.facts import Raster
from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.input_range import (
    FROM_SAMPLES,
    KEY,
    Ranges,
    from_shares,
    in_words,
    to_shares,
)
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.bands import in_order
from beers_deploy.restoration.runtime import Infer
from beers_deploy.restoration.tiles.exposures import ExposedNetwork

OFF = "off"
NO_SENSOR = f"{OFF}: no sensor is named"
OTHER_PIXELS = f"{OFF}: the network makes other pixels or bands"


@dataclass(frozen=True)
class Around:
    """Which steps around a network are used where they can be.

    Attributes:
        consistency: whether the result is made to agree with the image at low spatial frequencies.
        exposure: whether dark parts are restored at a higher exposure.
    """

    consistency: bool = True
    exposure: bool = True


BOTH: Around = Around()


def exposures_of(network: Network, around: Around) -> Mapping[int, Network]:
    """Return a network at higher exposures by factor; empty if none is to be used."""
    return network.exposures if around.exposure else {}


@dataclass(frozen=True)
class InRange:
    """A network that reads and returns images of other ranges than [0, 1], for one in [0, 1].

    Attributes:
        infer: the network.
        ranges: of its channels.
    """

    infer: Infer
    ranges: Ranges

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Run the network, as an `Infer`."""
        return to_shares(self.infer(from_shares(image, self.ranges)), self.ranges)


def _stated_ranges(network: Network) -> Ranges:
    """Return the ranges onto which full scale is mapped for a network; empty for [0, 1].

    Raises:
        ModelError: ranges of samples, which need not reach as far as full scale.
    """
    ranges = network.input_ranges
    if ranges and FROM_SAMPLES in metadata(network.model).get(KEY, FROM_SAMPLES):
        raise ModelError(
            f"{network.label} was quantised for the range of its samples, {in_words(ranges)}, so "
            "that it is not known which value is full scale. Quantise it again with `input_range`."
        )
    return ranges


def exposed_networks(
    networks: Sequence[Network],
    around: Around,
    tiling: Tiling,
    full_scale: float,
    opened: Callable[[onnx.ModelProto], Infer],
) -> tuple[ExposedNetwork, ...]:
    """Build the network of each band at its exposures.

    Args:
        networks: one for all bands or one for each.
        around: whether higher exposures are used.
        tiling: how the networks meet an image.
        full_scale: the pixel value that is 1.0 to a network.
        opened: makes a network ready to run.
    """
    built = []
    for network in networks:
        ranges = _stated_ranges(network)
        others = exposures_of(network, around)
        infers = {factor: opened(other.model) for factor, other in others.items()}
        offset = 0.0
        if network.profile is not None and others:
            offset = offset_of(network.profile, full_scale)
        infer = opened(network.model)
        infers = {1: InRange(infer, ranges) if ranges else infer, **infers}
        built.append(ExposedNetwork(infers, tiling.halo_px, offset))
    return tuple(built)


def offset_of(sensor: Sensor, full_scale: float) -> float:
    """Return the pixel value of the dark."""
    instrument = sensor.nominal()
    return instrument.offset_dn * full_scale / instrument.max_dn


def consistency_steps(
    around: Around,
    sensors: Mapping[str, Sensor],
    raster: Raster,
    tiling: Tiling,
    full_scale: float,
) -> tuple[tuple[Consistency | None, ...], str]:
    """Build the consistency step, one for all bands or one for each, and say in words whether it is
    taken.

    "blind" is the name of no sensor: a band of that name has None.
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
    """Return True if a network gives one pixel of the same band for each pixel, as the consistency
    step needs.
    """
    return tiling.scale == 1 and tiling.channels_in == tiling.channels_out


def step_for(sensor: Sensor, full_scale: float) -> Consistency:
    """Build the consistency step for the middle of a sensor's ranges and its reference."""
    return Consistency.of(sensor.nominal(), sensor.reference.nominal(), full_scale)
