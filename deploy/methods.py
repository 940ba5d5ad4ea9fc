"""The methods that can be compared, by name."""

from pathlib import Path

import numpy as np
import onnx

from deploy.export import float_model
from deploy.restoration.engine import restore_dn
from deploy.restoration.options import TILE_PX, Runtime
from deploy.restoration.plan import make_plan
from deploy.restoration.runtime import Infer, open_runtime
from model.evaluation.methods import (
    BLIND,
    DECONVOLVE_FIRST,
    TRADITIONAL,
    TRAINED,
    Method,
    Restore,
    method_without_network,
)
from model.shipped import SHIPPED, shipped_names, shipped_weights
from model.traditional.peers import PEERS
from profiles.errors import OptionError
from profiles.sensor import Sensor
from quant.onnx_file import fixed_tile_px, load_onnx, metadata, receptive_radius_px

EXPECTED = (
    f"degraded, {TRADITIONAL}, {DECONVOLVE_FIRST} (each also with -fast or -best), {', '.join(PEERS)}, "
    f"a shipped network ({', '.join(shipped_names())}, each also with -int8), or an ONNX or safetensors file"
)


def method_named(name: str, degraded: Sensor, reference: Sensor, sensor_name: str = "") -> Method:
    """The method of that name; the traditional ones know both sensors, a network full scale alone.

    Args:
        name: as in EXPECTED.
        degraded: the sensor of the images.
        reference: the one that is aimed at.
        sensor_name: of the degraded sensor's profile, by which a network's file says that it was made for it.

    Raises:
        OptionError: no such method.
        ModelError: a file that is no network.
        MachineError: a peer whose library is not installed.
    """
    plain = method_without_network(name, degraded, reference)
    if plain is not None:
        return plain
    model = _network(name)
    return Method(name, network_method(model, degraded.max_dn), knowledge_of(model, sensor_name))


def knowledge_of(model: onnx.ModelProto, sensor_name: str) -> str:
    """What a network knows of the sensor of that name: nothing, or that it was trained or folded for it."""
    return TRAINED if sensor_name and metadata(model).get("sensor") == sensor_name else BLIND


def _network(name: str) -> onnx.ModelProto:
    path = Path(name)
    if path.suffix in (".onnx", ".safetensors"):
        return float_model(path)
    if name in shipped_names():
        return float_model(shipped_weights(name))
    if (SHIPPED / f"{name}.onnx").is_file():
        return load_onnx(SHIPPED / f"{name}.onnx")
    raise OptionError("--methods", expected=EXPECTED, got=repr(name), remedy="correct that name")


def network_method(model: onnx.ModelProto, max_dn: int) -> Restore:
    """A network as a method: digital numbers of 0 to `max_dn` become whole ones, as `restore` writes them."""
    infer, _ = open_runtime(Runtime.onnxruntime, model, threads=0)
    return restoring(infer, model, max_dn)


def restoring(infer: Infer, model: onnx.ModelProto, max_dn: int) -> Restore:
    """As `network_method`, of a network that is open already; tiles are the default ones, or those it is fixed to."""
    radius_px, fixed_px = receptive_radius_px(model), fixed_tile_px(model)

    def restore(dn: np.ndarray) -> np.ndarray:
        plan = make_plan((1, *dn.shape), fixed_px or TILE_PX, radius_px, radius_px, fixed_px is not None)
        return restore_dn(dn, infer, plan, max_dn)

    return restore
