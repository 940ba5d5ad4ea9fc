"""The rows of the bench that need no measurement here.

These are a network on the DPU and the traditional pipeline on the board's own processor, both
predicted, and the paper's figures.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import product

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.cost.host import Task
from beers_deploy.dpu.cost.latency import Prediction, dpu_power
from beers_deploy.dpu.cost.model import between
from beers_deploy.network import NetworkLike
from beers_deploy.performance.swath import (
    Swath,
    efficiency,
    energy,
    exact,
    fitted_range,
    host_time,
    interval_ends,
    one_thread_latency,
    pipeline_rate,
    predict_network,
    scaled,
    swath_figures,
    swath_latency,
    throughput,
)
from beers_deploy.profiles.errors import OptionError, counted, listed, printable
from beers_deploy.profiles.figures import Figure, Row, number, predicted, published, unavailable
from beers_deploy.profiles.target import TargetProfile

TABLE = "bench"
LAYERS = "layers"
PIPELINE_TIME = "pipeline_s_per_mpx"
"""Key in a target's [cpu]: time of the traditional pipeline for 10^6 pixels on all cores."""
PAPER = "ConvBEERS paper, table of the VCK190 benchmark, 13600 x 9016"
PAPER_TARGET = "vck190"
"""The board that the paper measured. The paper's rows appear only next to this board."""


def predicted_rows(name: str, prediction: Prediction, swath: Swath) -> list[Row]:
    """Return the figures of a network on the DPU for a swath as two rows.

    The first counts tiles as the paper does, the number of pixels over those of a tile. The second
    counts whole tiles with their halo, as `restore` runs them.

    Args:
        name: the name of the network.
        prediction: the prediction for one tile.
        swath: the image and its tiles.
    """
    batches = math.ceil(swath.tiles * swath.runs / prediction.batch)
    counts = {
        "as the paper counts": (swath.frames, swath.frames * swath.runs / prediction.batch),
        f"whole tiles, halo {swath.halo_px} px": (float(swath.tiles), float(batches)),
    }
    besides = {
        "one-thread latency": one_thread_latency(prediction),
        "host next to the DPU": host_time(prediction, "ms/tile"),
    }
    words = {"fitted range": fitted_range(prediction)}
    name = f"{name}, INT8 on the DPU ({prediction.dpu.name})"
    return [
        Row(TABLE, f"{name}, {how}", swath_figures(prediction, swath, *count) | besides, words)
        for how, count in counts.items()
    ]


def published_rows() -> list[Row]:
    """Return the two runs on the VCK190 that the paper printed: the traditional pipeline on the
    processor, and ConvBEERS on the DPU, whose configuration it does not name.
    """
    runs = {
        "paper, 13600 x 9016: traditional on the VCK190's CPU": (1724, 0.2, 22.5, 3161),
        "paper, 13600 x 9016: ConvBEERS, INT8 on the DPU": (42, 7.2, 29.6, 98965),
    }
    units = {"latency": "s", "throughput": "frame/s", "power": "W", "efficiency": "px/s/W"}
    rows = []
    for name, values in runs.items():
        printed = zip(units.items(), values, strict=True)
        figures = {key: published(value, unit, PAPER) for (key, unit), value in printed}
        rows.append(Row(TABLE, name, figures))
    return rows


def processor_row(swath: Swath, board: TargetProfile) -> Row:
    """Predict the traditional pipeline on the board's own processor, for comparison with a DPU.

    The time is that of 10^6 pixels in the board's file, scaled by the pixels of all bands. If the
    file does not state it, the latency is unavailable, and there are no throughput and no
    efficiency. A power that the file does not state is unavailable too.

    Args:
        swath: the image.
        board: the board.
    """
    cpu = board.tables.get("cpu", {})
    mpx = swath.band_pixels / 1e6
    power = unavailable("W", "no power of a run on this board's processor is published")
    if watts := board.tables.get("power", {}).get("cpu_run_w"):
        power = published(watts.low, "W", watts.source)
    cores = f", {counted(int(cpu['cores'].low), 'core')}" if "cores" in cpu else ""
    name = f"traditional pipeline on the processor of {board.name}{cores}"
    if PIPELINE_TIME not in cpu:
        reason = f"the target states no [cpu] {PIPELINE_TIME}"
        return Row(TABLE, name, {"latency": unavailable("s", reason), "power": power})
    constant = cpu[PIPELINE_TIME]
    ends_s = mpx * constant.low, mpx * constant.high
    # The two ends are factors apart: their geometric mean stands for the value.
    latency = predicted(between(ends_s), "s", ends_s, constant.source)
    figures = {
        "latency": latency,
        "throughput": pipeline_rate(swath, latency),
        "power": power,
        "efficiency": efficiency(swath.pixels, latency, power),
    }
    return Row(TABLE, name, figures)


