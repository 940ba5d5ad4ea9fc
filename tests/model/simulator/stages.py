"""Sensors and scenes for the simulator's tests, and the signal before digitising."""

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from model.simulator.acquire import without
from model.simulator.detector import DN_EFFECTS, RADIANCE_EFFECTS, Draw, add_noise, apply_effect
from model.simulator.mtf import sensor_transfer
from model.simulator.sampling import sample, scene_spectrum
from profiles import load_sensor
from profiles.effects import Effect, middle_effect
from profiles.scene_call import typical_effects
from profiles.sensor import Sensor

TYPICAL: dict[str, Effect] = {name: middle_effect(name, table) for name, table in typical_effects().items()}


def plain_sensor(**effects: Effect) -> Sensor:
    """The nominal degraded sensor with these effects."""
    return replace(load_sensor("pleiades-degraded").nominal(), effects=effects)


def before_digitising(radiance: Tensor, sensor: Sensor, ratio: int, draw: Draw, skip: Collection[str] = ()) -> Tensor:
    """What `simulate_planned` computes, up to the converter, so that no rounding hides a difference."""
    if "mtf" in skip:
        signal = torch.nn.functional.avg_pool2d(radiance[None, None], ratio)[0, 0]
    else:
        height, width = radiance.shape
        transfer = sensor_transfer(height, width, ratio, without(sensor, skip))
        signal = sample(scene_spectrum(radiance), transfer, width, ratio)
    for name in RADIANCE_EFFECTS:
        signal = _apply(signal, name, sensor, draw, skip)
    if "noise" not in skip:
        signal = add_noise(signal, sensor, draw.generator("noise-degraded"))
    dn = signal * sensor.gain_dn_per_radiance
    for name in DN_EFFECTS:
        dn = _apply(dn, name, sensor, draw, skip)
    return dn


def _apply(image: Tensor, name: str, sensor: Sensor, draw: Draw, skip: Collection[str]) -> Tensor:
    if name in skip or name not in sensor.effects:
        return image
    return apply_effect(image, sensor.effects[name], sensor, partial(draw.generator, f"{name}-degraded"))
