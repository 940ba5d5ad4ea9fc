"""What a halo below the receptive radius costs, measured on one tile of the image."""

import numpy as np

from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from deploy.swath.restorer import Restorer
from deploy.tiling import Span


def seam_error_dn(source: Source, plan: Plan, restorer: Restorer) -> tuple[float, float]:
    """Largest and mean difference of a tile in the middle from the exact result, in digital numbers.

    The same kept pixels are restored twice: from the tile's own window, and from one with the whole radius around.
    """
    rows, columns = plan.rows[len(plan.rows) // 2], plan.columns[len(plan.columns) // 2]
    wide = [_widened(rows, plan.radius_px, plan.height_px), _widened(columns, plan.radius_px, plan.width_px)]
    start, stop = min(rows.start, wide[0].start), max(rows.stop, wide[0].stop)
    band = restorer.read(source, start, stop)
    cheap, _ = restorer.kept(band, 0, rows, columns)
    exact, _ = restorer.kept(band, 0, *wide)
    error = np.abs(np.nan_to_num(cheap.astype(np.float64)) - np.nan_to_num(exact.astype(np.float64)))
    return float(error.max()), float(error.mean())


def _widened(span: Span, radius_px: int, size_px: int) -> Span:
    """The same kept pixels with the whole radius around them, as far as the image goes."""
    start, stop = max(span.keep_start - radius_px, 0), min(span.keep_stop + radius_px, size_px)
    return Span(start, stop, span.keep_start, span.keep_stop)
