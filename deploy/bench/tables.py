"""What the bench shows and need not measure.

A network on the DPU and the traditional pipeline on the board's own processor, both predicted, and the paper's
figures.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.latency import (
    LayerCost,
    Prediction,
    counted_power,
    dpu_power,
    energy_source,
    layer_energy_j,
    predict,
)
from beers_deploy.dpu.cost.model import Interval, Task, between
from beers_deploy.dpu.reading import read_network
from beers_deploy.profiles import TargetProfile
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, Row, number, predicted, published, unavailable
from beers_deploy.profiles.target import TILE_PX
from beers_deploy.restoration.plan import plan_side
from beers_deploy.restoration.source import SIDE_PX

TABLE, LAYERS = "bench", "layers"
CHAIN = "chain_s_per_mpx"
"""In a target's [cpu]: time of the traditional pipeline for 10^6 pixels on all cores."""
COST_SOURCE = "cost model fitted on published networks, docs/explanation/cost-model.md"
HELD = 0.9
"""Share of families left out of the fit that an interval is meant to hold."""
ARITHMETIC = "arithmetic of the tile grid"
PAPER = "ConvBEERS paper, table of the VCK190 benchmark, 13600 x 9016"
PAPER_SIZE = "13600x9016"
PAPER_TARGET = "vck190"
"""The board that the paper measured: its rows stand beside that one alone."""


@dataclass(frozen=True)
class Swath:
    """The image that all rows are about, and the tiles it is cut into.

    Attributes:
        width_px: of the image.
        height_px: of the image.
        tile_px: side of a tile.
        halo_px: context around what is kept of a tile.
        runs: how often the network runs on a tile, once for each exposure that its pixels ask for; a mean.
        consistency: whether the host takes the consistency step.
    """

    width_px: int
    height_px: int
    tile_px: int = TILE_PX
    halo_px: int = 0
    runs: float = 1.0
    consistency: bool = False

    @property
    def pixels(self) -> int:
        """Pixels of the image."""
        return self.width_px * self.height_px

    @property
    def frames(self) -> float:
        """Tiles as the paper counts: pixels of the image over pixels of a tile, a fraction, without halo.

        13600 x 9016 at 640 is 299.4; at the published 7.2 frames a second that is the published 42 s.
        """
        return self.pixels / self.tile_px**2

    @property
    def tiles(self) -> int:
        """Whole tiles of the grid, the last row and column moved inward: 384 of the paper's swath, halo 35."""
        rows, columns = (plan_side(side, self.tile_px, self.halo_px) for side in (self.height_px, self.width_px))
        return len(rows) * len(columns)

    @property
    def step_px(self) -> float:
        """Pixels of the image for which the host takes the consistency step, for each run of the network."""
        return self.pixels / (self.tiles * self.runs) if self.consistency else 0.0


def predict_file(
    model: Path, dpu: Dpu, tile_px: int | None = TILE_PX, task: Task | None = None, step_px: float = 0.0
) -> Prediction:
    """What the cost model says of an ONNX file, for tiles of that side or, with None, for the size it is fixed to.

    The `task` of the host is what the file tells, if none is given; `step_px` as of `predict`.
    """
    return predict(place(read_network(model, tile_px), dpu), dpu, task, step_px)


def predicted_rows(name: str, prediction: Prediction, swath: Swath) -> list[Row]:
    """A network on the DPU, twice: as the paper counts, and with whole tiles."""
    batches = math.ceil(swath.tiles * swath.runs / prediction.batch)
    counts = {
        "as the paper counts": (swath.frames, swath.frames * swath.runs / prediction.batch),
        f"whole tiles, halo {swath.halo_px} px": (float(swath.tiles), float(batches)),
    }
    besides = {
        "one-thread latency": one_thread_latency(prediction),
        "host beside the DPU": host_time(prediction, "ms/tile"),
        "power of products and traffic": counted_power(prediction),
    }
    words, name = {"fitted range": fitted_range(prediction)}, f"{name}, INT8 on the DPU ({prediction.dpu.name})"
    return [
        Row(TABLE, f"{name}, {how}", _swath_figures(prediction, swath, *count) | besides, words)
        for how, count in counts.items()
    ]


