"""Fit the constants of the cost model to rates that somebody measured.

Least squares on ln(FPS) with a soft L1 loss (a row far off counts linearly), by damped Gauss-Newton on the logarithms
of the six constants. `prior` pulls each logarithm to its start: next to nothing for the published rows, firmly where
an owner has a few rows of his own.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deploy.dpu.cost.latency import Profile
from deploy.dpu.cost.layers import Array, Constants, Layers, host_s

START = Constants(0.6, 40e9, 1e-4, 5e-6, 0.8e9, 0.5e9)
"""Where the fit begins: the right orders of magnitude."""

SOFT = 0.1
"""Residual in ln(FPS) from where a row counts linearly."""

WEAK_PRIOR, FIRM_PRIOR = 1 / 10, 1 / 0.3
"""1 / spread of a constant's logarithm around its start."""


@dataclass(frozen=True)
class Case:
    """A network on a configuration with its rate; the bytes of one image that the host writes and reads."""

    network: str
    family: str
    configuration: str
    layers: Layers
    batch: int
    host_bytes: tuple[int, int]
    fps: float
    profile: Profile


@dataclass(frozen=True)
class Cases:
    """Several cases, stacked for speed; `serial` is the target's."""

    rows: tuple[Case, ...]
    serial: float

    @cached_property
    def _stacked(self) -> tuple[Layers, NDArray[np.int64], Array, Array, Array]:
        sizes = [len(row.layers.batch) for row in self.rows]
        taken, read = (np.array([row.host_bytes[end] for row in self.rows], float) for end in (0, 1))
        batches = np.array([row.batch for row in self.rows], float)
        return Layers.join([row.layers for row in self.rows]), np.cumsum([0, *sizes[:-1]]), batches, taken, read

    @cached_property
    def observed(self) -> Array:
        """ln(FPS), (n,)."""
        logs: Array = np.log(np.array([row.fps for row in self.rows]))
        return logs

    def dpu_s(self, constants: Constants) -> Array:
        """Time of the DPU for one image, (n,)."""
        layers, starts, batches, *_ = self._stacked
        batch_s: Array = np.add.reduceat(layers.time_s(constants, self.serial), starts) + constants.batch_s
        return batch_s / batches

    def host_s(self, constants: Constants) -> Array:
        """Time of the host for one image, (n,)."""
        *_, taken, read = self._stacked
        return host_s(taken, read, constants)

    def predicted(self, constants: Constants) -> Array:
        """ln(FPS), (n,)."""
        slower: Array = np.maximum(self.dpu_s(constants), self.host_s(constants))
        return -np.log(slower)

    def errors(self, constants: Constants) -> Array:
        """ln(predicted / observed), (n,)."""
        return self.predicted(constants) - self.observed

    def only(self, keep: NDArray[np.bool_]) -> "Cases":
        """The rows where `keep` (n,) is true."""
        return Cases(tuple(row for row, kept in zip(self.rows, keep, strict=True) if kept), self.serial)


def fit(cases: Cases, start: Constants = START, prior: float = WEAK_PRIOR) -> Constants:
    """The constants that come nearest to the rates.

    Args:
        cases: what was observed.
        start: where to begin, and what `prior` pulls to.
        prior: 1 / spread of a constant's logarithm around its start; a row's spread is SOFT.
    """
    anchor = start.logs
    logs, damping = anchor.copy(), 1e-3
    cost = _cost(cases, logs, anchor, prior)
    for _ in range(200):
        step = _step(cases, logs, anchor, prior, damping)
        new = _cost(cases, logs + step, anchor, prior)
        if new >= cost:
            damping *= 4
            if damping > 1e8:
                break
            continue
        done = cost - new < 1e-13 * cost
        logs, cost, damping = logs + step, new, max(damping / 4, 1e-9)
        if done:
            break
    return Constants.from_logs(logs)


def _cost(cases: Cases, logs: Array, anchor: Array, prior: float) -> float:
    soft = np.sqrt(1 + (cases.errors(Constants.from_logs(logs)) / SOFT) ** 2) - 1
    return float(2 * soft.sum() + ((logs - anchor) * prior) @ ((logs - anchor) * prior))


def _step(cases: Cases, logs: Array, anchor: Array, prior: float, damping: float) -> Array:
    errors = cases.errors(Constants.from_logs(logs))
    moved = logs + 1e-5 * np.eye(len(logs))
    slopes = np.stack([(cases.errors(Constants.from_logs(m)) - errors) / 1e-5 for m in moved], axis=1) / SOFT
    weights = 1 / np.sqrt(1 + (errors / SOFT) ** 2)
    normal = slopes.T @ (weights[:, None] * slopes) + prior**2 * np.eye(len(logs))
    pull = slopes.T @ (weights * errors / SOFT) + prior**2 * (logs - anchor)
    return np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -pull))
