"""Figures of a restoration: how the image is cut, and the error of seams if there are any."""

from dataclasses import replace

import numpy as np

from beers_deploy.model.raster.source import Source
from beers_deploy.profiles.figures import Figure, measured, predicted, unavailable
from beers_deploy.restoration.plan import Plan, Span, TilePlace
from beers_deploy.restoration.tiles.engine import Restorer


def plan_figures(plan: Plan) -> dict[str, Figure]:
    """Return the figures of how an image is cut. They are known in advance, not measured."""
    numbers = {"tiles": plan.tiles, "work factor": plan.work_factor}
    source = "arithmetic on the plan of tiles"
    return {
        key: predicted(number, "1", (number, number), source) for key, number in numbers.items()
    }


def seam_figures(source: Source, plan: Plan, restorer: Restorer) -> dict[str, Figure]:
    """Measure the error of seams on a tile in the middle, in digital numbers, if the halo leaves
    seams.

    The same retained pixels are restored twice: from the tile's own window, and from one with the
    whole radius around it.
    """
    keys = "seam error max", "seam error mean"
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if plan.tiling.fixed_px is not None:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return dict.fromkeys(keys, unavailable("DN", reason))
    rows = plan.rows[len(plan.rows) // 2]
    columns = plan.columns[len(plan.columns) // 2]
    ends_px = plan.rows[-1].stop, plan.columns[-1].stop
    wide = [
        _widened(span, plan.radius_px, end_px)
        for span, end_px in zip((rows, columns), ends_px, strict=True)
    ]
    # A last tile that was moved inward may begin before the wider window.
    top = min(rows.start, wide[0].start)
    strip = restorer.read(source, replace(rows, start=top, stop=max(rows.stop, wide[0].stop)))
    cheap, exact = (
        restorer.tile(strip, TilePlace(0, *spans)).pixels.astype(np.float64)
        for spans in ((rows, columns), wide)
    )
    error = np.abs(np.nan_to_num(cheap) - np.nan_to_num(exact))
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {
        key: measured(float(value), "DN", how)
        for key, value in zip(keys, (error.max(), error.mean()), strict=True)
    }


def _widened(span: Span, radius_px: int, size_px: int) -> Span:
    """Return a span of the same retained pixels with the whole radius around them, as far as the
    image and its extension reach.

    The retained part ends on the network's lattice or with the image. In the second case the span
    that is read ends with the extension.
    """
    start = max(span.keep_start - radius_px, 0)
    stop = min(span.keep_stop + radius_px, size_px)
    stop = size_px if span.stop == size_px else stop
    return Span(start, stop, span.keep_start, span.keep_stop)
