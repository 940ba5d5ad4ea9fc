"""Figures of points from what was measured of their units, and from the cost model."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from deploy.bench import Swath
from deploy.dpu.board import load_dpu
from deploy.evaluation.methods import Method
from deploy.evaluation.scores import mean_row
from deploy.results import Figure, measured, predicted, unavailable
from deploy.tradeoff.accuracy import FLAT, MAE, Scores
from deploy.tradeoff.board import FIGURES as BOARD
from deploy.tradeoff.board import BoardRun, CpuRun, DpuRun, predict_model
from deploy.tradeoff.demands import NAMES
from deploy.tradeoff.host_time import Times, host_figures
from deploy.tradeoff.lab import Lab
from deploy.tradeoff.outcome import QUALITIES, Outcome
from deploy.tradeoff.points import EXACT, Point, on_dpu
from deploy.tradeoff.seams import seam_density, with_seams
from deploy.tradeoff.shelf import runtime_of
from model.metrics.bootstrap import site_interval
from profiles.errors import ModelError
from quant.onnx_file import load_onnx

UNITS = dict(NAMES.values())
"""Every figure of a point, in the order in which they are shown, with its unit."""

DPU_ONLY = "the DPU takes INT8 alone, with scales that are powers of two"
NOT_PAIRED = "no float network of it at hand"
NO_INT8 = "not an INT8 network"


@dataclass(frozen=True)
class Assembly:
    """Makes outcomes; `lacks` says of units that cannot be had why not."""

    lab: Lab
    swath: Swath
    lacks: Mapping[str, str]

    def outcome(self, point: Point) -> Outcome:
        """All that is known of a point."""
        reason = self.lacks.get(str(point.unit), "")
        if reason:
            return Outcome(point, {key: unavailable(unit, reason) for key, unit in UNITS.items()}, self._text(point))
        swath = self._swath(point)
        times, work_factor = self.lab.times(point.unit), swath.work_factor(swath.tiles)
        work_factor = work_factor if point.unit.kind == "network" else 1.0
        scores, run = self._scores(point, swath), self._board(point, swath, times)
        figures = self._quality(point, scores) | self._host(times, work_factor, point)
        figures |= run.figures() if not isinstance(run, str) else {f"board {k}": unavailable("", run) for k in BOARD}
        ordered = {key: replace(figures[key], unit=unit) for key, unit in UNITS.items()}
        board = None if isinstance(run, str) else run
        return Outcome(point, ordered, self._text(point), scores, board, times, work_factor)

    def _swath(self, point: Point) -> Swath:
        halo_px = point.halo_px(self.lab.shelf.radius_px(point.unit.method)) if point.unit.kind == "network" else 0
        return replace(self.swath, tile_px=point.tile_px, halo_px=halo_px)

    def _scores(self, point: Point, swath: Swath) -> Scores:
        exact = self.lab.scores(point.unit)
        assert exact is not None  # noqa: S101 - its job has run
        if point.halo == EXACT:
            return exact
        cut = self.lab.cut_scores(point.unit, int(point.halo))
        assert cut is not None  # noqa: S101 - its job has run
        shapes = [pair.degraded.shape for pair in self.lab.ground.pairs]
        return with_seams(exact, cut, shapes, seam_density(swath))

    def _quality(self, point: Point, scores: Scores) -> dict[str, Figure]:
        ground = self.lab.ground
        means = mean_row(Method("", lambda dn: dn, ""), scores.images, ground.sites, ground.instruments, ground.seed)  # type: ignore[arg-type] # read, never written
        figures = {key: means.figures[key] for key in QUALITIES}
        if point.halo != EXACT:
            figures = {key: _with_seams(figure) for key, figure in figures.items()}
        return figures | {key: scores.targets[key] for key in ("MTF at Nyquist", FLAT)} | {MAE: self._mae(point)}

    def _mae(self, point: Point) -> Figure:
        found = self.lab.mae(point.unit)
        if found is None:
            return unavailable("ratio", NOT_PAIRED if point.unit.precision.startswith("INT8") else NO_INT8)
        values = [values[MAE] or 0.0 for values in found.images]
        ground = self.lab.ground
        interval, words = site_interval(values, ground.sites, np.random.default_rng(ground.seed))
        source = f"mean of {len(values)} pairs, exact seams, of full scale, {words}"
        return measured(float(np.mean(values)), "ratio", source, interval)

    def _host(self, times: Times | None, work_factor: float, point: Point) -> dict[str, Figure]:
        assert times is not None  # noqa: S101 - its job has run
        return host_figures(times, work_factor, runtime_of(point.unit), self.lab.ground.seed)

    def _board(self, point: Point, swath: Swath, times: Times | None) -> BoardRun | str:
        """Its run on the board, or why there is none."""
        if point.unit.kind != "network":
            assert times is not None  # noqa: S101 - its job has run
            low, high = times.cpu_per_px()
            return CpuRun((low * swath.pixels, high * swath.pixels), swath)
        file = self.lab.shelf.int8_file(point.unit)
        if not on_dpu(point.unit) or file is None:
            return DPU_ONLY
        try:
            dpu = load_dpu("vck190", point.configuration)
            return DpuRun(point.unit.method, dpu, predict_model(load_onnx(file), dpu, point.tile_px), swath)
        except ModelError as error:
            return str(error).rstrip(".")

    def _text(self, point: Point) -> dict[str, str]:
        network = point.unit.kind == "network"
        return {
            "method": point.unit.method,
            "kind": point.unit.kind,
            "precision": point.unit.precision,
            "halo": point.halo if network else "none",
            "tile": str(point.tile_px) if network else "none",
            "configuration": point.configuration or "none",
            "told": self.lab.shelf.told(point.unit),
            "runtime": runtime_of(point.unit),
        }


def _with_seams(figure: Figure) -> Figure:
    if figure.value is None:
        return figure
    source = f"{figure.source}; seams measured on the images cut in four, weighed by the swath's seams"
    return predicted(figure.value, figure.unit, figure.interval or (figure.value,) * 2, source)
