"""Fit the constants of the cost model to published rates.

The fit minimises squares of ln(FPS) with a soft L1 loss (a rate far off counts linearly) by damped
Gauss-Newton steps on the logarithms of the constants. Each network has the same weight. Rates with
several threads determine the throughput of the DPU and the host in parallel. Rates with one thread,
with the weight ALONE, determine the time of both in sequence. A weak prior pulls each logarithm to
its start. No array exceeds its peak, so its efficiency is at most 1.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from beers_deploy.dpu.cost.host import host_parts_s
from beers_deploy.dpu.cost.model import NAMES, Array, Constants, Layers, Structure, shares_of
from benchmarks.cost_model.published import Case

START = Constants(0.8, 40, 0.55, 6e-6, 5e-5, 0.4e9, 0.8e9, 0.3e9, 30e6, 60e6, 1.3e9)
"""The fit begins at these values of the right order of magnitude.

The host is assumed to need a clock cycle for a pixel of an image.
"""
DEVIATION = np.array([0.3, 1, 0.2, 1, 1, 0.7, 0.7, 0.7, 1, 1, 0.5])
"""Standard deviation of each logarithm from its start, smaller for shares than for times and rates.

Few networks determine the efficiency of the VCK190's memory, and they differ by 1.7. So the values
of the other boards, 0.5 to 0.65, count too.
"""
SOFT = 0.1
"""Residual in ln(FPS) above which a rate counts linearly."""
ALONE = 0.25
PEAK = NAMES.index("array_efficiency")
STEP = 1e-5
"""Difference of a logarithm for numerical slopes."""
SHIFTS = np.outer((0.0, -0.4, 0.4), np.eye(len(NAMES))[NAMES.index("memory_efficiency")])
"""Offsets from START at which further fits begin.

The cost has kinks where one part of a layer becomes slower than another, so the nearest minimum
need not be the lowest.
"""
ENOUGH = 1e-5
STUCK = 1e5
MAX_STEPS = 200
"""The fit ends if a step gains less than ENOUGH of the cost, needs the damping STUCK, or has the
number MAX_STEPS, because along a kink steps become ever smaller.
"""


def logs_of(constants: Constants) -> Array:
    """Return the natural logarithms of the constants, (11,), which are fitted."""
    return np.asarray(np.log([getattr(constants, name) for name in NAMES]))


def from_logs(logs: Array) -> Constants:
    """Return the constants of their natural logarithms, (11,)."""
    return Constants(*np.exp(logs).tolist())


def rounded(constants: Constants) -> Constants:
    """Return the constants with four significant digits, as a profile stores them."""
    return Constants(*(float(f"{getattr(constants, name):.3e}") for name in NAMES))


@dataclass(frozen=True)
class Times:
    """Seconds for one image, (n,) each: on all DPU cores, on one of them, and on one host core."""

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
        """The layers of all networks, concatenated."""
        parts = [row.layers for row in self.rows]
        return Layers(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(Layers)
            )
        )

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        return np.cumsum([0, *(len(row.layers.cores) for row in self.rows[:-1])])

    @cached_property
    def _host(self) -> Array:
        return np.stack([row.host for row in self.rows])

    @cached_property
    def families(self) -> NDArray[np.str_]:
        """The family of each case, (n,)."""
        return np.array([row.family for row in self.rows])

    @cached_property
    def host_cores(self) -> Array:
        """The number of cores of the board's processor, (n,)."""
        return np.array([row.host_cores for row in self.rows], float)

    @cached_property
    def observed(self) -> Array:
        """The mean ln(FPS) with several threads, (n,)."""
        return np.array([np.log(row.fps).mean() for row in self.rows])

    @cached_property
    def observed_single(self) -> Array:
        """The mean ln(FPS) with one thread, (n,), or NaN where no such rate is published."""
        return np.array(
            [np.log(row.fps_single).mean() if row.fps_single else np.nan for row in self.rows]
        )

    @cached_property
    def weights(self) -> Array:
        """The weights of the rates with several threads and with one, (2 n,).

        All cases of a network together count once.
        """
        counts = Counter(row.network for row in self.rows)
        weights = np.array([1 / counts[row.network] for row in self.rows])
        return np.concatenate([weights, ALONE * weights * ~np.isnan(self.observed_single)])

    def times(self, constants: Constants) -> Times:
        """Return the seconds of an image in each case."""
        handlers, cores = (
            of_layers[self._starts] for of_layers in (self.layers.handlers, self.layers.cores)
        )
        shared = self._core_s(constants, alone=False)
        alone = shared if cores.max() == 1 else self._core_s(constants, alone=True)
        host_s: Array = self._host @ constants.host_s_per_unit
        return Times(shared / (handlers * cores), alone / handlers, host_s)

    def _core_s(self, constants: Constants, *, alone: bool) -> Array:
        """Return the time of one batch on every core, or on one core alone, (n,)."""
        times = self.layers.time_s(constants, self.structure, alone=alone)
        return np.add.reduceat(times, self._starts)

    def shares(self, constants: Constants) -> Array:
        """Return the share of each of PARTS in the rate of each case, (n, 6)."""
        layers = self.layers
        parts_s = layers.parts_s(constants, self.structure)
        images = (layers.handlers * layers.cores)[self._starts]
        return shares_of(
            np.add.reduceat(parts_s, self._starts) / images[:, None],
            host_parts_s(self._host, constants) / self.host_cores[:, None],
            self.structure.contention_exponent,
        )

    def predicted(self, times: Times) -> Array:
        """Return ln(FPS) with several threads, (n,)."""
        dpu = np.log(times.dpu_s)
        host = np.log(times.host_s / self.host_cores)
        q = self.structure.contention_exponent
        return -np.logaddexp(q * dpu, q * host) / q

    def residuals(self, constants: Constants) -> Array:
        """Return ln(predicted / observed) with several threads and with one, (2 n,).

        It is 0 where nothing was observed.
        """
        times = self.times(constants)
        single = -np.log(times.alone_s + times.host_s) - self.observed_single
        return np.concatenate([self.predicted(times) - self.observed, np.nan_to_num(single)])

    def errors(self, constants: Constants) -> Array:
        """Return ln(predicted / observed) of FPS with several threads, (n,)."""
        return self.residuals(constants)[: len(self.rows)]

    def rate_errors(self, errors: Array) -> list[Array]:
        """Return ln(predicted / rate) of each case's rates with several threads.

        Args:
            errors: ln(predicted / observed) of the mean rates, (n,).
        """
        centres = errors + self.observed
        return [centre - np.log(row.fps) for centre, row in zip(centres, self.rows, strict=True)]

    def only(self, keep: Sequence[bool] | NDArray[np.bool_]) -> "Cases":
        """Return the cases where `keep` (n,) is True."""
        return Cases(
            tuple(row for row, selected in zip(self.rows, keep, strict=True) if selected),
            self.structure,
        )


