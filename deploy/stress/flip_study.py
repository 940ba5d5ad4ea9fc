"""`stress --bit-flips`: the fault target, and the tables of what flips do to it and what guards cost."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import exp
from pathlib import Path

from deploy.bench.tables import predict_file
from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.cost.constants import Constants
from deploy.dpu.cost.latency import Prediction
from deploy.report.plots import Curve, Panel, Points, curves_svg
from deploy.restoration.options import TILE_PX
from deploy.stress import flips
from deploy.stress.flips import MEMORIES, SETS, FaultTarget, name_of, rates_of
from deploy.stress.networks import core_of
from deploy.stress.subject import Subject
from profiles.figures import Row, predicted
from quant.calibration import HELD_OUT_SEED, Calibration
from quant.faults import INT8_BITS, as_stored, learn_guards, weight_bits
from quant.graph import Activation

FUSED = "fused into the convolution (UG1414 3.5)"
INSTRUCTED = "two instructions of 16 values, one a cycle of the host's slowest clock (assumed)"
READ = (
    "bytes over the rate at which the host hands them to the DPU "
    "(fitted, docs/explanation/cost-model.md; assumed to hold here)"
)
AT_ONCE, INSTRUCTIONS = 16, 2


def price_rows(target: FaultTarget, prediction: Prediction, dpu: Dpu) -> list[Row]:
    """A row a guard and one for all of them, at work for every tile of 640 x 640."""
    relus = sum(op.activation is Activation.relu for op in target.core.convolutions)
    rate = Constants.of(dpu).host_in_bytes_per_s * dpu.whole("cpu", "cores")  # fitted for one core
    values = target.core.ends.gains * TILE_PX**2
    clock_hz = 1e9 * dpu.limit("cpu", "clock_ghz").low
    limit_s = INSTRUCTIONS * values / AT_ONCE / clock_hz
    scrubbing_s = weight_bits(target.core) / INT8_BITS / rate
    copies_s = 3 * len(target.shifts) / rate
    spread = exp(dpu.value("cost", "width_outside"))
    guards = {
        f"ReLU6 at {len(target.guards.relu6)} of {relus} ReLUs": (0.0, FUSED),
        f"limit of the correction, {target.guards.limit_dn:g} DN": (limit_s, INSTRUCTED),
        "scrubbing of all weights": (scrubbing_s, READ),
        "triple modular redundancy of the shifts": (copies_s, READ),
        "all guards": (limit_s + scrubbing_s + copies_s, f"{INSTRUCTED}; {READ}"),
    }
    return [_row(name, time_s, source, prediction, spread) for name, (time_s, source) in guards.items()]


def _row(name: str, time_s: float, source: str, prediction: Prediction, spread: float) -> Row:
    tile_s = prediction.batch_time_s / prediction.batch
    slow, fast = prediction.fps_interval
    # The host prepares the next tile while the DPU runs: only what does not fit beside it costs frames.
    before_s, beside_s = max(tile_s, prediction.host_s), max(tile_s, prediction.host_s + time_s)
    times_s, most = (time_s / spread, time_s * spread), 100 * time_s * spread * fast
    figures = {
        "time": predicted(1e3 * time_s, "ms/tile", (1e3 * times_s[0], 1e3 * times_s[1]), source),
        "of a tile, if nothing hides": predicted(100 * time_s / tile_s, "%", (100 * times_s[0] * slow, most), source),
        "frame rate lost beside the DPU": predicted(100 * (1 - before_s / beside_s), "%", (0.0, most), source),
    }
    return Row("guards", name, figures)


CALIBRATION_PATCHES = 16


@dataclass(frozen=True)
class FlipRequest:
    """What to inject faults into, and how often.

    Attributes:
        sensor: profile of the degraded patches.
        images: folder of scenes; drawn ones where there is none.
        target: board whose cost model prices the guards.
        draws: injections into each kind of memory at each rate.
        size_px: side of a patch.
        seed: of patches and injections.
    """

    sensor: str
    images: Path | None
    target: str
    draws: int
    size_px: int
    seed: int


def flip_rows(subject: Subject, request: FlipRequest, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """The rows of the whole study: quality against flips, where one flip hurts, what guards cost.

    Raises:
        ModelError: no INT8 file, or one whose whole numbers cannot be told.
        BeersError: no such target, sensor or images.
    """
    core_of(subject)  # refused before anything is drawn
    dpu = load_dpu(request.target, None)
    prediction = predict_file(subject.paths[-1], dpu, TILE_PX)
    dpu.limit("cpu", "clock_ghz")  # and so is a board that cannot price the guards
    target = make_target(subject, request)
    curves = flips.curve_rows(target, request.draws, request.seed, tick)
    places = flips.place_rows(target, request.seed, request.size_px // 2, tick)
    return [*curves, *places, *price_rows(target, prediction, dpu)]


def ticks(subject: Subject, request: FlipRequest) -> int:
    """How often `flip_rows` reports progress."""
    return flips.curve_ticks(request.draws) + len(core_of(subject).ops)


def make_target(subject: Subject, request: FlipRequest) -> FaultTarget:
    """The core as the board stores it, guards that calibration patches teach, and other patches to try it on."""
    core = as_stored(core_of(subject))
    taught, tried = (
        Calibration(request.sensor, request.images, count, request.size_px, seed).drawn
        for seed, count in ((request.seed, CALIBRATION_PATCHES), (request.seed + HELD_OUT_SEED, request.draws))
    )
    guards = learn_guards(core, (core.ends.split(image) for image in taught.degraded))
    return FaultTarget(core, guards, list(tried.pairs))


SHOWN = (SETS[-1], SETS[0])


def flip_curves_svg(networks: Mapping[str, Sequence[Row]]) -> str:
    """PSNR against bit flips, with all guards and with none; rows by the network's name."""
    panels = [Panel(memory, _curves(networks, memory)) for memory in MEMORIES]
    return curves_svg(panels, "bit flips in a megabit", "PSNR, dB (measured)")


def _curves(networks: Mapping[str, Sequence[Row]], memory: str) -> list[Curve]:
    return [
        Curve(f"{name}, {guards}", colour, guards == SETS[0], _points(rows, memory, guards))
        for colour, (name, rows) in enumerate(networks.items())
        for guards in SHOWN
    ]


def _points(rows: Sequence[Row], memory: str, guards: str) -> Points:
    by_name = {row.name: row for row in rows if row.table == "bit flips"}
    values = {rate: by_name[name_of(memory, rate)].figures[guards].value for rate in rates_of(memory)}
    return tuple((rate, value) for rate, value in values.items() if value is not None)
