"""The methods that can be compared, by name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch

from deploy.defaults import float_model
from deploy.restoration.arrays import TILE_PX, restore_image
from model.shipped import SHIPPED, shipped_names, shipped_weights
from model.traditional.peers import PEERS
from model.traditional.pipeline import Chain, restore_traditional
from model.traditional.settings import QUALITIES
from profiles.errors import OptionError
from profiles.sensor import Sensor
from quant.onnx_file import load_onnx, metadata
from quant.radius import receptive_radius_px
from quant.session import open_session

Restore = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""

TRADITIONAL, DECONVOLVE_FIRST = "traditional", "deconvolve-first"
EXPECTED = (
    f"degraded, {TRADITIONAL}, {DECONVOLVE_FIRST} (each also with -fast or -best), {', '.join(PEERS)}, "
    f"a shipped network ({', '.join(shipped_names())}, each also with -int8), or an ONNX or safetensors file"
)


KNOWS, BLIND, TRAINED = "known", "blind", "trained for it"
"""What a method knows of the sensor: the last of a network whose file names the sensor."""


@dataclass(frozen=True)
class Method:
    """A restoration with the name it is listed under, and what it was told."""

    name: str
    restore: Restore
    told: str


def method_named(name: str, degraded: Sensor, reference: Sensor, sensor_name: str = "") -> Method:
    """The method of that name; the traditional ones are told both sensors, a network full scale alone.

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
    if name == "degraded":
        return Method(name, lambda dn: dn, "nothing: the input itself")
    chain = _chain(name, degraded, reference)
    if chain is not None:
        return Method(name, lambda dn: restore_traditional(torch.from_numpy(dn), chain).numpy(), KNOWS)
    if name in PEERS:
        plain = Chain(degraded, reference)
        return Method(name, lambda dn: PEERS[name](torch.from_numpy(dn), plain).numpy(), KNOWS)
    model = _network(name)
    return Method(name, _restoring(model, degraded.max_dn), knowledge_of(model, sensor_name))


def knowledge_of(model: onnx.ModelProto, sensor_name: str) -> str:
    """What a network knows of the sensor of that name: nothing, or that it was trained or folded for it."""
    return TRAINED if sensor_name and metadata(model).get("sensor") == sensor_name else BLIND


def _chain(name: str, degraded: Sensor, reference: Sensor) -> Chain | None:
    for stem, order in ((TRADITIONAL, "denoise-first"), (DECONVOLVE_FIRST, "deconvolve-first")):
        for quality in QUALITIES:
            if name == f"{stem}-{quality}" or (name == stem and quality == "standard"):
                return Chain(degraded, reference, quality, order)  # type: ignore[arg-type]
    return None


def _network(name: str) -> onnx.ModelProto:
    path = Path(name)
    if path.suffix in (".onnx", ".safetensors"):
        return float_model(path)
    if name in shipped_names():
        return float_model(shipped_weights(name))
    if (SHIPPED / f"{name}.onnx").is_file():
        return load_onnx(SHIPPED / f"{name}.onnx")
    raise OptionError("--methods", expected=EXPECTED, got=repr(name), remedy="correct that name")


def _restoring(model: onnx.ModelProto, max_dn: int) -> Restore:
    session, halo_px = open_session(model), receptive_radius_px(model)
    return partial(_run_network, session=session, halo_px=halo_px, max_dn=max_dn)


def _run_network(dn: np.ndarray, session: ort.InferenceSession, halo_px: int, max_dn: int) -> np.ndarray:
    return restore_image(dn, session, TILE_PX, halo_px, max_dn=max_dn).astype(np.float32)
