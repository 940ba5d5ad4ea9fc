"""Restore a lazy array of Dask tile by tile, on this machine or on the workers of a cluster.

A tile is two tasks. One runs the network on its window. The other stores its pixels, once the
network has run on the tiles that the consistency step reaches.
"""

from importlib import import_module
from itertools import chain
from typing import Any

import numpy as np

from beers_deploy.model.raster.facts import Raster
from beers_deploy.restoration.bands import in_order, require_alike
from beers_deploy.restoration.plan import Span, TilePlace, plan_for
from beers_deploy.restoration.prepare import NetworkPipeline
from beers_deploy.restoration.radiometry import Reading, full_scale_of
from beers_deploy.restoration.steps import consistency_steps, exposed_networks
from beers_deploy.restoration.tiles.engine import NAME, Restorer, Strip, checked_strip


def restore_lazily(bands: Any, raster: Raster, pipeline: NetworkPipeline, reading: Reading) -> Any:
    """Return the restored image as a lazy array of Dask, (bands, H, W), one chunk for each tile.

    A chunk is computed from the pixels of its tile and those that the network returned for the
    tiles around it. Errors in options and model are raised at once, those in pixels when the array
    is computed.

    Args:
        bands: the raw image, a Dask array (bands, H, W).
        raster: the description of the image.
        pipeline: the networks, and how they are run.
        reading: how the pixels of the image are interpreted.

    Raises:
        OptionError: an option does not fit the image or the network.
        ModelError: the networks cannot restore the image.
        ImageError: the type of the pixels does not tell their full scale.
    """
    da: Any = import_module("dask.array")
    delayed: Any = import_module("dask").delayed
    networks = in_order(pipeline.networks, raster)
    require_alike(networks)
    plan = plan_for(networks[0], raster.shape, pipeline.tiles)
    # The type alone decides the scale at once. Pixels may lead to a refusal later, but not to
    # another scale.
    full_scale = full_scale_of(NAME, raster, (), reading).value
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
            plan,
            consistency=steps if len(networks) < 2 else steps[band : band + 1],
        )
        for band in range(len(networks))
    ]
    margin_px = restorers[0].margin_px
    reach_px = restorers[0].reach_px
    shared = [delayed(restorer) for restorer in restorers]
    of_group = [shared[group % len(shared)] for group in range(plan.groups)]
    count = plan.tiling.channels_in
    strips = {}
    restored = {}
    for place in chain.from_iterable(map(plan.places, plan.rows)):
        rows, columns = (
            slice(max(span.start - margin_px, 0), span.stop + margin_px) for span in place[1:]
        )
        pixels = bands[place.group * count : (place.group + 1) * count, rows, columns]
        restorer = of_group[place.group]
        # Both tasks of a tile share its strip.
        strip = delayed(_strip)(reading, restorer, pixels, rows.start, columns.start)
        strips[place] = strip
        restored[place] = delayed(_tile)(restorer, strip, place)

    def chunk(place: TilePlace) -> Any:
        """Return the finished pixels of a tile as a lazy array."""
        group, row, column = place
        near_rows = [span for span in plan.rows if _near(span, row, reach_px)]
        near_columns = [span for span in plan.columns if _near(span, column, reach_px)]
        near = [
            [restored[TilePlace(group, near_row, span)] for span in near_columns]
            for near_row in near_rows
        ]
        at = near_rows[0].keep_start, near_columns[0].keep_start
        finished = delayed(_finish)(of_group[group], strips[place], near, at, place)
        sides = ((span.keep_stop - span.keep_start) * plan.scale for span in (row, column))
        return da.from_delayed(finished, (plan.tiling.channels_out, *sides), raster.out_dtype)

    return da.block(
        [
            [[chunk(TilePlace(g, row, column)) for column in plan.columns] for row in plan.rows]
            for g in range(plan.groups)
        ]
    )


def _near(other: Span, span: Span, reach_px: int) -> bool:
    """Return True if the retained parts of two tiles lie within `reach_px` of each other, along one
    side.
    """
    return (
        other.keep_stop > span.keep_start - reach_px
        and other.keep_start < span.keep_stop + reach_px
    )


def _tile(restorer: Restorer, strip: Strip, place: TilePlace) -> np.ndarray:
    """Return the retained pixels (bands, h, w) float32 of a tile as the network returned them."""
    # The strip and the restorer are those of this group of bands alone.
    return restorer.tile(strip, place._replace(group=0)).pixels


def _finish(
    restorer: Restorer,
    strip: Strip,
    around: list[list[np.ndarray]],
    at: tuple[int, int],
    place: TilePlace,
) -> np.ndarray:
    """Store the retained pixels (bands, h, w) of one tile.

    Args:
        restorer: the restorer of the tile's bands.
        strip: the raw pixels of the tile.
        around: the results of `_tile` for the tile and those within reach, row by row.
        at: the row and column of the image at which `around` begins.
        place: the group of bands, rows and columns of the tile.
    """
    return restorer.finish(strip, np.block(around), at, place._replace(group=0)).pixels


def _strip(reading: Reading, restorer: Restorer, window: np.ndarray, top: int, left: int) -> Strip:
    """Return a window as a strip. Raise an error for pixels that contradict the full scale."""
    raster = restorer.raster
    # A dark tile may look like radiances; one tile alone does not prove that the image is.
    extent = raster.extent(window)._replace(whole=True)
    full_scale_of(NAME, raster, [extent], reading)
    return checked_strip(raster, top, window, restorer.full_scale, NAME, left=left)
