"""What was found of each point, points compared with one another, and fronts of points that none dominates.

Figures come from what was measured of a point's parts and from the cost model; fronts hold by value and beyond
intervals.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol

import numpy as np

from deploy.bench.tables import Swath
from deploy.dpu.board import dpu_of
from deploy.tradeoff.accuracy import FLAT, MAE, Scores, seam_density, with_seams
from deploy.tradeoff.board import FIGURES as BOARD
from deploy.tradeoff.board import BoardRun, DpuRun, cpu_run, energy_ratio, latency_ratio, predict_model
from deploy.tradeoff.detection import OTHER_HALO, Detected
from deploy.tradeoff.host_time import Times, host_figures, ratio_interval
from deploy.tradeoff.measurements import Measurements
from deploy.tradeoff.methods import runtime_of
from deploy.tradeoff.points import EXACT, MAP50, NAMES, NAMES_LABELLED, Point, on_dpu
from model.evaluation.methods import Method
from model.evaluation.scores import mean_row
from model.metrics.bootstrap import LEAST_SITES, site_interval
from profiles import TargetProfile
from profiles.errors import ModelError
from profiles.figures import Figure, Row, measured, predicted, unavailable
from quant.onnx_file import load_onnx

Interval = tuple[float, float]


@dataclass(frozen=True)
class Place:
    """A point in one plane: what it costs, and how good it is (higher is better)."""

    name: str
    cost: float
    quality: float


class Judge(Protocol):
    """Tells points apart, each with the interval of the difference."""

    def ratio(self, a: str, b: str) -> Interval:
        """Interval of the cost of `a` over that of `b`."""
        ...

    def gain(self, a: str, b: str) -> Interval:
        """Quality of `a` less quality of `b`."""
        ...


def front(places: Sequence[Place]) -> tuple[str, ...]:
    """Names on the front by values, from cheap to dear; of points that are alike the first."""
    members, best = [], float("-inf")
    for place in sorted(places, key=lambda p: (p.cost, -p.quality)):
        if place.quality > best:
            members.append(place.name)
            best = place.quality
    return tuple(members)


def dominates(a: Place, b: Place, judge: Judge) -> bool:
    """Whether `a` is no worse than `b` in both and better in one, by value and over the whole intervals.

    Intervals of pictures and of times on this machine are 95 % bootstrap intervals of the difference or the ratio;
    those of the board follow the rule in `board`.
    """
    worse = a.cost > b.cost or a.quality < b.quality
    if worse or (a.cost, a.quality) == (b.cost, b.quality):
        return False
    most, least = judge.ratio(a.name, b.name)[1], judge.gain(a.name, b.name)[0]
    return most <= 1 and least >= 0 and (most < 1 or least > 0)


def dominated(places: Sequence[Place], judge: Judge) -> Mapping[str, str]:
    """Every point that another dominates, with the best of those that do."""
    found = {}
    for b in places:
        above = [a for a in places if a.name != b.name and dominates(a, b, judge)]
        if above:
            found[b.name] = max(above, key=lambda a: (a.quality, -a.cost)).name
    return found


COSTS = ("board latency", "board energy", "host p50")
QUALITIES = {"PSNR": 1, "SSIM": 1, "LPIPS-squeeze": -1}
"""Figures of quality that every study has, and whether more (1) or less (-1) of it is better."""
DIRECTIONS = {**QUALITIES, MAP50: 1}
"""The same of all: a study has mAP50 where labelled images are given."""
DIFFERENCE_UNITS = {"%": "points"}
"""Units of differences where they are not those of the figures."""
PAIRED = "on the same images, 95 % bootstrap interval of the paired difference over sites"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was found of a point.

    Attributes:
        point: what it is.
        figures: all of them, unavailable ones with their reasons.
        text: words beside them.
        scores: image by image; None where there are none.
        board: its run on the board; None where it has none.
        host: its times here; None where there are none.
        detected: what a detector finds on what it restored; None where it was not asked.
        work_factor: pixels computed for each of the swath's.
    """

    point: Point
    figures: Mapping[str, Figure]
    text: Mapping[str, str]
    scores: Scores | None = None
    board: BoardRun | None = None
    host: Times | None = None
    detected: Detected | None = None
    work_factor: float = 1.0

    @property
    def name(self) -> str:
        """The name under which its point is listed."""
        return self.point.name

    @property
    def host_s(self) -> list[float]:
        """Its times for a megapixel here, round by round."""
        return self.host.per_megapixel(self.work_factor).tolist() if self.host else []

    @property
    def row(self) -> Row:
        """Its figures and words as a row of the table of points."""
        return Row("points", self.name, self.figures, self.text)

    def value(self, key: str) -> float | None:
        """A figure's value, where it can be compared: a published one was found elsewhere."""
        figure = self.figures.get(key)
        return figure.value if figure is not None and figure.mode != "published" else None

    def place(self, x: str, y: str) -> Place | None:
        """Where it lies in a plane; None where it lacks one of the two."""
        cost, quality = self.value(x), self.value(y)
        return None if cost is None or quality is None else Place(self.name, cost, DIRECTIONS[y] * quality)


