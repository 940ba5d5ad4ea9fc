"""What a method of restoration is to those who compare it, and the methods that need no network.

They are the input itself, the traditional chain in both orders and three qualities, and other libraries' ways.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from model.traditional.peers import PEERS
from model.traditional.pipeline import Chain, Order, restore_traditional
from model.traditional.settings import QUALITIES
from profiles.sensor import Sensor

Restore = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""

Specialise = Callable[[Sensor], Restore]
"""A sensor to the restoration of images that it acquired."""

DEGRADED, TRADITIONAL, DECONVOLVE_FIRST = "degraded", "traditional", "deconvolve-first"

ORDERS: dict[str, Order] = {TRADITIONAL: "denoise-first", DECONVOLVE_FIRST: "deconvolve-first"}
STANDARD = "standard"
CHAINS: dict[str, tuple[str, Order]] = {
    **{f"{name}-{quality}": (quality, order) for name, order in ORDERS.items() for quality in QUALITIES},
    **{name: (STANDARD, order) for name, order in ORDERS.items()},
}
"""Quality and order of each traditional chain, by name."""

KNOWN, BLIND = "known", "blind"
"""What a method knows of the sensor."""


@dataclass(frozen=True)
class Method:
    """A restoration with the name it is listed under, and what it knows of the sensor.

    Attributes:
        name: in tables.
        restore: what it does.
        sensor_known: what it knows of the sensor when it does so, in words.
        specialise: how it restores when it knows another sensor; None where what it does depends on none.
    """

    name: str
    restore: Restore
    sensor_known: str
    specialise: Specialise | None = None

    def knowing(self, sensor: Sensor) -> "Method":
        """This method with that sensor known; itself where what it does depends on none."""
        if self.specialise is None:
            return self
        return replace(self, restore=self.specialise(sensor), sensor_known=KNOWN)


def method_without_network(name: str, degraded: Sensor, reference: Sensor) -> Method | None:
    """The input itself, or a traditional chain or a peer of it, which know both sensors; None for any other name.

    Raises:
        MachineError: a peer whose library is not installed.
    """
    if name == DEGRADED:
        return Method(name, lambda dn: dn, "the input itself")
    specialise = _specialise(name, reference)
    return None if specialise is None else Method(name, specialise(degraded), KNOWN, specialise)


def _specialise(name: str, reference: Sensor) -> Specialise | None:
    """How a chain or a peer of that name restores for a sensor, to the reference in that sensor's units."""
    if name not in (*CHAINS, *PEERS):
        return None
    quality, order = CHAINS.get(name, (STANDARD, "denoise-first"))
    run = PEERS.get(name, restore_traditional)

    def specialise(sensor: Sensor) -> Restore:
        chain = Chain(sensor, reference.in_units_of(sensor), quality, order)
        return lambda dn: run(torch.from_numpy(dn), chain).numpy()

    return specialise
