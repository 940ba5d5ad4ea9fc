"""A network, with the steps around it, as a method that restores images in memory and that studies
compare.

The pixels are the same as those that `restore` writes.
"""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import onnx

from beers_deploy.model.consistency.step import Consistency
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.restoration.plan import Plan, make_plan
from beers_deploy.restoration.runtime import AtFirstCall, open_runtime
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import restore_floats

Restore = Callable[[np.ndarray], np.ndarray]
"""Maps degraded digital numbers (H, W) float32 to restored ones."""


def network_method(
    model: onnx.ModelProto,
    max_dn: int,
    exposed: Mapping[float, onnx.ModelProto],
    sensor: Instrument | None = None,
    reference: Instrument | None = None,
    plan_of: Callable[[tuple[int, ...]], Plan] | None = None,
) -> Restore:
    """Build a function that restores an image in memory by a network and the steps around it, to
    the same pixels that `restore` writes.

    Args:
        model: the network.
        max_dn: the largest digital number of the images, which is 1.0 to the network.
        exposed: the same network for pixels that are multiplied by a factor, by the factor. They
            restore dark parts and strong edges; empty to omit that.
        sensor: the sensor that acquired the images; None omits the consistency step, which makes
            the result agree with the raw image at low spatial frequencies.
        reference: the sensor that the restoration aims at; None omits the consistency step, too.
        plan_of: returns the tiles of an image, given its shape (H, W). If None, tiles have the
            default size, or the size that the network is fixed to.

    Returns:
        A function from digital numbers (H, W) float32 of 0 to `max_dn` to restored digital numbers
        of the same shape, whole numbers in float32.

    Raises:
        ModelError: the network cannot be opened, or cannot be applied to tiles.
    """
    infer, _ = open_runtime("onnxruntime", model, threads=0)
    tiling = tiling_of(model)
    # Few images ask for every factor.
    at_first_call = {
        factor: AtFirstCall(partial(open_runtime, "onnxruntime", other, 0))
        for factor, other in exposed.items()
    }
    offset = sensor.offset_dn * max_dn / sensor.max_dn if sensor else 0.0
    network = ExposedNetwork({1: infer, **at_first_call}, tiling.halo_px, offset)
    consistency = (Consistency.of(sensor, reference, max_dn),) if sensor and reference else ()

    def restore(dn: np.ndarray) -> np.ndarray:
        if plan_of is None:
            tile_px = tiling.fixed_px or TILE_PX
            plan = make_plan((1, *dn.shape), tile_px, tiling.halo_px, tiling)
        else:
            plan = plan_of(dn.shape)
        return np.asarray(np.rint(restore_floats(dn, network, plan, max_dn, consistency)))

    return restore