def layer_rows(prediction: Prediction) -> list[Row]:
    """Return a row for each layer on the DPU, and a last one with the sum of their times.

    The columns are those of AMD's profiler vaitrace, and a text "bound" with the longest part of
    the layer's time. Times are those of a batch, bytes of feature maps those of one image.
    """
    rows = []
    batch = prediction.batch
    for layer in prediction.layers:
        work = layer.work
        moved_bytes = batch * work.map_bytes + work.weight_bytes
        # A concat takes no time of its own: over an infinite time its rates are 0.
        seconds = layer.time_s or math.inf
        figures = {
            "work": exact(work.operations / 1e9, "GOP"),
            "time": scaled(1e3 * layer.time_s, "ms/batch", prediction),
            "rate": scaled(batch * work.operations / seconds / 1e9, "GOP/s", prediction),
            "LdFM": _moved(work.load_map_bytes, "feature maps that an image loads"),
            "LdWB": _moved(work.weight_bytes, "weights and biases that a batch loads"),
            "StFM": _moved(work.store_map_bytes, "feature maps that an image stores"),
            "bandwidth": scaled(moved_bytes / seconds / 1e9, "GB/s", prediction),
            "array use": exact(100 * work.array_use, "%"),
        }
        rows.append(Row(LAYERS, work.name, figures, {"bound": layer.bound}))
    time = scaled(1e3 * prediction.batch_time_s, "ms/batch", prediction)
    return [*rows, Row(LAYERS, f"sum: one batch of {batch}", {"time": time})]


def _moved(size_bytes: int, what: str) -> Figure:
    return exact(size_bytes / 1e6, "MB", f"{what}, by the graph's shapes")


MOST_TILE_PX = 8192
"""One layer's result of 64 channels has 17 GB there; no board has a tenth of it."""


def sweep_rows(
    network: NetworkLike,
    swaths: Sequence[Swath],
    boards: Sequence[Dpu],
    task: Task | None = None,
) -> list[Row]:
    """Predict a swath for every combination of a configuration and a tile size.

    Args:
        network: the network.
        swaths: the image in tiles of each size, with the runs that these tiles need.
        boards: the DPU configurations.
        task: the host's task with the results; None derives it from the network's operators.

    Returns:
        A row for each combination: all tile sizes of the first configuration, then of the next.
    """
    rows = []
    for dpu, swath in product(boards, swaths):
        prediction = predict_network(network, dpu, swath.tile_px, task, swath.step_px)
        batches = math.ceil(swath.tiles * swath.runs / prediction.batch)
        on_chip = [not layer.work.map_bytes for layer in prediction.layers]
        figures = swath_figures(prediction, swath, swath.tiles, batches) | {
            "maps through memory": exact(prediction.streamed_bytes / 1e6, "MB/tile"),
            "layers on chip": exact(100 * sum(on_chip) / len(on_chip), "%"),
        }
        times_s = defaultdict[str, float](float)
        for layer in prediction.layers:
            times_s[layer.bound] += layer.time_s
        longest = max(times_s, key=lambda bound: times_s[bound])
        words = {"bound": longest, "fitted range": fitted_range(prediction)}
        rows.append(Row("sweep", f"{named(dpu)}, tiles of {swath.tile_px}", figures, words))
    return rows


