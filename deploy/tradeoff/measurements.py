"""Measures what the cache lacks, one thing after the other in the time that is left; hands out what it holds."""

import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import psutil

from deploy.cache import Cache, Key, code_digest, pixels_digest
from deploy.tradeoff.accuracy import BenchmarkSet, Scores, cut_in_four, measure, measure_images, measure_mae
from deploy.tradeoff.detection import BESIDE, Detected, Detection
from deploy.tradeoff.host_time import ROUNDS, Times, time_variants
from deploy.tradeoff.methods import MethodStore, int8_ticks, operations_per_px, search_operations
from deploy.tradeoff.points import EXACT, Point, Variant
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
        """Count so much more work as done."""
        self.reach(self.done + work)

    def reach(self, done: float) -> None:
        """Set how much work is done, and show it with the time left."""
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
class Measurements:
    """Where variants are measured: on which benchmark, on which tile, and where results are kept."""

    store: MethodStore
    benchmark: BenchmarkSet
    tile: np.ndarray
    cache: Cache
    detection: Detection | None = None

    def jobs(self, points: Sequence[Point], variants: Sequence[Variant]) -> list[Job]:
        """What the cache lacks of these points, whose variants can all be had, in the order in which to do it."""
        seams = dict.fromkeys((p.variant, int(p.halo)) for p in points if p.halo != EXACT)
        compared = [variant for variant in variants if self.float_of(variant)]
        jobs = [self._making(variant) for variant in self.store.missing(variants)]
        jobs += [self._scoring(variant) for variant in variants if self.scores(variant) is None]
        jobs += [self._cutting(*seam) for seam in seams if self.cut_scores(*seam) is None]
        jobs += [self._comparing(variant) for variant in compared if self.mae(variant) is None]
        jobs += self._detections(variants)
        untimed = [variant for variant in variants if self.times(variant) is None]
        return [*jobs, self._timing(untimed)] if untimed else jobs

    def scores(self, variant: Variant) -> Scores | None:
        """Kept scores of a variant with exact seams, None where it is yet to be measured."""
        return self.cache.find("scores", self._key(variant), Scores)

    def cut_scores(self, variant: Variant, halo_px: int) -> Scores | None:
        """Kept scores of a variant on images cut in four, each part with so much halo; None where there are none."""
        return self.cache.find("seams", self._key(variant, halo_px=halo_px), Scores)

    def mae(self, variant: Variant) -> Scores | None:
        """Kept mean differences of an INT8 variant from its float network; None where there are none."""
        return self.cache.find("mae", self._mae_key(variant), Scores) if self.float_of(variant) else None

    def times(self, variant: Variant) -> Times | None:
        """Kept times of a variant on this machine, None where there are none."""
        return self.cache.find("host", self._host_key(variant), Times)

    def detected(self, variant: Variant) -> Detected | None:
        """Kept score of a detector on what a variant restored; None where there is none, or none was asked for."""
        return self.detection.find(str(variant), self.store.digest(variant)) if self.detection else None

    def float_of(self, variant: Variant) -> Variant | None:
        """The float network that an INT8 one was made from."""
        network = self.store.networks.get(variant.method)
        known = network is not None and network.float_file is not None and variant.precision.startswith("INT8")
        return replace(variant, precision="float32") if known else None

    def _key(self, variant: Variant, **more: object) -> Key:
        return {"variant": str(variant), "model": self.store.digest(variant), **self.benchmark.key, **more}

    def _mae_key(self, variant: Variant) -> Key:
        other = self.float_of(variant)
        return self._key(variant, float=self.store.digest(other) if other else "")

    def _host_key(self, variant: Variant) -> Key:
        tile = pixels_digest([self.tile])
        here = {"tile": tile, "machine": machine(), "code": code_digest(Times.__module__)}
        return {"variant": str(variant), "model": self.store.digest(variant), **here}

    def _making(self, variant: Variant) -> Job:
        model = self.store.model(variant.method)
        work = 40 + search_operations(model) * S_PER_OPERATION["INT8"]
        return Job(f"making {variant}", work, int8_ticks(model, variant.precision), partial(self.store.make, variant))

    def _scoring(self, variant: Variant) -> Job:
        def run(tick: Tick) -> None:
            found = measure(self.store.open(variant).restore, self.benchmark, tick)
            self.cache.keep("scores", self._key(variant), found)

        return self._job(f"scoring {variant}", variant, run)

    def _cutting(self, variant: Variant, halo_px: int) -> Job:
        def run(tick: Tick) -> None:
            infer = self.store.open(variant).infer
            assert infer is not None  # noqa: S101 - only networks have tiles
            cut = cut_in_four(infer, halo_px, self.store.max_dn, self.store.tiling(variant.method).lattice_px)
            found = Scores(measure_images(cut, self.benchmark, tick))
            self.cache.keep("seams", self._key(variant, halo_px=halo_px), found)

        return self._job(f"seams of {variant}, halo {halo_px}", variant, run)

    def _comparing(self, variant: Variant) -> Job:
        def run(tick: Tick) -> None:
            both = [self.store.open(each).restore for each in (variant, self.float_of(variant)) if each]
            self.cache.keep("mae", self._mae_key(variant), measure_mae(both[0], both[1], self.benchmark, tick))

        return self._job(f"{variant} against float32", variant, run, 3)

    def _detections(self, variants: Sequence[Variant]) -> list[Job]:
        """One job for all that a detector is yet to look at: each scene is acquired once."""
        detection = self.detection
        if detection is None:
            return []
        by_name = {str(variant): variant for variant in variants}
        known = {**BESIDE, **{name: self.store.digest(variant) for name, variant in by_name.items()}}
        contents = {name: content for name, content in known.items() if detection.find(name, content) is None}

        def run(tick: Tick) -> None:
            restores = {name: self.store.open(by_name[name]).restore for name in contents if name in by_name}
            detection.measure(contents, restores, tick)

        work = 1 + sum(self._seconds(by_name[name], detection.pixels) for name in contents if name in by_name)
        job = Job(f"objects found by {len(contents)} methods", work, detection.ticks(len(contents)), run)
        return [job] if contents else []

    def _timing(self, variants: Sequence[Variant]) -> Job:
        def run(tick: Tick) -> None:
            found = time_variants([self.store.open(variant).restore for variant in variants], self.tile, tick)
            for variant, times in zip(variants, found, strict=True):
                self.cache.keep("host", self._host_key(variant), times)

        work = sum(self._seconds(variant, self.tile.size) for variant in variants) * (ROUNDS + 1)
        return Job(f"times of {len(variants)} methods on this machine", work, ROUNDS + 1, run)

    def _job(self, name: str, variant: Variant, run: Callable[[Tick], None], times: float = 1) -> Job:
        pixels = sum(pair.degraded.size for pair in self.benchmark.pairs)
        return Job(name, 1 + times * self._seconds(variant, pixels), len(self.benchmark.pairs) + 1, run)

    def _seconds(self, variant: Variant, pixels: int) -> float:
        a_px = S_PER_PX[variant.kind]
        if variant.kind == "network":
            kind = "INT8" if variant.precision.startswith("INT8") else "float"
            a_px += S_PER_OPERATION[kind] * operations_per_px(self.store.model(variant.method))
        return pixels * a_px


def machine() -> str:
    """What host times hold for: the processor and its cores."""
    return f"{platform.machine()} {processor_name() or platform.processor()} x {psutil.cpu_count()}"