def fit(cases: Cases, near: Constants | None = None) -> Constants:
    """Return the constants that fit the rates best. The fit begins at `near`, or around START."""
    # The nearest minimum need not be the lowest (see SHIFTS).
    begins = [logs_of(near)] if near else [logs_of(START) + shift for shift in SHIFTS]
    minima = [_descend(cases, logs) for logs in begins]
    return from_logs(min(minima, key=lambda end: end[1])[0])


def _descend(cases: Cases, logs: Array) -> tuple[Array, float]:
    """Return the minimum that damped steps reach, and its cost."""
    damping = 1e-3
    cost = _cost(cases, logs)
    normal, downhill = _slope(cases, logs)
    for _ in range(MAX_STEPS):
        there = logs + np.linalg.solve(normal + damping * np.diag(np.diag(normal)), downhill)
        # No array exceeds its peak, so the logarithm of the efficiency ends at 0.
        there[PEAK] = min(there[PEAK], 0.0)
        new = _cost(cases, there)
        if new >= cost:
            damping *= 4
            if damping > STUCK:
                break
            continue
        # Along a kink steps grow ever smaller, so a step that gains this little is the last.
        converged = cost - new < ENOUGH * cost and damping < 1
        logs = there
        cost = new
        damping = max(damping / 4, 1e-9)
        if converged:
            break
        normal, downhill = _slope(cases, logs)
    return logs, cost


def _cost(cases: Cases, logs: Array) -> float:
    # With the soft L1 loss a rate far off counts linearly.
    soft = 2 * (np.sqrt(1 + (cases.residuals(from_logs(logs)) / SOFT) ** 2) - 1)
    return float(cases.weights @ soft + np.sum(((logs - logs_of(START)) / DEVIATION) ** 2))


def _slope(cases: Cases, logs: Array) -> tuple[Array, Array]:
    """Return the normal matrix (11, 11) and minus half the gradient (11,)."""
    residuals = cases.residuals(from_logs(logs))
    stepped = [cases.residuals(from_logs(logs + STEP * unit)) for unit in np.eye(len(logs))]
    slopes = (np.stack(stepped, axis=1) - residuals[:, None]) / STEP
    weights = cases.weights / np.sqrt(1 + (residuals / SOFT) ** 2) / SOFT**2
    normal = slopes.T @ (weights[:, None] * slopes) + np.diag(1 / DEVIATION**2)
    return normal, -(slopes.T @ (weights * residuals) + (logs - logs_of(START)) / DEVIATION**2)