def _swath_figures(prediction: Prediction, swath: Swath, frames: float, batches: float) -> dict[str, Figure]:
    power, latency = dpu_power(prediction.dpu), swath_latency(prediction, batches)
    step = {"consistency step": step_time(prediction, swath)} if swath.consistency else {}
    return {
        "tiles": exact(frames, "tile", ARITHMETIC),
        "network runs": exact(swath.runs, "run/tile", "exposures that the image's tiles ask for; 1 without an image"),
        "work factor": exact(frames * swath.tile_px**2 / swath.pixels, "px/px", ARITHMETIC),
        "latency": latency,
        "throughput": predicted(prediction.fps, "frame/s", prediction.fps_interval, COST_SOURCE),
        "power": power,
        "energy": energy(latency, power),
        "efficiency": efficiency(swath.pixels, latency, power),
        **step,
    }


def step_time(prediction: Prediction, swath: Swath) -> Figure:
    """Time of the consistency step for the swath on the host's cores, in s; it runs while the DPU works."""
    runs = swath.tiles * swath.runs
    low_s, high_s = (end_s * runs for end_s in prediction.step_s)
    source = "counted work of the step at the rates of the board's processor, from the best published to plain code"
    return predicted(between((low_s, high_s)), "s", (low_s, high_s), source)


def host_time(prediction: Prediction, unit: str) -> Figure:
    """What the host's cores together take for an image, in ms."""
    low_s, high_s = prediction.host_interval_s
    return predicted(1e3 * prediction.host_s, unit, (1e3 * low_s, 1e3 * high_s), COST_SOURCE)


def one_thread_latency(prediction: Prediction) -> Figure:
    """From image to result where one thread runs one core's batch and does the host's work itself, in ms."""
    low_s, high_s = prediction.latency_interval_s
    handlers = prediction.dpu.handlers
    images = f"a batch of {handlers}" if handlers > 1 else "one image"
    source = f"{COST_SOURCE}, its fit to rates with one thread: {images} through one core, then the host"
    return predicted(1e3 * prediction.latency_s, "ms/batch", (1e3 * low_s, 1e3 * high_s), source)


def swath_latency(prediction: Prediction, batches: float) -> Figure:
    """Time of so many batches, in seconds."""
    images = batches * prediction.batch
    slow_s, fast_s = (images / fps for fps in prediction.fps_interval)
    return predicted(images / prediction.fps, "s", (fast_s, slow_s), COST_SOURCE)


def fitted_range(prediction: Prediction) -> str:
    """Whether the fitted networks speak for this one, and how often the board's intervals held, if too rarely."""
    found = f"outside: {'; '.join(prediction.outside)}" if prediction.outside else "inside"
    share = prediction.dpu.value("cost", "families_held")
    return found if share >= HELD else f"{found}; intervals held {100 * share:.0f} % of families left out"


def energy(latency: Figure, power: Figure) -> Figure:
    """Energy of the swath, in J: time and power, and their ends."""
    if power.value is None or latency.value is None:
        return unavailable("J", power.reason or latency.reason)
    (fast_s, slow_s), (low_w, high_w) = _ends(latency), _ends(power)
    ends = fast_s * low_w, slow_s * high_w
    return predicted(latency.value * power.value, "J", ends, f"{latency.source}; {power.source}")


def efficiency(pixels: int, latency: Figure, power: Figure) -> Figure:
    """Pixels a second and watt; its interval pairs the slowest run with the highest power and the reverse."""
    unit = "px/s/W"
    if power.value is None or latency.value is None:
        return unavailable(unit, power.reason or latency.reason)
    value = pixels / latency.value / power.value
    if "predicted" not in (latency.mode, power.mode):
        return Figure(value, unit, latency.mode, f"{latency.source}; {power.source}")
    (fast_s, slow_s), (low_w, high_w) = _ends(latency), _ends(power)
    interval = (pixels / slow_s / high_w, pixels / fast_s / low_w)
    return predicted(value, unit, interval, f"{latency.source}; {power.source}")


def _ends(figure: Figure) -> Interval:
    """The interval, or the value twice where it has none."""
    return figure.interval or (figure.value or 0.0, figure.value or 0.0)


QUOTED = {"latency": "ms", "throughput": "fps"}
"""Of the tables [published_latency_ms] and [published_throughput_fps]: the figure's name and unit."""


def quoted_rows(network: str, target: TargetProfile) -> list[Row]:
    """A network on a board without a cost model, unavailable; and what the board's maker prints of other networks."""
    reason = f"too few rates of {target.name} are published to fit a cost model"
    own = {key: unavailable(unit, reason) for key, unit in QUOTED.items()}
    own["power"] = unavailable("W", f"no power of {target.name} is published")
    rows = [Row(TABLE, f"{network} on {target.name}", own)]
    for key, unit in QUOTED.items():
        for name, constant in target.tables.get(f"published_{key}_{unit}", {}).items():
            rows.append(Row(TABLE, f"quoted: {name}", {key: published(constant.low, unit, constant.source)}))
    return rows


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


