"""Fit the constants of the cost model to rates that somebody measured.

Least squares on ln(FPS) with a soft L1 loss (a rate far off counts linearly), each network weighing the same, by
damped Gauss-Newton on the logarithms of the constants. Rates with several threads tell how much the DPU and the host
get done side by side; those with one thread, which weigh ALONE as much, how long they take one after the other.
`prior` pulls each logarithm to its start: gently for the published rates, firmly where an owner has a few runs.
"""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.cost.constants import DPU_CONSTANTS, NAMES, Array, Constants, Structure
from deploy.dpu.cost.layers import Layers

START = Constants(0.8, 1.0, 40, 0.6, 6e-6, 1e-4, 5e-5, 0.4e9, 0.8e9, 0.3e9, 30e6, 60e6, 0.8e9)
"""Where the fit begins: the right orders of magnitude."""

SPREAD = np.array([0.3, 0.5, 1, 0.5, 1, 1, 1, 0.7, 0.7, 0.7, 1, 1, 1])
"""How far each logarithm may lie from its start, a standard deviation: shares less than times and rates."""

SOFT = 0.1
"""Residual in ln(FPS) from where a rate counts linearly."""
ALONE = 0.25

WEAK_PRIOR, FIRM_PRIOR = 1.0, 2.0
"""1 / what SPREAD is multiplied by."""

STEP = 1e-5
"""Of a logarithm, for slopes."""

SHIFTS = np.outer((0.0, -0.4, 0.4), np.eye(len(NAMES))[NAMES.index("memory_efficiency")])
"""Where the fit begins, from the start: where one part of a layer outruns another the cost has kinks, and the nearest
low point need not be the lowest."""

ENOUGH, STUCK, MOST = 1e-5, 1e5, 200
"""A step that gains less than this share of the cost is the last, and so is one that needs this much damping, or the
one with this number: along a kink steps grow ever smaller."""


@dataclass(frozen=True)
class Case:
    """A network on a configuration with its rates.

    Attributes:
        network: its name.
        family: networks of one family resemble one another.
        configuration: of the DPU.
        layers: what its layers take.
        host: units of the host's work for one image (7,), see `host.host_work`.
        host_cores: of the board's processor.
        fps: rates with several threads, one or more.
        fps_single: rates with one thread, perhaps none.
        map_bytes: its largest result.
    """

    network: str
    family: str
    configuration: str
    layers: Layers
    host: Array
    host_cores: int
    fps: tuple[float, ...]
    fps_single: tuple[float, ...]
    map_bytes: int


@dataclass(frozen=True)
class Times:
    """Seconds of one image, (n,) each: the DPU with all its cores, with one core alone, the host's cores together."""

    dpu_s: Array
    alone_s: Array
    host_s: Array


