"""A network, with the steps around it, as a method that restores images in memory and that studies
compare.

The pixels are the same as those that `restore` writes.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import onnx

from beers_deploy.model.consistency.step import Consistency
from beers_deploy.network import Network
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND, TILE_PX
from beers_deploy.restoration.plan import Plan, make_plan
from beers_deploy.restoration.runtime import Infer, at_first_call, open_runtime
from beers_deploy.restoration.steps import Around, exposed_networks
from beers_deploy.restoration.tiles.rows import restore_floats

Restore = Callable[[np.ndarray], np.ndarray]
"""Maps degraded digital numbers (H, W) float32 to restored ones."""


def network_restore(
    network: Network,
    sensor: Sensor,
    reference: Instrument,
    around: Around,
    plan_of: Callable[[tuple[int, ...]], Plan] | None = None,
    max_dn: int | None = None,
) -> Restore:
    """Build the function that restores an image in memory by a network and the steps around it.

    Args:
        network: the network, float or INT8.
        sensor: the sensor of the images. The sensor named "blind" is unknown, and the consistency
            step is then omitted.
        reference: the sensor that the restoration aims at.
        around: the steps around the network that are used: exposures and the consistency step.
        plan_of: returns the tiles of an image, given its shape (H, W). If None, tiles have the
            default size, or the size that the network is fixed to.
        max_dn: the largest digital number of the images; that of `sensor` if None.

    Returns:
        A function from degraded digital numbers (H, W) float32 to restored ones, whole numbers of
        the same shape and type.

    Raises:
        ModelError: the network cannot be applied to tiles, or is for values of an unknown scale.
    """
    tiling = network.tiling
    instrument = sensor.nominal()
    full_scale = instrument.max_dn if max_dn is None else max_dn
    (exposed,) = exposed_networks([network], around, tiling, full_scale, _opened)
    consistency: tuple[Consistency, ...] = ()
    # The consistency step blurs the result as the sensor does: it needs one that is known.
    if around.consistency and sensor.name != BLIND:
        aim = reference.in_units_of(instrument)
        consistency = (Consistency.of(instrument, aim, full_scale),)

    def restore(dn: np.ndarray) -> np.ndarray:
        if plan_of is None:
            tile_px = tiling.fixed_px or TILE_PX
            plan = make_plan((1, *dn.shape), tile_px, tiling.halo_px, tiling)
        else:
            plan = plan_of(dn.shape)
        return np.asarray(np.rint(restore_floats(dn, exposed, plan, full_scale, consistency)))

    return restore


def _opened(model: onnx.ModelProto) -> Infer:
    return at_first_call(partial(open_runtime, "onnxruntime", model, 0))
