"""What the guards cost on the board: time of one tile, by the cost model.

ReLU6 is fused and costs nothing (UG1414 3.5). The rest is the host's. Before each tile it reads all weights and bias
for their checksums, and the shifts three times, at the rate at which it hands bytes to the DPU (fitted,
docs/cost-model.md); the limit is two instructions on the correction's int8 values, 16 of them at once, one a cycle of
the slowest clock (assumed). The share supposes that nothing of it hides behind the DPU, which is busy meanwhile.
"""

from math import exp

from deploy.dpu.board import Dpu
from deploy.dpu.cost import Prediction, frame_rate
from deploy.dpu.rates import Constants
from deploy.results import Figure, Row, predicted
from deploy.stress.flips import Patient
from quant.core import IntConv
from quant.upsets import INT8_BITS, weight_bits

SOURCE = "bytes over the host's fitted rate, docs/cost-model.md; limit: instructions over its clock"
TILE_PX = 640
AT_ONCE, INSTRUCTIONS = 16, 2


def price_rows(patient: Patient, prediction: Prediction, dpu: Dpu) -> list[Row]:
    """A row a guard and one for all of them, at work for every tile of 640 x 640."""
    relus = sum(op.relu for op in patient.core.ops if isinstance(op, IntConv))
    rate, values = Constants.of(dpu).host_in_bytes_per_s, patient.core.output_channels * TILE_PX**2
    clock_hz = 1e9 * dpu.limit("cpu", "clock_ghz").low
    times_s = {
        f"ReLU6 at {len(patient.guards.relu6)} of {relus} ReLUs": 0.0,
        f"limit of the correction, {patient.guards.limit_dn:g} DN": INSTRUCTIONS * values / AT_ONCE / clock_hz,
        "checksums of all weights": weight_bits(patient.core) / INT8_BITS / rate,
        "three copies of the shifts": 3 * len(patient.shifts) / rate,
    }
    times_s["all guards"] = sum(times_s.values())
    return [
        _row(name, time_s, prediction, exp(dpu.value("cost", "error_outside"))) for name, time_s in times_s.items()
    ]


def _row(name: str, time_s: float, prediction: Prediction, spread: float) -> Row:
    tile_s = prediction.batch_time_s / prediction.batch
    beside = frame_rate(prediction.batch_time_s, prediction.batch, prediction.host_s + time_s)
    share, lost = 100 * time_s / tile_s, 100 * (1 - beside / prediction.fps)
    figures = {
        "time": _predicted(1e3 * time_s, "ms/tile", spread),
        "of a tile, if nothing hides": _predicted(share, "%", spread),
        "frame rate lost beside the DPU": predicted(lost, "%", (0.0, max(share * spread, lost)), SOURCE),
    }
    return Row("guards", name, figures)


def _predicted(value: float, unit: str, spread: float) -> Figure:
    return predicted(value, unit, (value / spread, value * spread), SOURCE)
