"""What the guards cost on the board: time of one tile, by the cost model.

ReLU6 is fused and costs nothing (UG1414 3.5). The rest is the host's. Before each tile it reads all weights and bias
for their checksums, and the shifts three times, at the rate at which it hands bytes to the DPU (fitted,
docs/cost-model.md; that a checksum keeps up with it is assumed). The limit is two instructions on the correction's
int8 values, 16 of them at once, one a cycle of the slowest clock (assumed). The share supposes that nothing of it
hides behind the DPU, which is busy meanwhile.
"""

from math import exp

from deploy.dpu.board import Dpu
from deploy.dpu.cost import Prediction, frame_rate
from deploy.dpu.rates import Constants
from deploy.results import Row, predicted
from deploy.stress.flips import Patient
from quant.core import IntConv
from quant.upsets import INT8_BITS, weight_bits

FUSED = "fused into the convolution (UG1414 3.5)"
INSTRUCTED = "two instructions of 16 values, one a cycle of the host's slowest clock (assumed)"
READ = (
    "bytes over the rate at which the host hands them to the DPU (fitted, docs/cost-model.md; assumed to hold here)"
)
TILE_PX = 640
AT_ONCE, INSTRUCTIONS = 16, 2


def price_rows(patient: Patient, prediction: Prediction, dpu: Dpu) -> list[Row]:
    """A row a guard and one for all of them, at work for every tile of 640 x 640."""
    relus = sum(op.relu for op in patient.core.ops if isinstance(op, IntConv))
    rate, values = Constants.of(dpu).host_in_bytes_per_s, patient.core.output_channels * TILE_PX**2
    clock_hz = 1e9 * dpu.limit("cpu", "clock_ghz").low
    limit_s = INSTRUCTIONS * values / AT_ONCE / clock_hz
    checksums_s = weight_bits(patient.core) / INT8_BITS / rate
    copies_s = 3 * len(patient.shifts) / rate
    spread = exp(dpu.value("cost", "error_outside"))
    guards = {
        f"ReLU6 at {len(patient.guards.relu6)} of {relus} ReLUs": (0.0, FUSED),
        f"limit of the correction, {patient.guards.limit_dn:g} DN": (limit_s, INSTRUCTED),
        "checksums of all weights": (checksums_s, READ),
        "three copies of the shifts": (copies_s, READ),
        "all guards": (limit_s + checksums_s + copies_s, f"{INSTRUCTED}; {READ}"),
    }
    return [_row(name, time_s, source, prediction, spread) for name, (time_s, source) in guards.items()]


def _row(name: str, time_s: float, source: str, prediction: Prediction, spread: float) -> Row:
    tile_s = prediction.batch_time_s / prediction.batch
    slow, fast = prediction.fps_interval
    beside = frame_rate(prediction.batch_time_s, prediction.batch, prediction.host_s + time_s)
    times_s, most = (time_s / spread, time_s * spread), 100 * time_s * spread * fast
    figures = {
        "time": predicted(1e3 * time_s, "ms/tile", (1e3 * times_s[0], 1e3 * times_s[1]), source),
        "of a tile, if nothing hides": predicted(100 * time_s / tile_s, "%", (100 * times_s[0] * slow, most), source),
        "frame rate lost beside the DPU": predicted(100 * (1 - beside / prediction.fps), "%", (0.0, most), source),
    }
    return Row("guards", name, figures)