@dataclass(frozen=True)
class Results:
    """All outcomes, and the sites of the pairs that they share."""

    outcomes: Mapping[str, Outcome]
    sites: Sequence[str]
    seed: int

    def gain(self, a: str, b: str, key: str) -> Interval:
        """How much better `a` is than `b`: bootstrap over sites of the differences on the same images, 95 %.

        Endless either way where the sites are too few to tell anything apart.
        """
        if key == MAP50:
            return _detected_gain(self.outcomes[a], self.outcomes[b])
        first, second = (self._values(name, key) for name in (a, b))
        return _difference(first, second, tuple(self.sites), QUALITIES[key], self.seed)

    def difference(self, a: str, b: str, key: str) -> Figure:
        """A quality of `a` less that of `b` on the same images, with the interval of the paired difference."""
        pair = [self.outcomes[name] for name in (a, b)]
        unit = DIFFERENCE_UNITS.get(pair[0].figures[key].unit, pair[0].figures[key].unit)
        first, second = (each.value(key) for each in pair)
        if first is None or second is None:
            return unavailable(unit, f"no {key} of {b if second is None else a} on the images of this study")
        low, high = sorted(DIRECTIONS[key] * end for end in self.gain(a, b, key))
        known = math.isfinite(high - low)
        source = (
            f"{key} less that of {b} {PAIRED if known else f'on the same images of fewer than {LEAST_SITES} sites'}"
        )
        value = first - second
        if "predicted" in {each.figures[key].mode for each in pair}:
            return predicted(value, unit, (low, high) if known else (value, value), source)
        return measured(value, unit, source, (low, high) if known else None)

    def ratio(self, a: str, b: str, key: str) -> Interval:
        """Interval of the cost of `a` over that of `b`."""
        first, second = self.outcomes[a], self.outcomes[b]
        if key.startswith("host"):
            return self._host_ratio(first, second)
        assert first.board is not None  # noqa: S101 - only what has the figure is compared by it
        assert second.board is not None  # noqa: S101
        return (latency_ratio if key == "board latency" else energy_ratio)(first.board, second.board)

    def times(self, a: str, b: str, key: str) -> float:
        """Cost of `a` over cost of `b`, by value; on the host of the same rounds where there are such."""
        first, second = self.outcomes[a], self.outcomes[b]
        if key.startswith("host") and _together(first, second):
            ratios = [w1 / w2 for w1, w2 in zip(first.host_s, second.host_s, strict=True)]
            return float(np.median(ratios))
        return (first.value(key) or 0.0) / (second.value(key) or math.inf)

    def _host_ratio(self, a: Outcome, b: Outcome) -> Interval:
        return ratio_interval(np.asarray(a.host_s), np.asarray(b.host_s), _together(a, b), self.seed)

    def _values(self, name: str, key: str) -> tuple[float, ...]:
        scores = self.outcomes[name].scores
        return tuple(np.nan if v[key] is None else float(v[key] or 0.0) for v in scores.images) if scores else ()


@dataclass(frozen=True)
class Plane:
    """Two figures of all results, as a judge of which points differ in them."""

    results: Results
    x: str
    y: str

    def ratio(self, a: str, b: str) -> Interval:
        """Interval of the cost of `a` over that of `b`."""
        return self.results.ratio(a, b, self.x)

    def gain(self, a: str, b: str) -> Interval:
        """Quality of `a` less quality of `b`."""
        return self.results.gain(a, b, self.y)


def _together(a: Outcome, b: Outcome) -> bool:
    """Whether both were timed in the same rounds."""
    return a.host is not None and b.host is not None and a.host.session == b.host.session


def _detected_gain(a: Outcome, b: Outcome) -> Interval:
    if a.point.variant == b.point.variant:  # the same pictures, on however many sites
        return 0.0, 0.0
    return a.detected.gain(b.detected) if a.detected and b.detected else (-math.inf, math.inf)


@cache
def _difference(
    first: tuple[float, ...], second: tuple[float, ...], sites: tuple[str, ...], sign: int, seed: int
) -> Interval:
    differences = sign * (np.asarray(first) - np.asarray(second))
    known = np.isfinite(differences)
    if known.any() and not differences[known].any():  # the same pictures, on however many sites
        return 0.0, 0.0
    places = np.asarray(sites)[known].tolist()
    interval, _ = site_interval(differences[known].tolist(), places, np.random.default_rng(seed))
    return interval or (-np.inf, np.inf)


UNITS = dict(NAMES.values())
"""Every figure of a point, in the order in which they are shown, with its unit."""
UNITS_LABELLED = dict(NAMES_LABELLED.values())
"""The same where labelled images are given."""

DPU_ONLY = "the DPU takes INT8 alone, with scales that are powers of two"
NOT_PAIRED = "no float network of it at hand"
NO_INT8 = "not an INT8 network"