def named(dpu: Dpu) -> str:
    """Return the names of the board and of its configuration, such as "vck190 C32B3"."""
    return f"{dpu.target.name} {dpu.name}"


def within_words(rows: Sequence[Row], boards: Sequence[Dpu], within_s: float) -> str:
    """Return a sentence that names the smallest DPU which computes the swath in time.

    Up to three are named: in time by the whole interval, by the prediction, and at best. A DPU is
    named once, for the surest of these. Size is peak performance, in place of a price, which no
    file states.

    Args:
        rows: the rows of `sweep_rows`, the same number for each configuration in turn.
        boards: the configurations that were passed to `sweep_rows`.
        within_s: the time limit of the swath in s.
    """
    rows_per_board = len(rows) // len(boards)
    # The rows of a board stand next to each other, the same number for each board.
    peaks = [boards[k // rows_per_board].peak_ops_per_s for k in range(len(rows))]
    latencies = [row.figures["latency"] for row in rows]
    best_s, worst_s = zip(*map(interval_ends, latencies), strict=True)
    ends = {
        "by the whole interval": worst_s,
        "by the prediction": [latency.value for latency in latencies],
        "at best": best_s,
    }
    names = dict[str, str]()
    for how, times_s in ends.items():
        fits = [k for k, time_s in enumerate(times_s) if (time_s or math.inf) <= within_s]
        if fits:
            smallest = min(fits, key=lambda k: peaks[k])
            # A DPU that is named for a surer level is not named again.
            name = f"{rows[smallest].name} ({peaks[smallest] / 1e12:.3g} TOPS)"
            names.setdefault(name, how)
    words = "; ".join(f"{how} {name}" for name, how in names.items()) or "none of these"
    return f"the smallest DPU that takes {within_s:g} s or less: {words}"


def frame_row(prediction: Prediction) -> Row:
    """Return the predicted figures of a network that runs on whole images, not on tiles.

    Times, rates and energy are those of one image (a frame).
    """
    power = dpu_power(prediction.dpu)
    frame_s = swath_latency(prediction, 1 / prediction.batch)
    figures = {
        "work": exact(prediction.operations / 1e9, "GOP"),
        "batch": exact(prediction.batch, "frame", "images in flight"),
        "throughput": throughput(prediction),
        "one-thread latency": one_thread_latency(prediction),
        "host next to the DPU": host_time(prediction, "ms/frame"),
        "power": power,
        "energy": energy(frame_s, power),
    }
    words = {"host's task": prediction.task, "fitted range": fitted_range(prediction)}
    return Row("frames", f"{named(prediction.dpu)}, whole images", figures, words)


def host_words(prediction: Prediction) -> list[str]:
    """Return notes on a prediction: what was assumed of a float file, and which nodes the board's
    processor runs because its DPU refuses them.
    """
    sentences = list(filter(None, [prediction.note]))
    if prediction.refused:
        low_ms, high_ms = (1e3 * end_s for end_s in prediction.refused_s)
        sentences.append(
            f"the processor of {prediction.dpu.target.name} runs what its DPU refuses "
            "('beers-deploy check' says "
            f"why): {', '.join(prediction.refused)}; {number(low_ms, 2)} to "
            f"{number(high_ms, 2)} ms an image, from "
            "the best that is published of its cores to plain code"
        )
    return sentences


def parse_tiles(tile: int | str | Sequence[int]) -> list[int]:
    """Parse the option `tile` of `bench`.

    Args:
        tile: one side in pixels, a sequence of sides, or text with commas between them.

    Raises:
        OptionError: a side is not an integer from 16 to MOST_TILE_PX.
    """
    sides = [str(part).strip() for part in listed(tile)]
    # Python raises an error of its own for very long numbers, so these are refused by their length.
    if not sides or not all(
        side.isdecimal() and len(side) < 6 and 16 <= int(side) <= MOST_TILE_PX for side in sides
    ):
        raise OptionError(
            f"`tile` must be sides of 16 to {MOST_TILE_PX} pixels, got {printable(repr(tile))}. "
            "Write one side, or several as 640,256,128."
        )
    return [int(side) for side in sides]