def processor_row(swath: Swath, board: TargetProfile) -> Row:
    """The traditional pipeline on the board's own processor, from the time of 10^6 pixels that its file states."""
    cpu, mpx, watts = board.tables.get("cpu", {}), swath.pixels / 1e6, board.tables.get("power", {}).get("cpu_run_w")
    power = unavailable("W", "no power of a run on this board's processor is published")
    if watts is not None:
        power = published(watts.low, "W", watts.source)
    constant, cores = cpu.get(CHAIN), f", {cpu['cores']} cores" if "cores" in cpu else ""
    name = f"traditional pipeline on the processor of {board.name}{cores}"
    if constant is None:
        missing = f"the target states no [cpu] {CHAIN}"
        return Row(TABLE, name, {"latency": unavailable("s", missing), "power": power})
    low_s, high_s = mpx * constant.low, mpx * constant.high
    latency = predicted(between((low_s, high_s)), "s", (low_s, high_s), constant.source)
    figures = {
        "latency": latency,
        "throughput": chain_rate(swath, latency),
        "power": power,
        "efficiency": efficiency(swath.pixels, latency, power),
    }
    return Row(TABLE, name, figures)


def chain_rate(swath: Swath, latency: Figure) -> Figure:
    """Tiles a second, as the paper counts them, of a predicted latency of the swath."""
    low, high = (swath.frames / end_s for end_s in reversed(_ends(latency)))
    return predicted(swath.frames / (latency.value or math.inf), "frame/s", (low, high), latency.source)


def layer_rows(prediction: Prediction) -> list[Row]:
    """One row a layer; their times add up to that of a batch, the last row.

    The columns are those of AMD's vaitrace, with what bounds the layer; bytes and energy are those of one image.
    """
    rows = [_layer_row(layer, prediction) for layer in prediction.layers]
    total = f"sum: one batch of {prediction.batch}"
    return [*rows, Row(LAYERS, total, {"time": scaled(1e3 * prediction.batch_time_s, "ms/batch", prediction)})]


def _layer_row(layer: LayerCost, prediction: Prediction) -> Row:
    work, batch, dpu = layer.work, prediction.batch, prediction.dpu
    low_j, high_j = layer_energy_j(layer, dpu)
    moved = batch * work.map_bytes + work.weight_bytes
    seconds = layer.time_s or math.inf  # a concat takes no time of its own
    figures = {
        "work": exact(work.operations / 1e9, "GOP"),
        "time": scaled(1e3 * layer.time_s, "ms/batch", prediction),
        "rate": scaled(batch * work.operations / seconds / 1e9, "GOP/s", prediction),
        "LdFM": exact(work.load_map_bytes / 1e6, "MB", "feature maps that an image loads, by the graph's shapes"),
        "LdWB": exact(work.weight_bytes / 1e6, "MB", "weights and biases that a batch loads, by the graph's shapes"),
        "StFM": exact(work.store_map_bytes / 1e6, "MB", "feature maps that an image stores, by the graph's shapes"),
        "bandwidth": scaled(moved / seconds / 1e9, "GB/s", prediction),
        "array use": exact(100 * work.array_use, "%"),
        "energy": predicted(500 * (low_j + high_j), "mJ", (1e3 * low_j, 1e3 * high_j), energy_source(dpu)),
    }
    return Row(LAYERS, work.name, figures, {"bound": layer.bound})


def exact(value: float, unit: str, source: str = "arithmetic of the graph's shapes, one image") -> Figure:
    """A number that follows from shapes alone."""
    return predicted(value, unit, (value, value), source)


def scaled(value: float, unit: str, prediction: Prediction) -> Figure:
    """A part of the prediction, with the relative error of the whole."""
    return predicted(value, unit, (value / prediction.spread, value * prediction.spread), COST_SOURCE)


MOST_TILE_PX = 8192
"""One layer's result of 64 channels has 17 GB there; no board has a tenth of it."""


def sweep_rows(
    model: Path, swath: Swath, boards: Sequence[Dpu], tiles_px: Sequence[int], task: Task | None = None
) -> list[Row]:
    """A row a configuration and tile size, for whole tiles with the swath's halo."""
    rows = []
    for dpu, tile_px in product(boards, tiles_px):
        cut = replace(swath, tile_px=tile_px)
        rows.append(swath_row(predict_file(model, dpu, tile_px, task, cut.step_px), cut))
    return rows


