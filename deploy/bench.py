"""The rows of the bench: a network on the DPU (predicted), the traditional pipeline here (measured), the paper's.

Pixels a second count the image's own pixels, never a tile's halo.
"""

import math
from dataclasses import dataclass
from pathlib import Path

from deploy.dpu.board import Dpu
from deploy.dpu.cost import Prediction, predict
from deploy.dpu.frames import paper_frames, whole_tiles
from deploy.dpu.placement import place
from deploy.dpu.power import dpu_power
from deploy.dpu.reading import read_network
from deploy.results import Figure, Row, predicted, published

TABLE = "bench"
COST_SOURCE = "structural cost model fitted on 10 published networks, see deploy/dpu/cost.py"
PAPER = "ConvBEERS paper, table of the VCK190 benchmark, 13600 x 9016"
PAPER_TILE_PX = 640


@dataclass(frozen=True)
class Swath:
    """The image that all rows are about, and the tiles it is cut into."""

    width_px: int
    height_px: int
    tile_px: int = PAPER_TILE_PX
    halo_px: int = 0

    @property
    def pixels(self) -> int:
        """Pixels of the image."""
        return self.width_px * self.height_px

    @property
    def frames(self) -> float:
        """Tiles as the paper counts: a fraction, without halo."""
        return paper_frames(self.width_px, self.height_px, self.tile_px)

    @property
    def tiles(self) -> int:
        """Whole tiles of the grid."""
        return whole_tiles(self.width_px, self.height_px, self.tile_px, self.halo_px)


def predict_file(model: Path, dpu: Dpu, tile_px: int = PAPER_TILE_PX) -> Prediction:
    """What the cost model says of an ONNX file.

    Raises:
        ModelError: not a network, or one that does not run whole on the DPU.
    """
    return predict(place(read_network(model, tile_px), dpu), dpu)


def predicted_rows(name: str, prediction: Prediction, swath: Swath, dpu: Dpu) -> list[Row]:
    """A network on the DPU, twice: as the paper counts, and with whole tiles."""
    batches = math.ceil(swath.tiles / prediction.batch)
    counts = {
        "as the paper counts": (swath.frames, swath.frames / prediction.batch),
        f"whole tiles, halo {swath.halo_px} px": (float(swath.tiles), float(batches)),
    }
    return [
        _predicted_row(f"{name}, INT8 on the DPU ({prediction.configuration}), {how}", prediction, swath, dpu, *count)
        for how, count in counts.items()
    ]


def _predicted_row(name: str, prediction: Prediction, swath: Swath, dpu: Dpu, frames: float, batches: float) -> Row:
    power = dpu_power(dpu)
    slow_s, fast_s = (batches * prediction.batch / fps for fps in prediction.fps_interval)
    latency = predicted(batches * prediction.batch_time_s, "s", (fast_s, slow_s), COST_SOURCE)
    count = "arithmetic of the tile grid"
    figures = {
        "tiles": predicted(frames, "tile", (frames, frames), count),
        "latency": latency,
        "throughput": predicted(prediction.fps, "frame/s", prediction.fps_interval, COST_SOURCE),
        "power": power,
        "efficiency": efficiency(swath.pixels, latency, power),
    }
    return Row(TABLE, name, figures)


def efficiency(pixels: int, latency: Figure, power: Figure) -> Figure:
    """Pixels a second and watt; its interval pairs the slowest run with the highest power and the reverse."""
    unit = "px/s/W"
    if power.value is None or latency.value is None:
        return Figure(None, unit, "unavailable", reason=power.reason or latency.reason)
    value = pixels / latency.value / power.value
    if "predicted" not in (latency.mode, power.mode):
        return Figure(value, unit, latency.mode, f"{latency.source}; {power.source}")
    times, watts = (f.interval or (f.value or 0.0, f.value or 0.0) for f in (latency, power))
    interval = (pixels / times[1] / watts[1], pixels / times[0] / watts[0])
    return predicted(value, unit, interval, f"{latency.source}; {power.source}")


def published_rows() -> list[Row]:
    """The paper's two runs on the VCK190, as printed; its DPU configuration is not named."""
    runs = {
        "paper, 13600 x 9016: traditional on the VCK190's CPU": (1724, 0.2, 22.5, 3161),
        "paper, 13600 x 9016: ConvBEERS, INT8 on the DPU": (42, 7.2, 29.6, 98965),
    }
    units = {"latency": "s", "throughput": "frame/s", "power": "W", "efficiency": "px/s/W"}
    return [
        Row(TABLE, name, {k: published(v, units[k], PAPER) for k, v in zip(units, values, strict=True)})
        for name, values in runs.items()
    ]


def layer_rows(prediction: Prediction) -> list[Row]:
    """One row a layer and one for the overhead; their times add up to that of a batch, the last row."""
    rows = [
        Row(
            "layers",
            layer.name,
            {
                "work": _exact(layer.operations / 1e9, "GOP"),
                "time": _scaled(layer.time_s, prediction),
                "LdFM": _exact(layer.load_map_bytes / 1e6, "MB"),
                "LdWB": _exact(layer.load_weight_bytes / 1e6, "MB"),
                "StFM": _exact(layer.store_map_bytes / 1e6, "MB"),
                "array use": _exact(100 * layer.array_use, "%"),
            },
        )
        for layer in prediction.layers
    ]
    rows.append(Row("layers", "start of a batch", {"time": _scaled(prediction.overhead_s, prediction)}))
    total = f"sum: one batch of {prediction.batch}"
    return [*rows, Row("layers", total, {"time": _scaled(prediction.batch_time_s, prediction)})]


def _exact(value: float, unit: str) -> Figure:
    return predicted(value, unit, (value, value), "arithmetic of the graph's shapes, one image")


def _scaled(time_s: float, prediction: Prediction) -> Figure:
    """A share of the batch time, with the relative error of the whole."""
    slow, fast = (prediction.fps / fps for fps in prediction.fps_interval)
    return predicted(1e3 * time_s, "ms/batch", (1e3 * time_s * fast, 1e3 * time_s * slow), COST_SOURCE)
