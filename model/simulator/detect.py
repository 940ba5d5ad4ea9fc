"""What the detectors and the electronics do to the sampled signal, on the target grid: the order stands here.

veil -> full well -> PRNU -> noise -> gain -> DSNU -> striping -> offset -> defects -> digitising
"""

from collections.abc import Callable, Collection
from functools import partial

import numpy as np
from torch import Tensor

from model.simulator.defects import add_defects
from model.simulator.digitise import digitise_dn
from model.simulator.draws import Draw
from model.simulator.fixed_pattern import apply_dsnu, apply_prnu, apply_striping
from model.simulator.full_well import saturate
from model.simulator.noise import add_noise
from model.simulator.veil import add_veil
from profiles.effects import Defects, Dsnu, Effect, FullWell, Offset, Prnu, Striping, Veil
from profiles.sensor import Sensor

RADIANCE_EFFECTS = ("veil", "full_well", "prnu")
DN_EFFECTS = ("dsnu", "striping", "offset", "defects")


def detect(signal: Tensor, sensor: Sensor, draw: Draw, role: str, skip: Collection[str] = ()) -> Tensor:
    """Whole digital numbers of a blurred, sampled signal (..., H, W) in W/m2/sr/um.

    Args:
        signal: radiance on the target grid.
        sensor: the instrument; it has an effect by having its table.
        draw: seed and patch number; each effect takes its own generator from it.
        role: "degraded" or "reference", so that the two draws of a pair differ.
        skip: effects to leave out, see `plan.Plan.skipped`.
    """
    wanted = {name: effect for name, effect in sensor.effects.items() if name not in skip}

    def apply(image: Tensor, names: tuple[str, ...]) -> Tensor:
        for name in names:
            if name in wanted:
                image = apply_effect(image, wanted[name], sensor, partial(draw.generator, f"{name}-{role}"))
        return image

    signal = apply(signal, RADIANCE_EFFECTS)
    if "noise" not in skip:
        signal = add_noise(signal, sensor, draw.generator(f"noise-{role}"))
    return digitise_dn(apply(signal * sensor.gain_dn_per_radiance, DN_EFFECTS), sensor)


def apply_effect(
    image: Tensor, effect: Effect, sensor: Sensor, generator: Callable[[], np.random.Generator]
) -> Tensor:
    """Apply one effect of the target grid; the generator is made only for those that draw."""
    match effect:
        case Veil():
            return add_veil(image, effect)
        case FullWell():
            return saturate(image, effect)
        case Prnu():
            return apply_prnu(image, effect, generator())
        case Dsnu():
            return apply_dsnu(image, effect, generator())
        case Striping():
            return apply_striping(image, effect)
        case Offset():
            return image + effect.offset_dn
        case Defects():
            return add_defects(image, effect, sensor.max_dn, generator())
        case _:
            return image  # part of the transfer function