def swath_row(prediction: Prediction, swath: Swath) -> Row:
    """A swath in whole tiles on one configuration."""
    batches = math.ceil(swath.tiles * swath.runs / prediction.batch)
    kept = [not layer.work.map_bytes for layer in prediction.layers]
    figures = _swath_figures(prediction, swath, swath.tiles, batches) | {
        "maps through memory": exact(prediction.streamed_bytes / 1e6, "MB/tile"),
        "layers on chip": exact(100 * sum(kept) / len(kept), "%"),
    }
    bound = Counter[str]()
    for layer in prediction.layers:
        bound[layer.bound] += round(1e12 * layer.time_s)
    words = {"bound": bound.most_common(1)[0][0], "fitted range": fitted_range(prediction)}
    return Row("sweep", f"{_named(prediction)}, tiles of {swath.tile_px}", figures, words)


def _named(prediction: Prediction) -> str:
    return f"{prediction.dpu.target.name} {prediction.dpu.name}"


def within_words(rows: Sequence[Row], boards: Sequence[Dpu], within_s: float) -> str:
    """Which DPU, the one of the lowest peak, meets a time for the swath: surely, probably, or only at best.

    One that does so surely is not named again for what is less. Peaks stand for prices, which no file states.

    Args:
        rows: those of `sweep_rows`, the boards' one behind the other, as many of each.
        boards: as given there.
        within_s: what the swath may take.
    """
    each, found = len(rows) // len(boards), dict[str, str]()
    placed = [(boards[k // each].peak_ops_per_s, row) for k, row in enumerate(rows)]
    ends: dict[str, Callable[[Figure], float | None]] = {
        "by the whole interval": lambda latency: _ends(latency)[1],
        "by the prediction": lambda latency: latency.value,
        "at best": lambda latency: _ends(latency)[0],
    }
    for how, end in ends.items():
        fits = [(peak, row) for peak, row in placed if (end(row.figures["latency"]) or math.inf) <= within_s]
        if fits:
            peak, row = min(fits, key=lambda fit: fit[0])
            found.setdefault(f"{row.name} ({peak / 1e12:.3g} TOPS)", how)
    words = "; ".join(f"{how} {name}" for name, how in found.items()) or "none of these"
    return f"the smallest DPU that takes {within_s:g} s or less: {words}"


def frame_row(prediction: Prediction) -> Row:
    """A network that is run on whole images, on one configuration: frames instead of a swath."""
    power, frame_s = dpu_power(prediction.dpu), swath_latency(prediction, 1 / prediction.batch)
    figures = {
        "work": exact(prediction.operations / 1e9, "GOP"),
        "batch": exact(prediction.batch, "frame", "images in flight"),
        "throughput": predicted(prediction.fps, "frame/s", prediction.fps_interval, COST_SOURCE),
        "one-thread latency": one_thread_latency(prediction),
        "host beside the DPU": host_time(prediction, "ms/frame"),
        "power": power,
        "energy": energy(frame_s, power),
    }
    words = {"host's task": prediction.task, "fitted range": fitted_range(prediction)}
    return Row("frames", f"{_named(prediction)}, whole images", figures, words)


def host_words(prediction: Prediction) -> list[str]:
    """What was assumed of the file, and what the processor runs because the DPU refuses it; a sentence each."""
    found = [prediction.note] if prediction.note else []
    if prediction.refused:
        low_ms, high_ms = (1e3 * end_s for end_s in prediction.refused_s)
        found.append(
            f"the processor of {prediction.dpu.target.name} runs what its DPU refuses ('beers-deploy check' says "
            f"why): {', '.join(prediction.refused)}; {number(low_ms, 2)} to {number(high_ms, 2)} ms an image, from "
            "the best that is published of its cores to plain code"
        )
    return found


def parse_tiles(text: str) -> list[int]:
    """Tile sides in pixels, with commas between them."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and len(part) < 6 and 16 <= int(part) <= MOST_TILE_PX for part in parts):
        remedy = "write one size, or several as 640,256,128"
        raise OptionError(
            "tile", expected=f"tile sides of 16 to {MOST_TILE_PX} pixels", got=repr(text), remedy=remedy
        )
    return [int(part) for part in parts]


def parse_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels as (width, height)."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 0 < int(part[:9]) <= SIDE_PX for part in parts):
        expected, remedy = f"WIDTHxHEIGHT of 1 to {SIDE_PX} pixels", f"write it as {PAPER_SIZE}"
        raise OptionError("size", expected=expected, got=repr(text), remedy=remedy)
    return int(parts[0]), int(parts[1])
