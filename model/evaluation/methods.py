"""What a method of restoration is to those who compare it, and the methods that need no network.

They are the input itself, the traditional chain in both orders and three qualities, and other libraries' ways.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from model.traditional.peers import PEERS
from model.traditional.pipeline import Chain, restore_traditional
from model.traditional.settings import QUALITIES
from profiles.sensor import Sensor

Restore = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""

Specialise = Callable[[Sensor], Restore]
"""How a method restores when it knows a sensor."""

TRADITIONAL, DECONVOLVE_FIRST = "traditional", "deconvolve-first"

KNOWN, BLIND = "known", "blind"
"""What a method knows of the sensor."""


@dataclass(frozen=True)
class Method:
    """A restoration with the name it is listed under, and what it knows of the sensor."""

    name: str
    restore: Restore
    sensor_known: str
    specialise: Specialise | None = None


def method_without_network(name: str, degraded: Sensor, reference: Sensor) -> Method | None:
    """The input itself, or a traditional chain or a peer of it, which know both sensors; None for any other name.

    Raises:
        MachineError: a peer whose library is not installed.
    """
    if name == "degraded":
        return Method(name, lambda dn: dn, "the input itself")
    chain = _chain(name, degraded, reference)
    if chain is not None:
        return Method(name, lambda dn: restore_traditional(torch.from_numpy(dn), chain).numpy(), KNOWN)
    if name in PEERS:
        plain = Chain(degraded, reference)
        return Method(name, lambda dn: PEERS[name](torch.from_numpy(dn), plain).numpy(), KNOWN)
    return None


def _chain(name: str, degraded: Sensor, reference: Sensor) -> Chain | None:
    for stem, order in ((TRADITIONAL, "denoise-first"), (DECONVOLVE_FIRST, "deconvolve-first")):
        for quality in QUALITIES:
            if name == f"{stem}-{quality}" or (name == stem and quality == "standard"):
                return Chain(degraded, reference, quality, order)  # type: ignore[arg-type]
    return None
