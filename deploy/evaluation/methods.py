"""The methods that can be compared, by name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import onnxruntime as ort
import torch

from deploy.defaults import float_model
from deploy.restore import TILE_PX, restore_image
from model.shipped import SHIPPED, shipped_names, shipped_weights
from model.traditional.peers import PEERS
from model.traditional.pipeline import Chain, restore_traditional
from model.traditional.settings import QUALITIES
from profiles.errors import OptionError
from profiles.sensor import Sensor
from quant.onnx_file import load_onnx
from quant.radius import receptive_radius_px
from quant.session import open_session

Restore = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""

TRADITIONAL, DECONVOLVE_FIRST = "traditional", "deconvolve-first"
EXPECTED = (
    f"degraded, {TRADITIONAL}, {DECONVOLVE_FIRST} (each also with -fast or -best), {', '.join(PEERS)}, "
    f"a shipped network ({', '.join(shipped_names())}, each also with -int8), or an ONNX or safetensors file"
)


@dataclass(frozen=True)
class Method:
    """A restoration with the name it is listed under, and what it was told."""

    name: str
    restore: Restore
    told: str


def method_named(name: str, degraded: Sensor, reference: Sensor) -> Method:
    """The method of that name; the traditional ones are told both sensors, a network full scale alone.

    Raises:
        OptionError: no such method.
        ModelError: a file that is no network.
        MachineError: a peer whose library is not installed.
    """
    if name == "degraded":
        return Method(name, lambda dn: dn, "nothing: the input itself")
    chain = _chain(name, degraded, reference)
    if chain is not None:
        return Method(name, lambda dn: restore_traditional(torch.from_numpy(dn), chain).numpy(), "both sensors")
    if name in PEERS:
        plain = Chain(degraded, reference)
        return Method(name, lambda dn: PEERS[name](torch.from_numpy(dn), plain).numpy(), "both sensors")
    return Method(name, _network(name, degraded.max_dn), "nothing")


def _chain(name: str, degraded: Sensor, reference: Sensor) -> Chain | None:
    for stem, order in ((TRADITIONAL, "denoise-first"), (DECONVOLVE_FIRST, "deconvolve-first")):
        for quality in QUALITIES:
            if name == f"{stem}-{quality}" or (name == stem and quality == "standard"):
                return Chain(degraded, reference, quality, order)  # type: ignore[arg-type]
    return None


def _network(name: str, max_dn: int) -> Restore:
    path = Path(name)
    if path.suffix in (".onnx", ".safetensors"):
        model = float_model(path)
    elif name in shipped_names():
        model = float_model(shipped_weights(name))
    elif (SHIPPED / f"{name}.onnx").is_file():
        model = load_onnx(SHIPPED / f"{name}.onnx")
    else:
        raise OptionError("--methods", expected=EXPECTED, got=repr(name), remedy="correct that name")
    session, halo_px = open_session(model), receptive_radius_px(model)
    return partial(_run_network, session=session, halo_px=halo_px, max_dn=max_dn)


def _run_network(dn: np.ndarray, session: ort.InferenceSession, halo_px: int, max_dn: int) -> np.ndarray:
    return restore_image(dn, session, TILE_PX, halo_px, max_dn=max_dn).astype(np.float32)
