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

import onnx
import torch

from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.model.traditional.baselines import BASELINES
from beers_deploy.model.traditional.patch_groups import QUALITIES
from beers_deploy.model.traditional.pipeline import Order, TraditionalPipeline, restore_traditional
from beers_deploy.network import Network
from beers_deploy.network_files import conditioned, other_sensor, warn_outside
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND as NOT_KNOWN
from beers_deploy.profiles.shipped import BLIND_PROFILE
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.method import Restore, network_method
from beers_deploy.restoration.steps import BOTH, Around, exposures_of

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
    """A restoration with the name it is listed under, and its knowledge of the sensor.

    Attributes:
        name: in tables.
        restore: the restoration.
        sensor_known: the knowledge of the sensor that the restoration uses, in words.
        specialise: returns the restoration for another known sensor; None if it does not depend on
            a sensor.
    """

    name: str
    restore: Restore
    sensor_known: str
    specialise: Specialise | None = None

    def with_sensor(self, sensor: Instrument) -> "Method":
        """Return this method for the given sensor, or itself if it does not depend on a sensor."""
        if self.specialise is None:
            return self
        return replace(self, restore=self.specialise(sensor), sensor_known=KNOWN)


def method_without_network(name: str, degraded: Instrument, reference: Instrument) -> Method:
    """Return the method of WITHOUT_NETWORK: the input itself, or a traditional method that knows
    both sensors.
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


def method_named(name: str, degraded: Sensor, reference: Sensor, around: Around = BOTH) -> Method:
    """Return the method of that name. The traditional ones know both sensors, a shipped network the
    degraded one.

    Args:
        name: one of METHOD_NAMES.
        degraded: the sensor of the images.
        reference: the sensor that is aimed at.
        around: the steps around a network that are used.
    """
    if name in WITHOUT_NETWORK:
        return method_without_network(name, degraded.nominal(), reference.nominal())
    network, _, other = name.partition("@")
    shipped = network.removesuffix(INT8) in shipped_names()
    if not shipped and Path(network).suffix not in (".onnx", ".safetensors"):
        raise OptionError(
            f"{printable(repr(name))} in `methods` is not a method. Give {METHOD_NAMES}."
        )
    sensor = Sensor.load(other) if other else degraded
    weights = conditioned(Path(network))
    if weights is None:
        loaded = Network.load(network)
        warning = other_sensor(loaded.model, sensor)
        if warning:
            logger.warning("%s: %s", network, warning)
        return method_of(name, loaded, sensor, reference, around, degraded.name)
    int8 = network.endswith(INT8)
    warn_outside(sensor, weights.kernels)
    network_for = Network.for_sensor(weights, sensor, int8=int8)
    method = method_of(name, network_for, sensor, reference, around, degraded.name)
    # A name with @SENSOR asks for that sensor: another one does not take its place.
    if other:
        return method

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
    acquired_by: str = "",
) -> Method:
    """Return a network as a method.

    Args:
        name: in tables.
        network: float or INT8.
        sensor: the sensor that the steps around the network use.
        reference: the sensor that is aimed at.
        around: the steps that are used.
        acquired_by: the name of the images' sensor; that of `sensor` if empty.
    """
    restore = network_restore(network, sensor, reference.nominal(), around)
    return Method(name, restore, knowledge_of(network.model, acquired_by or sensor.name))


def network_restore(
    network: Network, sensor: Sensor, reference: Instrument, around: Around
) -> Restore:
    """Return the restoration by a network with the steps around it, in which dark parts are
    restored at a higher exposure.
    """
    exposures = exposures_of(network, around)
    brighter = {factor: other.model for factor, other in exposures.items()}
    instrument = sensor.nominal()
    # The consistency step blurs the result as the sensor does: it needs one that is known.
    aim = None
    if around.consistency and sensor.name != NOT_KNOWN:
        aim = reference.in_units_of(instrument)
    return network_method(network.model, instrument.max_dn, brighter, instrument, aim)


def knowledge_of(model: onnx.ModelProto, sensor_name: str) -> str:
    """Return which sensor a network knows: the one with that name, none, or another one."""
    own = metadata(model).get("sensor", "")
    # A file without a sensor in its metadata was conditioned on none.
    if own in ("", NOT_KNOWN, BLIND_PROFILE):
        return BLIND
    return KNOWN if own == sensor_name else f"another: {own}"


def profile_of(sensor: Instrument, like: Sensor) -> Sensor:
    """Return a profile from which every draw is that sensor, in the grid of another profile."""
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
    # The sensor has alpha and beta: SNRs would have them drawn again.
    noise = {"snr_0": None, "snr_1": None}
    return like.with_fields(name="drawn", **constants, **noise, response=sensor.response)
