"""What is proven of the pair for every image, beside what was measured: the rows that `stress` prints."""

import math
from collections.abc import Iterable

from deploy.results import Figure, Row, measured, predicted, unavailable
from deploy.stress.battery import Outcome
from deploy.stress.cases import FULL_DN
from deploy.stress.subject import Subject
from profiles.errors import BeersError
from quant.bounds import Bound, bound_anywhere, bound_inside
from quant.core import IntCore
from quant.int_bounds import correction_bound, layer_bounds
from quant.integer import INT32_BITS
from quant.passes.dual_gain import GAIN

WRITTEN = "0 to 4095 DN, clipped"
INTERVALS = "proven for every image: interval arithmetic on the file's own weights"


def proof_rows(subject: Subject, outcomes: Iterable[Outcome]) -> list[Row]:
    """Bounds of both networks; where there is none, why."""
    outcomes = list(outcomes)
    return [*_float_rows(subject, outcomes), *_int8_rows(subject, outcomes)]


def overflow_proven(subject: Subject) -> bool:
    """Whether no accumulator of the INT8 file can overflow; True where there is no core to look at."""
    if not isinstance(subject.core, IntCore):
        return True
    return all(bound.bits < INT32_BITS for bound in layer_bounds(subject.core))


def layer_rows(subject: Subject) -> list[Row]:
    """Each integer layer: bits that its accumulator needs at most, and whether it might saturate."""
    if not isinstance(subject.core, IntCore):
        return []
    return [
        Row(
            "integer layers",
            bound.name,
            {"accumulator": _proven(bound.bits, "bits")},
            {
                "can it overflow int32": "no" if bound.bits < INT32_BITS else "YES",
                "can it saturate int8": "perhaps" if bound.saturates else "never",
            },
        )
        for bound in layer_bounds(subject.core)
    ]


def _float_rows(subject: Subject, outcomes: list[Outcome]) -> list[Row]:
    gain = _largest(outcomes, "float32", ("gain", "gain, steepest"))
    if isinstance(subject.graph, BeersError):
        why = str(subject.graph)
        return [Row("proofs", "float32", {"low": unavailable("DN", why), "gain, measured": gain})]
    rows = []
    for name, bound in (("anywhere", bound_anywhere(subject.graph)), ("inside", bound_inside(subject.graph))):
        figures = {**_range(bound), "gain, measured": gain}
        rows.append(Row("proofs", f"float32 before the clip, {name}", figures, {"as written": WRITTEN}))
    return rows


def _int8_rows(subject: Subject, outcomes: list[Outcome]) -> list[Row]:
    if not isinstance(subject.core, IntCore):
        why = "no INT8 file given" if subject.core is None else str(subject.core)
        return [Row("proofs", "INT8", {"low": unavailable("DN", why)})]
    size = FULL_DN * correction_bound(subject.core, GAIN)
    figures = _range(Bound(-size / FULL_DN, 1 + size / FULL_DN, 2 * size + 1))
    figures["gain, measured"] = _largest(outcomes, "INT8", ("gain",))
    return [Row("proofs", "INT8 before the clip", figures, {"as written": WRITTEN})]


def _range(bound: Bound) -> dict[str, Figure]:
    return {
        "low": _proven(FULL_DN * bound.low, "DN"),
        "high": _proven(FULL_DN * bound.high, "DN"),
        "gain, proven": _proven(bound.gain, "DN per DN"),
    }


def _proven(value: float, unit: str) -> Figure:
    """A bound has no interval: it is arithmetic, and true."""
    if not math.isfinite(value):
        return unavailable(unit, "weights that are not finite bound nothing")
    return predicted(value, unit, (value, value), INTERVALS)


def _largest(outcomes: list[Outcome], stage: str, checks: tuple[str, ...]) -> Figure:
    values = [m.value for o in outcomes if o.stage == stage for m in o.measures if m.check in checks]
    if not values:
        return unavailable("DN per DN", f"no case was looked at in {stage}")
    return measured(max(values), "DN per DN", "stress: the largest over the cases")
