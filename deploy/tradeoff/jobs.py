"""What is still to be measured, one thing after the other, with the time that is left."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from deploy.progress import Steps, steps

PARTS = 100
MIN_S = 20.0
"""No guess at the time left before this much has passed."""

Tick = Callable[[], None]


@dataclass(frozen=True)
class Job:
    """One measurement that the cache lacks.

    Attributes:
        name: what is measured.
        work: how long it takes beside the others, in any unit.
        ticks: how often `run` calls its argument.
        run: measures and keeps it.
    """

    name: str
    work: float
    ticks: int
    run: Callable[[Tick], None]


def run_jobs(jobs: Sequence[Job], clock: Callable[[], float] = time.monotonic) -> None:
    """Run jobs in order; the bar counts hundredths of their work."""
    if not jobs:
        return
    with steps("tradeoff", PARTS) as bar:
        meter = Meter(bar, sum(job.work for job in jobs), clock)
        for number, job in enumerate(jobs, 1):
            meter.name = f"{number}/{len(jobs)} {job.name}"
            job.run(partial(meter.advance, job.work / max(job.ticks, 1)))
            meter.reach(sum(each.work for each in jobs[:number]))


@dataclass
class Meter:
    """How much of the work is done, and what that means for the time left."""

    bar: Steps
    total: float
    clock: Callable[[], float]
    done: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        self._start = self.clock()

    def advance(self, work: float) -> None:
        """So much more is done."""
        self.reach(self.done + work)

    def reach(self, done: float) -> None:
        """So much is done."""
        self.done = done
        left = time_left(done, self.total, self.clock() - self._start)
        self.bar.advance(round(PARTS * done / self.total) - self.bar.done, f"{self.name}{left and f', {left} left'}")


def time_left(done: float, total: float, elapsed_s: float) -> str:
    """What remains at the pace so far, in words; nothing before there is a pace."""
    if done <= 0 or elapsed_s < MIN_S:
        return ""
    left_s = max(elapsed_s * (total - done) / done, 0)
    return f"about {left_s / 60:.0f} min" if left_s >= 90 else f"about {left_s:.0f} s"
