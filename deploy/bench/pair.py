"""Two networks that take turns on one DPU: a frame is restored, then looked at by a detector."""

from pathlib import Path

from deploy.bench.tables import COST_SOURCE, efficiency, exact, fitted_range, predict_file
from deploy.dpu.board import Dpu
from deploy.dpu.cost.latency import Prediction, dpu_power
from deploy.dpu.reading import own_tile_px
from profiles.errors import ModelError
from profiles.figures import Figure, Row, predicted
from quant.onnx_file import load_onnx

TABLE = "pair"
LEFT_OUT = "letterboxing, decoding and suppression of boxes that overlap, which run on the board's processor"


def pair_on_board(restorer: Path, detector: Path, dpu: Dpu) -> list[Row]:
    """What a frame of the detector's size takes on a DPU: to restore it, to detect on it, and both.

    The two run one behind the other, so their times add up; both come from one cost model, so the ends of their
    intervals do too. Nothing is assumed to overlap between them. The frame is restored as one tile, without a halo.

    Args:
        restorer: an ONNX file that restores images of any size, float or INT8.
        detector: one of a fixed, square size.
        dpu: the board's configuration.

    Returns:
        Rows of the table `pair`: the restorer, the detector, and both. Throughput in frames a second, efficiency in
        pixels of the frame a second and watt; the power is that of any network on this board
        (docs/explanation/cost-model.md).

    Raises:
        ModelError: a detector that is not fixed to one size, or a network that does not run whole on the DPU.
    """
    side_px = own_tile_px(load_onnx(detector))
    if side_px is None:
        remedy = "export it with a fixed size (imgsz)"
        raise ModelError(str(detector), expected="a detector of one size", got="any size", remedy=remedy)
    predictions = {
        "restoration": predict_file(restorer, dpu, side_px),
        "detection": predict_file(detector, dpu, None),
    }
    times = {name: frame_time(prediction) for name, prediction in predictions.items()}
    rows = [_row(f"{name} alone", side_px, times[name], [predictions[name]], dpu) for name in times]
    return [*rows, _row("restoration + detection", side_px, _sum(list(times.values())), [*predictions.values()], dpu)]


def frame_time(prediction: Prediction) -> Figure:
    """Seconds a frame, batches back to back."""
    slow, fast = prediction.fps_interval
    return predicted(1 / prediction.fps, "s", (1 / fast, 1 / slow), COST_SOURCE)


def _sum(times: list[Figure]) -> Figure:
    """One behind the other, the errors of all in the same direction."""
    ends = [time.interval or (time.value or 0.0, time.value or 0.0) for time in times]
    low, high = (sum(end[k] for end in ends) for k in (0, 1))
    return predicted(sum(time.value or 0.0 for time in times), "s", (low, high), COST_SOURCE)


def _row(name: str, side_px: int, time: Figure, predictions: list[Prediction], dpu: Dpu) -> Row:
    power = dpu_power(dpu)
    low, high = time.interval or (0.0, 0.0)
    figures = {
        "work": exact(sum(p.operations for p in predictions) / 1e9, "GOP"),
        "time": predicted(1e3 * (time.value or 0.0), "ms/frame", (1e3 * low, 1e3 * high), time.source),
        "throughput": predicted(1 / (time.value or 1.0), "frame/s", (1 / high, 1 / low), time.source),
        "power": power,
        "efficiency": efficiency(side_px**2, time, power),
    }
    words = {
        "board": f"{dpu.target.name} {dpu.name}",
        "frame": f"{side_px} x {side_px}",
        "fitted range": "; ".join(dict.fromkeys(map(fitted_range, predictions))),
        "left out": LEFT_OUT,
    }
    return Row(TABLE, name, figures, words)
