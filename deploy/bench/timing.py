"""How work is timed on this machine: a network node by node, a call with its power, several calls interleaved.

Time by node is onnxruntime's profiler's, power that of RAPL's counters: never a guess from a data sheet.
"""

import json
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnx

from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.quant.session import open_session

RUNS = 5


@dataclass(frozen=True)
class NodeTime:
    """A node as the runtime fused it: its mean time of a run, in ms."""

    name: str
    operator: str
    time_ms: float


def profile(model: onnx.ModelProto, feed: dict[str, np.ndarray], threads: int = 0) -> tuple[list[NodeTime], float]:
    """The nodes in the order in which they ran, and the whole run's mean time in ms, after one run for warm-up."""
    with tempfile.TemporaryDirectory() as folder:
        session = open_session(model, threads, profile=Path(folder) / "profile")
        for _ in range(RUNS + 1):
            session.run(None, feed)
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    return _means(events)


def node_rows(nodes: Iterable[NodeTime], total_ms: float) -> list[Row]:
    """One row a node, one for what the runtime does between them, and their sum."""
    rows = [(node.name, node.time_ms, {"operator": node.operator}) for node in nodes]
    rest_ms = total_ms - sum(time_ms for _, time_ms, _ in rows)
    rows += [("between the nodes", rest_ms, {}), ("sum: one tile", total_ms, {})]
    source = f"onnxruntime's profiler, mean of {RUNS} runs after one for warm-up; profiling itself takes a little"
    return [
        Row(
            "host nodes",
            name,
            {
                "time": measured(time_ms, "ms/tile", source),
                "share": measured(100 * time_ms / total_ms, "%", source),
            },
            words,
        )
        for name, time_ms, words in rows
    ]


def _means(events: list[dict[str, object]]) -> tuple[list[NodeTime], float]:
    """Mean times in ms of all runs but the first, from the profiler's events (times in microseconds)."""
    runs = sorted(_number(e, "ts") for e in events if e.get("name") == "model_run")
    kept = [e for e in events if _number(e, "ts") >= runs[1]]
    total_us = sum(_number(e, "dur") for e in kept if e.get("name") == "model_run")
    times: dict[tuple[str, str], float] = {}
    for event in sorted(kept, key=lambda e: _number(e, "ts")):
        name, about = str(event.get("name")), event.get("args")
        if event.get("cat") == "Node" and name.endswith("_kernel_time") and isinstance(about, dict):
            key = (name.removesuffix("_kernel_time"), str(about.get("op_name")))
            times[key] = times.get(key, 0.0) + _number(event, "dur")
    count = 1e3 * (len(runs) - 1)
    return [NodeTime(*key, time_us / count) for key, time_us in times.items()], total_us / count


def _number(event: dict[str, object], key: str) -> float:
    value = event.get(key)
    return float(value) if isinstance(value, int | float) else 0.0


POWERCAP = Path("/sys/class/powercap")

Result = TypeVar("Result")
Call = Callable[[], object]


def timed(work: Callable[[], Result], powercap: Path = POWERCAP) -> tuple[Result, float, Figure]:
    """Do some work; return its result, its wall time in seconds, and the processor packages' mean power."""
    before = _read(powercap)
    start = time.perf_counter()
    result = work()
    elapsed_s = time.perf_counter() - start
    return result, elapsed_s, _power(before, _read(powercap), elapsed_s)


def _power(before: dict[Path, int] | str, after: dict[Path, int] | str, elapsed_s: float) -> Figure:
    if isinstance(before, str) or isinstance(after, str):
        return unavailable("W", before if isinstance(before, str) else str(after))
    if elapsed_s <= 0:
        return unavailable("W", "the work took no time that the clock can tell")
    energy_uj = sum(_advance(domain, before[domain], after[domain]) for domain in before)
    return measured(energy_uj / 1e6 / elapsed_s, "W", "RAPL package counters over the same window")


def _advance(domain: Path, before: int, after: int) -> int:
    """Counts between two readings of a counter that starts again at its range; one turn at most (minutes)."""
    return (
        after - before
        if after >= before
        else after - before + int((domain / "max_energy_range_uj").read_text(encoding="utf-8"))
    )


def _read(powercap: Path) -> dict[Path, int] | str:
    """Counters of the packages in microjoules, or why there are none."""
    try:
        domains = [
            d
            for d in sorted(powercap.glob("*rapl*:*"))
            if (d / "name").read_text(encoding="utf-8").startswith("package")
        ]
        counters = {domain: int((domain / "energy_uj").read_text(encoding="utf-8")) for domain in domains}
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no number in it"
        return f"RAPL energy counters cannot be read here ({reason})"
    return counters or "this machine shows no RAPL energy counters (usual in virtual machines)"


def interleaved(
    calls: Sequence[Call], measure: Callable[[Call], Result], enough: Callable[[Sequence[Sequence[Result]]], bool]
) -> list[list[Result]]:
    """Run every call once a round until there are enough rounds, and so compare them fairly.

    Args:
        calls: what is timed, already warmed up.
        measure: runs one call and says what it took.
        enough: asked after each round, with what was measured so far of each call, in the order of `calls`.

    Returns:
        What was measured of each call, round by round.
    """
    found: list[list[Result]] = [[] for _ in calls]
    while True:
        for call, taken in zip(calls, found, strict=True):
            taken.append(measure(call))
        if enough(found):
            return found
