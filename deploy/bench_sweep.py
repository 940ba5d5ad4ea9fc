"""One network on several configurations of the DPU, in tiles of several sizes."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from deploy.bench import ARITHMETIC, COST_SOURCE, Swath, exact, fitted_range, predict_file, swath_latency
from deploy.dpu.board import Dpu
from deploy.dpu.cost import Prediction
from deploy.results import Row, predicted
from profiles.errors import OptionError

MOST_TILE_PX = 8192
"""One layer's result of 64 channels has 17 GB there; no board has a tenth of it."""


def sweep_rows(model: Path, swath: Swath, boards: Sequence[Dpu], tiles_px: Sequence[int]) -> list[Row]:
    """A row a configuration and tile size, for whole tiles with the swath's halo."""
    return [
        _row(predict_file(model, dpu, tile_px), replace(swath, tile_px=tile_px))
        for dpu in boards
        for tile_px in tiles_px
    ]


def _row(prediction: Prediction, swath: Swath) -> Row:
    figures = {
        "tiles": exact(swath.tiles, "tile", ARITHMETIC),
        "work factor": exact(swath.work_factor(swath.tiles), "px/px", ARITHMETIC),
        "latency": swath_latency(prediction, math.ceil(swath.tiles / prediction.batch)),
        "throughput": predicted(prediction.fps, "frame/s", prediction.fps_interval, COST_SOURCE),
        "maps through memory": exact(prediction.streamed_bytes / 1e6, "MB/tile"),
        "layers on chip": exact(on_chip(prediction), "%"),
    }
    bound = Counter[str]()
    for layer in prediction.layers:
        bound[layer.bound] += round(1e12 * layer.time_s)
    words = {"bound": bound.most_common(1)[0][0], "fitted range": fitted_range(prediction)}
    return Row("sweep", f"{prediction.configuration}, tiles of {swath.tile_px}", figures, words)


def on_chip(prediction: Prediction) -> float:
    """Share of layers that neither read nor write maps in memory, in percent."""
    kept = [not (layer.work.load_map_bytes or layer.work.store_map_bytes) for layer in prediction.layers]
    return 100 * sum(kept) / len(kept)


def parse_tiles(text: str) -> list[int]:
    """Tile sides in pixels, with commas between them.

    Raises:
        OptionError: another text, or a side below 16 or above MOST_TILE_PX.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and len(part) < 6 and 16 <= int(part) <= MOST_TILE_PX for part in parts):
        remedy = "write one size, or several as 640,256,128"
        raise OptionError(
            "--tile", expected=f"tile sides of 16 to {MOST_TILE_PX} pixels", got=repr(text), remedy=remedy
        )
    return [int(part) for part in parts]
