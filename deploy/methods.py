"""The methods that can be compared, by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx

from deploy.export import float_model
from deploy.networks import Say, conditioned, network_file, silent, warn_outside
from deploy.restoration.engine import restore_dn
from deploy.restoration.options import TILE_PX, Runtime
from deploy.restoration.plan import make_plan
from deploy.restoration.runtime import Infer, open_runtime
from model.evaluation.methods import (
    BLIND,
    DECONVOLVE_FIRST,
    KNOWN,
    TRADITIONAL,
    Method,
    Restore,
    Specialise,
    method_without_network,
)
from model.shipped import INT8, shipped_names
from model.traditional.peers import PEERS
from profiles.constant import Constant
from profiles.errors import OptionError
from profiles.sensor import Sensor, SensorProfile
from profiles.sensor_file import BLIND as NOT_KNOWN
from profiles.sensor_file import BLIND_PROFILE, load_sensor
from quant.onnx_file import metadata
from quant.tiling.walk import tiling_of

EXPECTED = (
    f"degraded, {TRADITIONAL}, {DECONVOLVE_FIRST} (each also with -fast or -best), {', '.join(PEERS)}, "
    f"a shipped network ({', '.join(shipped_names())}, each also with -int8, and with @SENSOR or @blind to know "
    "another), or an ONNX or safetensors file"
)

DRAWN = "drawn"
"""What a sensor is called that no profile states."""

AT = "@"
"""Between a network's name and the sensor that it is to know in the place of the images' own."""


def method_named(name: str, degraded: SensorProfile, reference: SensorProfile, say: Say = silent) -> Method:
    """The method of that name; the traditional ones know both sensors, a shipped network the degraded one.

    Args:
        name: as in EXPECTED.
        degraded: the sensor of the images.
        reference: the one that is aimed at.
        say: is told what of the sensor lies outside the range that a network was trained for.

    Raises:
        OptionError: no such method.
        ModelError: a file that is no network.
        ProfileError: no such sensor behind an @.
        MachineError: a peer whose library is not installed.
    """
    plain = method_without_network(name, degraded.nominal(), reference.nominal())
    if plain is not None:
        return plain
    network, _, other = name.partition(AT)
    if not _is_network(network):
        raise OptionError("--methods", expected=EXPECTED, got=repr(name), remedy="correct that name")
    sensor = load_sensor(other) if other else degraded
    model = float_model(network_file(Path(network), sensor, say))
    known = knowledge_of(model, degraded.name)
    specialise = None if other else _specialise(network, degraded, say)
    return Method(name, network_method(model, degraded.nominal().max_dn), known, specialise)


def _specialise(name: str, like: SensorProfile, say: Say) -> Specialise | None:
    """A conditioned network told any sensor in the grid of a profile; None of a network that is plain."""
    found = conditioned(Path(name))
    if found is None:
        return None

    def specialise(sensor: Sensor) -> Restore:
        known = profile_of(sensor, like)
        warn_outside(known, say)
        return network_method(found.model(known, name.endswith(INT8)), sensor.max_dn)

    return specialise


def _is_network(name: str) -> bool:
    return Path(name).suffix in (".onnx", ".safetensors") or name.removesuffix(INT8) in shipped_names()


def knowledge_of(model: onnx.ModelProto, sensor_name: str) -> str:
    """What a network knows of the sensor of that name: it, nothing, or another one."""
    own = metadata(model).get("sensor", "")
    if own in ("", NOT_KNOWN, BLIND_PROFILE):
        return BLIND
    return KNOWN if own == sensor_name else f"another: {own}"


def profile_of(sensor: Sensor, like: SensorProfile) -> SensorProfile:
    """A profile of which every draw is that sensor, in the grid of another profile."""
    across, along = sensor.mtf_axes
    numbers = {"mtf_nyquist": across, "mtf_nyquist_along": along, "alpha": sensor.alpha, "beta": sensor.beta}
    numbers |= {"gain_dn_per_radiance": sensor.gain_dn_per_radiance, "bits": float(sensor.bits)}
    constants = {name: Constant(value, "assumed", "a sensor drawn") for name, value in numbers.items()}
    noise = {"snr_0": None, "snr_1": None}
    return replace(like, name=DRAWN, **constants, **noise, response=sensor.response)  # type: ignore[arg-type]


def network_method(model: onnx.ModelProto, max_dn: int) -> Restore:
    """A network as a method: digital numbers of 0 to `max_dn` become whole ones, as `restore` writes them."""
    infer, _ = open_runtime(Runtime.onnxruntime, model, threads=0)
    return restoring(infer, model, max_dn)


def restoring(infer: Infer, model: onnx.ModelProto, max_dn: int) -> Restore:
    """As `network_method`, of a network that is open already; tiles are the default ones, or those it is fixed to."""
    tiling = tiling_of(model)

    def restore(dn: np.ndarray) -> np.ndarray:
        plan = make_plan((1, *dn.shape), tiling.fixed_px or TILE_PX, tiling.halo_px, tiling)
        return restore_dn(dn, infer, plan, max_dn)

    return restore
