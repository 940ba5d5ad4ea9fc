"""Restore a lazy array of Dask tile by tile, on this machine or on the workers of a cluster.

A tile is two tasks. One runs the network on its window. The other stores its pixels, once the
network has run on the tiles that the consistency step reaches.
"""

from functools import partial
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np

from beers_deploy.model.raster.facts import Raster
from beers_deploy.restoration.bands import in_order, require_alike
from beers_deploy.restoration.plan import Plan, Span, plan_for
from beers_deploy.restoration.prepare import NetworkPipeline
from beers_deploy.restoration.radiometry import Reading, full_scale_of
from beers_deploy.restoration.steps import consistency_steps, exposed_networks
from beers_deploy.restoration.tiles.engine import NAME, Restorer, Strip, checked_strip


def restore_lazily(bands: Any, raster: Raster, pipeline: NetworkPipeline, reading: Reading) -> Any:
    """Return a lazy (bands, H, W) array of Dask.

    Errors in options and model are raised at once, those in pixels when the array is computed. A
    tile is finished from its own pixels and those that the network returned for the tiles around
    it.
    """
    da: Any = import_module("dask.array")
    delayed: Any = import_module("dask").delayed
    networks = in_order(pipeline.networks, raster)
    require_alike(networks)
    plan = plan_for(networks[0], raster.shape, pipeline.tiles)
    # The type alone decides the scale at once. Pixels may lead to a refusal later, but not to
    # another scale.
    full_scale = full_scale_of(NAME, raster, (), reading.full_scale, reading.sensor_bits).value
    around = pipeline.around
    packed = pipeline.engine.packed
    exposed = exposed_networks(networks, around, plan.tiling, full_scale, packed)
    steps, _ = consistency_steps(around, reading.sensors, raster, plan.tiling, full_scale)
    # A window holds one band only, so its tasks have the network and the step of that band. They
    # hold networks, not their paths: a worker on another machine has no such files.
    restorers = [
        Restorer(
            raster,
            exposed[band : band + 1],
            full_scale,
            plan.tiling,
            consistency=steps if len(networks) < 2 else steps[band : band + 1],
        )
        for band in range(len(networks))
    ]
    reach_px = restorers[0].reach_px
    margin_px = restorers[0].margin_px
    shared = [delayed(restorer) for restorer in restorers]
    tile = delayed(partial(restore_tile, reading))
    finish = delayed(partial(finish_tile, reading))
    groups = range(plan.groups)
    windows = {
        place: _read(bands, plan, margin_px, *place)
        for place in product(groups, plan.rows, plan.columns)
    }
    restored = {
        place: tile(shared[place[0] % len(shared)], *windows[place], *place[1:])
        for place in windows
    }

    def block(group: int, row: Span, column: Span) -> Any:
        down = [tile for tile in plan.rows if _near(tile, row, reach_px)]
        across = [tile for tile in plan.columns if _near(tile, column, reach_px)]
        around = [[restored[group, down_tile, tile] for tile in across] for down_tile in down]
        at = down[0].keep_start, across[0].keep_start
        window = windows[group, row, column]
        finished = finish(shared[group % len(shared)], *window, around, at, row, column)
        sides = ((span.keep_stop - span.keep_start) * plan.scale for span in (row, column))
        return da.from_delayed(finished, (plan.tiling.channels_out, *sides), raster.out_dtype)

    return da.block(
        [[[block(g, row, column) for column in plan.columns] for row in plan.rows] for g in groups]
    )


def _near(other: Span, span: Span, reach_px: int) -> bool:
    """Return True if the retained parts of two tiles lie within `reach_px` of each other, along one
    side.
    """
    return (
        other.keep_stop > span.keep_start - reach_px
        and other.keep_start < span.keep_stop + reach_px
    )


def _read(
    bands: Any, plan: Plan, margin_px: int, group: int, row: Span, column: Span
) -> tuple[Any, int, int]:
    """Return the input of a tile: a lazy window (bands, h, w), and the row and column of its first
    pixel.
    """
    rows, columns = (
        slice(max(span.start - margin_px, 0), span.stop + margin_px) for span in (row, column)
    )
    count = plan.tiling.channels_in
    pixels = bands[group * count : (group + 1) * count, rows, columns]
    # Both tasks of the tile share this one, so that chunks are read once.
    return import_module("dask").delayed(pixels), rows.start, columns.start


def restore_tile(
    reading: Reading,
    restorer: Restorer,
    window: np.ndarray,
    top: int,
    left: int,
    row: Span,
    column: Span,
) -> np.ndarray:
    """Run the network on one tile. Return its retained pixels (bands, h, w) float32, given a window
    that begins at (top, left).
    """
    return restorer.tile(_strip(reading, restorer, window, top, left), 0, row, column).pixels


def finish_tile(
    reading: Reading,
    restorer: Restorer,
    window: np.ndarray,
    top: int,
    left: int,
    around: list[list[np.ndarray]],
    at: tuple[int, int],
    row: Span,
    column: Span,
) -> np.ndarray:
    """Store the retained pixels (bands, h, w) of one tile.

    Args:
        reading: how its pixels are interpreted.
        restorer: of its band.
        window: raw pixels, as of `restore_tile`.
        top: row of its first pixel.
        left: its column.
        around: the results of `restore_tile` for the tiles within reach, in rows.
        at: row and column of the first pixel of these.
        row: rows of the tile.
        column: its columns.
    """
    strip = _strip(reading, restorer, window, top, left)
    return restorer.finish(strip, np.block(around), at, 0, row, column).pixels


def _strip(reading: Reading, restorer: Restorer, window: np.ndarray, top: int, left: int) -> Strip:
    """Return a window as a strip. Raise an error for pixels that contradict the full scale."""
    raster = restorer.raster
    # A dark tile may look like radiances; one tile alone does not prove that the image is.
    extent = raster.extent(window)._replace(whole=True)
    full_scale_of(NAME, raster, [extent], reading.full_scale, reading.sensor_bits)
    return checked_strip(raster, top, window, restorer.full_scale, NAME, left=left)