@dataclass(frozen=True)
class Assembly:
    """Puts together what was measured and what is predicted of each point; `lacks`: why a variant cannot be had."""

    measurements: Measurements
    swath: Swath
    lacks: Mapping[str, str]
    target: TargetProfile

    @property
    def units(self) -> Mapping[str, str]:
        """Every figure of this study's points, with its unit."""
        return UNITS_LABELLED if self.measurements.detection else UNITS

    def outcome(self, point: Point) -> Outcome:
        """All that is known of a point."""
        reason = self.lacks.get(str(point.variant), "")
        if reason:
            lacking = {key: unavailable(unit, reason) for key, unit in self.units.items()}
            return Outcome(point, lacking, self._text(point))
        swath = self._swath(point)
        times, work_factor = self.measurements.times(point.variant), swath.work_factor(swath.tiles)
        work_factor = work_factor if point.variant.kind == "network" else 1.0
        scores, run = self._scores(point, swath), self._board(point, swath, times)
        figures = self._quality(point, scores) | self._host(times, work_factor, point)
        figures |= run.figures() if not isinstance(run, str) else {f"board {k}": unavailable("", run) for k in BOARD}
        detected = self._detected(point)
        figures[MAP50] = detected.figure if detected else unavailable("%", OTHER_HALO)
        ordered = {key: replace(figures[key], unit=unit) for key, unit in self.units.items()}
        board = None if isinstance(run, str) else run
        return Outcome(point, ordered, self._text(point), scores, board, times, detected, work_factor)

    def _detected(self, point: Point) -> Detected | None:
        """What is found on its pictures: those of its variant, where no seam can be seen."""
        return self.measurements.detected(point.variant) if point.halo == EXACT else None

    def _swath(self, point: Point) -> Swath:
        halo_px = (
            point.halo_px(self.measurements.store.tiling(point.variant.method).halo_px)
            if point.variant.kind == "network"
            else 0
        )
        return replace(self.swath, tile_px=point.tile_px, halo_px=halo_px)

    def _scores(self, point: Point, swath: Swath) -> Scores:
        exact = self.measurements.scores(point.variant)
        assert exact is not None  # noqa: S101 - its job has run
        if point.halo == EXACT:
            return exact
        cut = self.measurements.cut_scores(point.variant, int(point.halo))
        assert cut is not None  # noqa: S101 - its job has run
        shapes = [pair.degraded.shape for pair in self.measurements.benchmark.pairs]
        return with_seams(exact, cut, shapes, seam_density(swath))

    def _quality(self, point: Point, scores: Scores) -> dict[str, Figure]:
        benchmark = self.measurements.benchmark
        method, images = Method("", lambda dn: dn, ""), [dict(values) for values in scores.images]
        means = mean_row(method, images, benchmark.sites, benchmark.instruments, benchmark.seed)
        figures = {key: means.figures[key] for key in QUALITIES}
        if point.halo != EXACT:
            figures = {key: _with_seams(figure) for key, figure in figures.items()}
        return figures | {key: scores.targets[key] for key in ("MTF at Nyquist", FLAT)} | {MAE: self._mae(point)}

    def _mae(self, point: Point) -> Figure:
        found = self.measurements.mae(point.variant)
        if found is None:
            return unavailable("ratio", NOT_PAIRED if point.variant.precision.startswith("INT8") else NO_INT8)
        values = [values[MAE] or 0.0 for values in found.images]
        benchmark = self.measurements.benchmark
        interval, words = site_interval(values, benchmark.sites, np.random.default_rng(benchmark.seed))
        source = f"mean of {len(values)} pairs, exact seams, of full scale, {words}"
        return measured(float(np.mean(values)), "ratio", source, interval)

    def _host(self, times: Times | None, work_factor: float, point: Point) -> dict[str, Figure]:
        assert times is not None  # noqa: S101 - its job has run
        return host_figures(times, work_factor, runtime_of(point.variant), self.measurements.benchmark.seed)

    def _board(self, point: Point, swath: Swath, times: Times | None) -> BoardRun | str:
        """Its run on the board, or why there is none."""
        if point.variant.kind != "network":
            assert times is not None  # noqa: S101 - its job has run
            low, high = times.cpu_per_px()
            return cpu_run(point.variant.method, (low * swath.pixels, high * swath.pixels), swath, self.target)
        file = self.measurements.store.int8_file(point.variant)
        if not on_dpu(point.variant) or file is None:
            return DPU_ONLY
        try:
            dpu = dpu_of(self.target, point.configuration)
            return DpuRun(point.variant.method, dpu, predict_model(load_onnx(file), dpu, point.tile_px), swath)
        except ModelError as error:
            return str(error).rstrip(".")

    def _text(self, point: Point) -> dict[str, str]:
        network = point.variant.kind == "network"
        return {
            "method": point.variant.method,
            "kind": point.variant.kind,
            "precision": point.variant.precision,
            "halo": point.halo if network else "none",
            "tile": str(point.tile_px) if network else "none",
            "configuration": point.configuration or "none",
            "sensor": self.measurements.store.sensor_known(point.variant),
            "runtime": runtime_of(point.variant),
        }


def _with_seams(figure: Figure) -> Figure:
    if figure.value is None:
        return figure
    source = f"{figure.source}; seams measured on the images cut in four, weighed by the swath's seams"
    return predicted(figure.value, figure.unit, figure.interval or (figure.value,) * 2, source)
