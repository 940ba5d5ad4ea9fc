"""The methods that can be compared, by name, and the knowledge of the sensor that each of them has.

They are the input itself, the traditional pipeline in both orders and three qualities, methods of
other libraries, and networks.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Final

import torch

from beers_deploy.conditioned_file import to_run_on
from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.model.traditional.baselines import BASELINES
from beers_deploy.model.traditional.patch_groups import QUALITIES
from beers_deploy.model.traditional.pipeline import Order, TraditionalPipeline, restore_traditional
from beers_deploy.network import Network
from beers_deploy.network_files import UNKNOWN_SENSORS, other_sensor
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.method import Restore, network_restore
from beers_deploy.restoration.steps import BOTH, Around

logger = logging.getLogger(__name__)

Specialise = Callable[[Instrument], Restore]
"""Maps a sensor to the restoration of images that it acquired."""

DEGRADED: Final = "degraded"
TRADITIONAL: Final = "traditional"
DECONVOLVE_FIRST: Final = "deconvolve-first"

ORDERS: dict[str, Order] = {TRADITIONAL: "denoise-first", DECONVOLVE_FIRST: "deconvolve-first"}
PIPELINES: dict[str, tuple[str, Order]] = {
    **{
        f"{name}-{quality}": (quality, order)
        for (name, order), quality in product(ORDERS.items(), QUALITIES)
    },
    **{
        name: ("standard", order)
        for name, order in (ORDERS | dict.fromkeys(BASELINES, ORDERS[TRADITIONAL])).items()
    },
}
"""Quality and order of each traditional pipeline and of each baseline of scikit-image, by name."""
WITHOUT_NETWORK = (DEGRADED, *PIPELINES)
"""The input itself, the traditional pipelines, and the baselines of scikit-image."""

KNOWN = "known"
BLIND = "blind"
"""The knowledge of the sensor that a method may have."""


@dataclass(frozen=True)
class Method:
    """A way to restore images that an evaluation compares with others: a network, the traditional
    pipeline, a function of the user, or no restoration at all.

    Attributes:
        name: the name in tables.
        restore: the function from degraded to restored digital numbers, (H, W) each.
        sensor_known: the knowledge of the sensor, in words: known, blind or another one.
        specialise: returns the function `restore` of the same method for another sensor; None if
            the method does not depend on a sensor, or always assumes the same one.
    """

    name: str
    restore: Restore
    sensor_known: str
    specialise: Specialise | None = None

    def with_sensor(self, sensor: Instrument) -> "Method":
        """Return this method for images of the given sensor, or the method itself if `specialise`
        is None.
        """
        if self.specialise is None:
            return self
        return replace(self, restore=self.specialise(sensor), sensor_known=KNOWN)


def method_without_network(name: str, degraded: Instrument, reference: Instrument) -> Method:
    """Build a method that needs no network: the degraded input itself, a traditional pipeline, or a
    baseline of scikit-image.

    Args:
        name: one of `WITHOUT_NETWORK`.
        degraded: the sensor of the degraded images, which all but the input itself know.
        reference: the sensor that the restoration aims at.
    """
    if name == DEGRADED:
        return Method(name, lambda dn: dn, "the input itself")
    quality, order = PIPELINES[name]
    run = BASELINES.get(name, restore_traditional)

    def specialise(sensor: Instrument) -> Restore:
        pipeline = TraditionalPipeline(sensor, reference.in_units_of(sensor), quality, order)
        return lambda dn: run(torch.from_numpy(dn), pipeline).numpy()

    return Method(name, specialise(degraded), KNOWN, specialise)


METHOD_NAMES = (
    f"degraded, {TRADITIONAL}, {DECONVOLVE_FIRST} (each also with -fast or -best), "
    f"{', '.join(BASELINES)}, a shipped network ({', '.join(shipped_names())}, each also "
    "with -int8, and with @SENSOR or @blind for another sensor), or an ONNX or safetensors file"
)


def network_and_sensor(name: str) -> tuple[str, str | None]:
    """Split NETWORK@SENSOR into its two parts, of which the second is None if there is no @. The
    path of a file may have an @ in it.
    """
    if Path(name).is_file():
        return name, None
    network, at, sensor = name.partition("@")
    return network, sensor if at else None


def method_named(name: str, degraded: Sensor, reference: Sensor, around: Around = BOTH) -> Method:
    """Build the method that a user names in `methods`.

    Traditional methods know both sensors, a shipped network the degraded one.

    Args:
        name: one of METHOD_NAMES: a traditional method, a shipped network or a network's file.
            NETWORK@SENSOR tells the network another sensor than the images'.
        degraded: the sensor of the degraded images.
        reference: the sensor that the restoration aims at.
        around: the steps around a network that are used: exposures and the consistency step.

    Raises:
        OptionError: there is no such method.
        BeersError: the network or the sensor cannot be loaded.
    """
    if name in WITHOUT_NETWORK:
        return method_without_network(name, degraded.nominal(), reference.nominal())
    network, other = network_and_sensor(name)
    shipped = network.removesuffix(INT8) in shipped_names()
    if not shipped and Path(network).suffix not in (".onnx", ".safetensors"):
        raise OptionError(
            f"{printable(repr(name))} in `methods` is not a method. Give {METHOD_NAMES}."
        )
    sensor = degraded if other is None else Sensor.load(other)
    loaded = to_run_on(Network.load(network, sensor=sensor), sensor)
    weights = loaded.weights
    method = method_of(name, loaded, sensor, reference, around, degraded)
    if weights is None:
        warning = other_sensor(loaded.model, sensor)
        if warning:
            logger.warning("%s: %s", network, warning)
        return method
    # A name with @SENSOR asks for that sensor: another one does not take its place.
    if other is not None:
        return method
    int8 = loaded.precision == "int8"

    def specialise(instrument: Instrument) -> Restore:
        profile = profile_of(instrument, degraded)
        drawn = Network.for_sensor(weights, profile, int8=int8)
        return network_restore(drawn, profile, reference.nominal(), around)

    return replace(method, specialise=specialise)


def method_of(
    name: str,
    network: Network,
    sensor: Sensor,
    reference: Sensor,
    around: Around = BOTH,
    acquired_by: Sensor | None = None,
) -> Method:
    """Build a method from a loaded network and the steps around it.

    Args:
        name: the name of the method in tables.
        network: the network, float or INT8.
        sensor: the sensor that the steps around the network use.
        reference: the sensor that the restoration aims at.
        around: the steps that are used: exposures and the consistency step.
        acquired_by: the sensor of the images, whose name decides if the network knows it, and whose
            bits decide what full scale is; `sensor` if None.
    """
    images = acquired_by or sensor
    max_dn = images.nominal().max_dn
    restore = network_restore(network, sensor, reference.nominal(), around, max_dn=max_dn)
    known = f"another: {network.sensor}"
    # A file without a sensor in its metadata was conditioned on none.
    if network.sensor in UNKNOWN_SENSORS:
        known = BLIND
    elif network.sensor == images.name:
        known = KNOWN
    return Method(name, restore, known)


def profile_of(sensor: Instrument, like: Sensor) -> Sensor:
    """Convert an instrument to a sensor profile without ranges, named "drawn".

    Args:
        sensor: the instrument, whose MTF, noise, gain and bits the profile gets.
        like: the profile from which all other fields are copied, such as the oversampling.
    """
    across, along = sensor.mtf_axes
    numbers = {
        "mtf_nyquist": across,
        "mtf_nyquist_along": along,
        "alpha": sensor.alpha,
        "beta": sensor.beta,
        "gain_dn_per_radiance": sensor.gain_dn_per_radiance,
        "bits": float(sensor.bits),
    }
    constants = {
        name: Constant(value, "assumed", "a sensor drawn") for name, value in numbers.items()
    }
    # The noise is stated by alpha and beta, which exclude SNRs.
    noise = {"snr_0": None, "snr_1": None}
    return like.with_fields(name="drawn", **constants, **noise, response=sensor.response)