@dataclass(frozen=True)
class Cases:
    """Several cases of one board, stacked for speed."""

    rows: tuple[Case, ...]
    structure: Structure

    @cached_property
    def layers(self) -> Layers:
        """All layers, one network behind the other."""
        return Layers.join([row.layers for row in self.rows])

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        sizes = [len(row.layers.cores) for row in self.rows]
        return np.cumsum([0, *sizes[:-1]])

    @cached_property
    def _host(self) -> Array:
        return np.stack([row.host for row in self.rows])

    @cached_property
    def host_cores(self) -> Array:
        """Cores of the board's processor, (n,)."""
        return np.array([row.host_cores for row in self.rows], float)

    @cached_property
    def observed(self) -> Array:
        """Mean ln(FPS) with several threads, (n,)."""
        return np.array([np.log(row.fps).mean() for row in self.rows])

    @cached_property
    def observed_single(self) -> Array:
        """Mean ln(FPS) with one thread, (n,); NaN where there is none."""
        return np.array([np.log(row.fps_single).mean() if row.fps_single else np.nan for row in self.rows])

    @cached_property
    def _has_single(self) -> NDArray[np.bool_]:
        return ~np.isnan(self.observed_single)

    @cached_property
    def weights(self) -> Array:
        """Weights of the rates with several and with one thread, (2 n,): a network counts once."""
        counts = Counter(row.network for row in self.rows)
        each = np.array([1 / counts[row.network] for row in self.rows])
        return np.concatenate([each, ALONE * each * self._has_single])

    def times(self, constants: Constants) -> Times:
        """What an image takes."""
        return Times(*self._dpu_s(constants), self.host_s(constants))

    def host_s(self, constants: Constants) -> Array:
        """Time of one core of the host for one image, (n,)."""
        times: Array = self._host @ constants.host_s_per_unit
        return times

    def _dpu_s(self, constants: Constants) -> tuple[Array, Array]:
        shared, cores = self._core_s(constants, alone=False), self._of_cases(self.layers.cores)
        alone = shared if cores.max() == 1 else self._core_s(constants, alone=True)
        handlers = self._of_cases(self.layers.handlers)
        return shared / (handlers * cores), alone / handlers

    def _core_s(self, constants: Constants, *, alone: bool) -> Array:
        """Time of one batch on every core, or on one core alone (n,)."""
        times = self.layers.time_s(constants, self.structure, alone=alone)
        return np.add.reduceat(times, self._starts) + constants.batch_s

    def _of_cases(self, of_layers: Array) -> Array:
        """What all layers of a case share, (n,)."""
        return of_layers[self._starts]

    def predicted(self, times: Times) -> Array:
        """ln(FPS) with several threads, (n,)."""
        dpu, host, q = np.log(times.dpu_s), np.log(times.host_s / self.host_cores), self.structure.crowding
        return -np.logaddexp(q * dpu, q * host) / q

    def residuals(self, times: Times) -> Array:
        """ln(predicted / observed) with several and with one thread, (2 n,); 0 where nothing was observed."""
        single = -np.log(times.alone_s + times.host_s) - self.observed_single
        single[~self._has_single] = 0
        return np.concatenate([self.predicted(times) - self.observed, single])

    def errors(self, constants: Constants) -> Array:
        """ln(predicted / observed) of FPS with several threads, (n,)."""
        return self.predicted(self.times(constants)) - self.observed

    def rate_errors(self, errors: Array) -> list[Array]:
        """ln(predicted / rate) of each case's rates with several threads, from the `errors` of their means (n,)."""
        centres = errors + self.observed
        return [centre - np.log(row.fps) for centre, row in zip(centres, self.rows, strict=True)]

    def slopes(self, logs: Array, times: Times, residuals: Array) -> Array:
        """Derivatives of the residuals by the logarithms of the constants, (2 n, 13)."""
        columns = []
        for index in range(len(logs)):
            there = self._moved(logs, times, index)
            columns.append((self.residuals(there) - residuals) / STEP)
        return np.stack(columns, axis=1)

    def _moved(self, logs: Array, times: Times, index: int) -> Times:
        """The times with one logarithm moved; what it does not concern is not computed again."""
        if index < DPU_CONSTANTS:
            moved = logs.copy()
            moved[index] += STEP
            return Times(*self._dpu_s(Constants.from_logs(moved)), times.host_s)
        unit = index - DPU_CONSTANTS
        change = 1 if unit == 0 else -1  # the first is a time, the others are rates
        part = self._host[:, unit] * np.exp(change * logs[index])
        return Times(times.dpu_s, times.alone_s, times.host_s + part * np.expm1(change * STEP))

    def only(self, keep: NDArray[np.bool_]) -> "Cases":
        """The rows where `keep` (n,) is true."""
        return Cases(tuple(row for row, kept in zip(self.rows, keep, strict=True) if kept), self.structure)


def fit(
    cases: Cases, start: Constants = START, prior: float = WEAK_PRIOR, near: Constants | None = None
) -> Constants:
    """The constants that come nearest to the rates.

    Args:
        cases: what was observed.
        start: what `prior` pulls to.
        prior: how firmly.
        near: where to begin, if not around `start`.
    """
    begins = [near.logs] if near else [start.logs + shift for shift in SHIFTS]
    points = [_descend(cases, logs, start.logs, prior) for logs in begins]
    return Constants.from_logs(min(points, key=lambda point: point.cost).logs)


def _descend(cases: Cases, logs: Array, anchor: Array, prior: float) -> "_Point":
    """Where damped steps end."""
    point, damping = _Point.at(cases, logs, anchor, prior), 1e-3
    for _ in range(MOST):
        new = _Point.at(cases, point.logs + point.step(damping), anchor, prior)
        if new.cost >= point.cost:
            damping *= 4
            if damping > STUCK:
                break
            continue
        done = point.cost - new.cost < ENOUGH * point.cost and damping < 1
        point, damping = new, max(damping / 4, 1e-9)
        if done:
            break
    return point


@dataclass(frozen=True)
class _Point:
    """Where the fit stands."""

    cases: Cases
    logs: Array
    times: Times
    residuals: Array
    pull: Array  # distance from the start, in standard deviations
    firm: Array  # 1 / standard deviations
    cost: float

    @classmethod
    def at(cls, cases: Cases, logs: Array, anchor: Array, prior: float) -> "_Point":
        times, firm = cases.times(Constants.from_logs(logs)), prior / SPREAD
        residuals, pull = cases.residuals(times), (logs - anchor) * firm
        soft = 2 * (np.sqrt(1 + (residuals / SOFT) ** 2) - 1)
        return cls(cases, logs, times, residuals, pull, firm, float(cases.weights @ soft + pull @ pull))

    @cached_property
    def _downhill(self) -> tuple[Array, Array]:
        """The normal matrix (13, 13) and minus half the gradient (13,)."""
        slopes = self.cases.slopes(self.logs, self.times, self.residuals)
        weights = self.cases.weights / np.sqrt(1 + (self.residuals / SOFT) ** 2) / SOFT**2
        normal = slopes.T @ (weights[:, None] * slopes) + np.diag(self.firm**2)
        return normal, -(slopes.T @ (weights * self.residuals) + self.firm * self.pull)

    def step(self, damping: float) -> Array:
        """A damped Gauss-Newton step, (13,)."""
        normal, down = self._downhill
        return np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), down))
