"""A network as a function of an image's digital numbers, restored as the command `restore` does."""

from collections.abc import Callable

import numpy as np
import onnx

from beers_deploy.profiles.target import TILE_PX
from beers_deploy.quant.tiling.walk import tiling_of
from beers_deploy.restoration.engine import restore_dn
from beers_deploy.restoration.options import Runtime
from beers_deploy.restoration.plan import make_plan
from beers_deploy.restoration.runtime import open_runtime

Restore = Callable[[np.ndarray], np.ndarray]
"""Degraded digital numbers (H, W) float32 to restored ones."""


def network_method(model: onnx.ModelProto, max_dn: int) -> Restore:
    """A network as a method: digital numbers of 0 to `max_dn` become whole ones, as `restore` writes them.

    Tiles are the default ones, or those the network is fixed to.
    """
    infer, _ = open_runtime(Runtime.onnxruntime, model, threads=0)
    tiling = tiling_of(model)

    def restore(dn: np.ndarray) -> np.ndarray:
        plan = make_plan((1, *dn.shape), tiling.fixed_px or TILE_PX, tiling.halo_px, tiling)
        return restore_dn(dn, infer, plan, max_dn)

    return restore
