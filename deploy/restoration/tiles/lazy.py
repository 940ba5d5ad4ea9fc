"""A lazy array of Dask restored tile by tile, on this machine or on the workers of a cluster.

A tile is two tasks: the network on its window, and what stores its pixels, once the network has run
on the tiles that the consistency step reaches.
"""

from dataclasses import dataclass
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import onnx

from beers_deploy.model.consistency import RAW_REACH_PX, REACH_PX
from beers_deploy.model.raster.facts import Raster
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.bands import in_order, require_alike
from beers_deploy.restoration.plan import Plan, Span, plan_for
from beers_deploy.restoration.prepare import NetworkPipeline
from beers_deploy.restoration.radiometry import full_scale_of
from beers_deploy.restoration.reading import Reading
from beers_deploy.restoration.runtime import Packed
from beers_deploy.restoration.steps import consistency_steps, exposed_networks
from beers_deploy.restoration.tiles.engine import NAME, Restorer, checked_strip
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import Steps


@dataclass(frozen=True)
class Task:
    """What all tiles of a lazy array, or of one band of it, share: Dask's workers get it.

    It holds networks, not their paths: a worker on another machine has no such files.

    Attributes:
        raster: the image's facts.
        networks: the network at its exposures.
        asked: the full scale that the user states; None leaves it to `bits` and each tile's pixels.
        bits: of the sensor, where the user names its profile.
        tiling: how the network meets an image.
        consistency: the consistency step; empty where it is left out.
    """

    raster: Raster
    networks: tuple[ExposedNetwork, ...]
    asked: float | None
    bits: int | None
    tiling: Tiling
    consistency: Steps

    def restorer(self, window: np.ndarray) -> Restorer:
        """What restores the tiles of a window of pixels (bands, h, w)."""
        # A dark tile may look like radiances; one tile alone does not prove that the image is.
        extent = self.raster.extent(window)._replace(whole=True)
        full_scale = full_scale_of(NAME, self.raster, [extent], self.asked, self.bits).value
        return Restorer(
            self.raster, self.networks, full_scale, self.tiling, NAME, consistency=self.consistency
        )


def restore_lazily(bands: Any, raster: Raster, pipeline: NetworkPipeline, reading: Reading) -> Any:
    """Return a lazy (bands, H, W) array of Dask.

    Errors in options and model come at once, those in pixels when it is computed. A tile is
    finished from its own pixels and those that the network returned for the tiles around it.
    """
    da: Any = import_module("dask.array")
    delayed: Any = import_module("dask").delayed
    networks = in_order(pipeline.networks, raster)
    require_alike(networks)
    plan = plan_for(networks[0], raster.shape, pipeline.tiles)
    # The type alone decides the scale at once. Pixels may lead to a refusal later, but not to
    # another scale.
    full_scale = full_scale_of(NAME, raster, (), reading.full_scale, reading.sensor_bits).value
    engine = pipeline.engine

    def packed(model: onnx.ModelProto, at_first_call: bool) -> Packed:  # noqa: ARG001
        return Packed(model.SerializeToString(), engine.runtime, engine.threads or 1)

    around = pipeline.around
    exposed = exposed_networks(networks, around, plan.tiling, full_scale, packed)
    steps, _ = consistency_steps(around, reading.sensors, raster, plan.tiling, full_scale)
    # A window holds one band only, so a task has the network and the step of that band.
    tasks = [
        delayed(
            Task(
                raster,
                exposed[band : band + 1],
                reading.full_scale,
                reading.sensor_bits,
                plan.tiling,
                steps if len(networks) < 2 else steps[band : band + 1],
            )
        )
        for band in range(len(networks))
    ]
    reach_px = REACH_PX if steps else 0
    tile = delayed(restore_tile)
    finish = delayed(finish_tile)
    groups = range(plan.groups)
    margin_px = max(raster.fill_margin_px(plan.radius_px), RAW_REACH_PX if steps else 0)
    windows = {
        place: _read(bands, plan, margin_px, *place)
        for place in product(groups, plan.rows, plan.columns)
    }
    restored = {
        place: tile(tasks[place[0] % len(tasks)], *windows[place], *place[1:]) for place in windows
    }

    def block(group: int, row: Span, column: Span) -> Any:
        down = [tile for tile in plan.rows if _near(tile, row, reach_px)]
        across = [tile for tile in plan.columns if _near(tile, column, reach_px)]
        around = [[restored[group, down_tile, tile] for tile in across] for down_tile in down]
        at = down[0].keep_start, across[0].keep_start
        window = windows[group, row, column]
        finished = finish(tasks[group % len(tasks)], *window, around, at, row, column)
        sides = ((span.keep_stop - span.keep_start) * plan.scale for span in (row, column))
        return da.from_delayed(finished, (plan.tiling.channels_out, *sides), raster.out_dtype)

    return da.block(
        [[[block(g, row, column) for column in plan.columns] for row in plan.rows] for g in groups]
    )


def _near(other: Span, span: Span, reach_px: int) -> bool:
    """Whether what is kept of one tile lies within reach of what is kept of another, along one
    side.
    """
    return (
        other.keep_stop > span.keep_start - reach_px
        and other.keep_start < span.keep_stop + reach_px
    )


def _read(
    bands: Any, plan: Plan, margin_px: int, group: int, row: Span, column: Span
) -> tuple[Any, int, int]:
    """What a tile reads: a lazy window (bands, h, w), and the row and column of its first pixel."""
    rows, columns = (
        slice(max(span.start - margin_px, 0), span.stop + margin_px) for span in (row, column)
    )
    count = plan.tiling.channels_in
    pixels = bands[group * count : (group + 1) * count, rows, columns]
    # Both tasks of the tile share this one, so that chunks are read once.
    return import_module("dask").delayed(_itself)(pixels), rows.start, columns.start


def _itself(pixels: np.ndarray) -> np.ndarray:
    return pixels


def restore_tile(
    task: Task, window: np.ndarray, top: int, left: int, row: Span, column: Span
) -> np.ndarray:
    """Run the network on one tile: the kept pixels (bands, h, w) float32, of a window that begins
    at (top, left).
    """
    restorer = task.restorer(window)
    strip = checked_strip(task.raster, top, window, restorer.full_scale, NAME, left=left)
    return restorer.tile(strip, 0, row, column).pixels


def finish_tile(
    task: Task,
    window: np.ndarray,
    top: int,
    left: int,
    around: list[list[np.ndarray]],
    at: tuple[int, int],
    row: Span,
    column: Span,
) -> np.ndarray:
    """Store the kept pixels (bands, h, w) of one tile.

    Args:
        task: what all tiles share.
        window: raw pixels, as of `restore_tile`.
        top: row of its first pixel.
        left: its column.
        around: what `restore_tile` gave of the tiles within reach, in rows.
        at: row and column of the first pixel of these.
        row: rows of the tile.
        column: its columns.
    """
    restorer = task.restorer(window)
    strip = checked_strip(task.raster, top, window, restorer.full_scale, NAME, left=left)
    return restorer.finish(strip, np.block(around), at, 0, row, column).pixels
