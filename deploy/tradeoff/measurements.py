"""Measures what the cache lacks, one thing after the other in the time that is left; hands out what it holds."""

import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import psutil

from deploy.tradeoff.accuracy import Ground, Scores, cut_in_four, measure, measure_images, measure_mae
from deploy.tradeoff.cache import Cache, Key, code_digest, pixels_digest
from deploy.tradeoff.host_time import ROUNDS, Times, take_turns
from deploy.tradeoff.methods import Shelf, int8_ticks, operations_per_px, search_operations
from deploy.tradeoff.points import EXACT, Point, Unit
from model.processor import processor_name
from model.progress import Steps, steps

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


S_PER_OPERATION = {"INT8": 1e-11, "float": 3e-11}
S_PER_PX = {"network": 5e-7, "chain": 5e-6, "peer": 3e-6}
"""Rough times, for the progress bar alone."""


@dataclass(frozen=True)
class Lab:
    """Where units are measured: on which ground, on which tile, and where results are kept."""

    shelf: Shelf
    ground: Ground
    tile: np.ndarray
    cache: Cache

    def jobs(self, points: Sequence[Point], units: Sequence[Unit]) -> list[Job]:
        """What the cache lacks of these points, whose units can all be had, in the order in which to do it."""
        seams = dict.fromkeys((p.unit, int(p.halo)) for p in points if p.halo != EXACT)
        compared = [unit for unit in units if self.float_of(unit)]
        jobs = [self._making(unit) for unit in self.shelf.missing(units)]
        jobs += [self._scoring(unit) for unit in units if self.scores(unit) is None]
        jobs += [self._cutting(*seam) for seam in seams if self.cut_scores(*seam) is None]
        jobs += [self._comparing(unit) for unit in compared if self.mae(unit) is None]
        untimed = [unit for unit in units if self.times(unit) is None]
        return [*jobs, self._timing(untimed)] if untimed else jobs

    def scores(self, unit: Unit) -> Scores | None:
        """With exact seams."""
        return self.cache.find("scores", self._key(unit), Scores)

    def cut_scores(self, unit: Unit, halo_px: int) -> Scores | None:
        """Of images cut in four."""
        return self.cache.find("seams", self._key(unit, halo_px=halo_px), Scores)

    def mae(self, unit: Unit) -> Scores | None:
        """Of INT8 against the float network."""
        return self.cache.find("mae", self._mae_key(unit), Scores) if self.float_of(unit) else None

    def times(self, unit: Unit) -> Times | None:
        """On this machine."""
        return self.cache.find("host", self._host_key(unit), Times)

    def float_of(self, unit: Unit) -> Unit | None:
        """The float network that an INT8 one was made from."""
        network = self.shelf.networks.get(unit.method)
        known = network is not None and network.float_file is not None and unit.precision.startswith("INT8")
        return replace(unit, precision="float32") if known else None

    def _key(self, unit: Unit, **more: object) -> Key:
        return {"unit": str(unit), "model": self.shelf.digest(unit), **self.ground.key, **more}

    def _mae_key(self, unit: Unit) -> Key:
        other = self.float_of(unit)
        return self._key(unit, float=self.shelf.digest(other) if other else "")

    def _host_key(self, unit: Unit) -> Key:
        tile = pixels_digest([self.tile])
        here = {"tile": tile, "machine": machine(), "code": code_digest(Times.__module__)}
        return {"unit": str(unit), "model": self.shelf.digest(unit), **here}

    def _making(self, unit: Unit) -> Job:
        model = self.shelf.model(unit.method)
        work = 40 + search_operations(model) * S_PER_OPERATION["INT8"]
        return Job(f"making {unit}", work, int8_ticks(model, unit.precision), partial(self.shelf.make, unit))

    def _scoring(self, unit: Unit) -> Job:
        def run(tick: Tick) -> None:
            found = measure(self.shelf.open(unit).restore, self.ground, tick)
            self.cache.keep("scores", self._key(unit), found)

        return self._job(f"scoring {unit}", unit, run)

    def _cutting(self, unit: Unit, halo_px: int) -> Job:
        def run(tick: Tick) -> None:
            infer = self.shelf.open(unit).infer
            assert infer is not None  # noqa: S101 - only networks have tiles
            found = Scores(measure_images(cut_in_four(infer, halo_px, self.shelf.max_dn), self.ground, tick))
            self.cache.keep("seams", self._key(unit, halo_px=halo_px), found)

        return self._job(f"seams of {unit}, halo {halo_px}", unit, run)

    def _comparing(self, unit: Unit) -> Job:
        def run(tick: Tick) -> None:
            both = [self.shelf.open(each).restore for each in (unit, self.float_of(unit)) if each]
            self.cache.keep("mae", self._mae_key(unit), measure_mae(both[0], both[1], self.ground, tick))

        return self._job(f"{unit} against float32", unit, run, 3)

    def _timing(self, units: Sequence[Unit]) -> Job:
        def run(tick: Tick) -> None:
            found = take_turns([self.shelf.open(unit).restore for unit in units], self.tile, tick)
            for unit, times in zip(units, found, strict=True):
                self.cache.keep("host", self._host_key(unit), times)

        work = sum(self._seconds(unit, self.tile.size) for unit in units) * (ROUNDS + 1)
        return Job(f"times of {len(units)} methods on this machine", work, ROUNDS + 1, run)

    def _job(self, name: str, unit: Unit, run: Callable[[Tick], None], times: float = 1) -> Job:
        pixels = sum(pair.degraded.size for pair in self.ground.pairs)
        return Job(name, 1 + times * self._seconds(unit, pixels), len(self.ground.pairs) + 1, run)

    def _seconds(self, unit: Unit, pixels: int) -> float:
        a_px = S_PER_PX[unit.kind]
        if unit.kind == "network":
            kind = "INT8" if unit.precision.startswith("INT8") else "float"
            a_px += S_PER_OPERATION[kind] * operations_per_px(self.shelf.model(unit.method))
        return pixels * a_px


def machine() -> str:
    """What host times hold for: the processor and its cores."""
    return f"{platform.machine()} {processor_name() or platform.processor()} x {psutil.cpu_count()}"
