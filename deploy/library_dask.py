"""A Dask array restored lazily: one task for each tile, which reads the window of that tile and nothing else.

Windows are slices of the array, so whatever its chunks are the tiles are those of a file, and so are the pixels.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from threading import Lock
from typing import Any

import numpy as np

from deploy.restore import Infer
from deploy.swath.options import Options
from deploy.swath.plan import Plan
from deploy.swath.raster import Raster
from deploy.swath.restorer import NAME, Restorer
from deploy.swath.run import plan_of
from deploy.swath.runtime import Packed, open_packed, pack
from deploy.tiling import Span
from model.scale import settled_scale
from quant.onnx_file import load_onnx

NETWORKS_KEPT = 2
_opening = Lock()


@dataclass(frozen=True)
class Task:
    """What all tiles of an array share."""

    raster: Raster
    network: Packed
    full_scale: float | None
    radius_px: int

    def restorer(self, window: np.ndarray) -> Restorer:
        """For this process, at the full scale that was asked for or that the window's pixels tell.

        Raises:
            ImageError: they leave it open.
        """
        largest = (self.raster.largest(part) for part in (window,))
        full_scale = settled_scale(NAME, self.raster.dtype, largest, self.full_scale)
        with _opening:
            infer = _kept(self.network)
        return Restorer(self.raster, infer, full_scale, self.radius_px, NAME)


def restore_lazily(bands: Any, raster: Raster, options: Options) -> Any:
    """A lazy (bands, H, W) array of Dask; errors in options and model come at once, in pixels when it is computed."""
    da: Any = import_module("dask.array")
    delayed: Any = import_module("dask").delayed
    network = load_onnx(options.model)
    plan = plan_of(raster, network, options)
    settled_scale(NAME, raster.dtype, (), options.full_scale)  # what the type alone decides comes at once
    packed = pack(network, options.runtime, options.threads or 1)
    task = delayed(Task(raster, packed, options.full_scale, plan.radius_px))
    tile = delayed(restore_tile)

    def block(plane: int, row: Span, column: Span) -> Any:
        rows, columns = (_around(span, raster, plan) for span in (row, column))
        window = bands[plane : plane + 1, rows, columns]
        shape = (1, row.keep_stop - row.keep_start, column.keep_stop - column.keep_start)
        restored = tile(task, window, rows.start, columns.start, row, column)
        return da.from_delayed(restored, shape, raster.out_dtype)

    planes = range(raster.bands)
    return da.block([[[block(p, row, column) for column in plan.columns] for row in plan.rows] for p in planes])


def restore_tile(task: Task, window: np.ndarray, top: int, left: int, row: Span, column: Span) -> np.ndarray:
    """The kept pixels (1, h, w) of one tile, from a window (1, ., .) whose first pixel is at (top, left).

    Raises:
        ImageError: values outside 0 to full scale, or a full scale left open.
    """
    restorer = task.restorer(window)
    here = Span(*(side - left for side in (column.start, column.stop, column.keep_start, column.keep_stop)))
    pixels, _ = restorer.kept(restorer.band(top, window), 0, row, here)
    return pixels[None]


def _around(span: Span, raster: Raster, plan: Plan) -> slice:
    """What a tile reads along one side: its window, and what missing pixels may be filled from."""
    margin = plan.radius_px if raster.may_miss else 0
    return slice(max(span.start - margin, 0), span.stop + margin)


@lru_cache(maxsize=NETWORKS_KEPT)
def _kept(network: Packed) -> Infer:
    return open_packed(network)[0]
