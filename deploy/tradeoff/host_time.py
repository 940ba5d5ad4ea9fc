"""What a variant takes on this machine for one fixed tile, interleaved with all others."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np

from deploy.bench.profile import Call, interleaved
from model.evaluation.methods import Restore
from profiles.figures import Figure, measured

TILE_PX = 256
ROUNDS = 9
DRAWS, LEVEL = 1000, 0.95


@dataclass(frozen=True)
class Times:
    """What a variant took for one tile, round by round.

    Attributes:
        session: names the run whose rounds they were: variants of one session met the same machine.
        wall_s: on the clock.
        cpu_s: of all cores together.
        pixels: of the tile.
    """

    session: str
    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]
    pixels: int

    def to_json(self) -> dict[str, object]:
        """What JSON can hold, for the cache."""
        return dict(vars(self))

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """Times as `to_json` wrote them; raises KeyError, TypeError or ValueError on anything else."""
        wall_s, cpu_s = (tuple(float(t) for t in stored[key]) for key in ("wall_s", "cpu_s"))
        if not wall_s or len(wall_s) != len(cpu_s):
            raise ValueError("no rounds")
        return cls(str(stored["session"]), wall_s, cpu_s, int(stored["pixels"]))

    def per_megapixel(self, work_factor: float) -> np.ndarray:
        """(N,) seconds for a million pixels of an image that takes so many computed ones for each of its own."""
        return np.asarray(self.wall_s) * work_factor * 1e6 / self.pixels

    def cpu_per_px(self) -> tuple[float, float]:
        """Least and most CPU time for a pixel, in s."""
        return min(self.cpu_s) / self.pixels, max(self.cpu_s) / self.pixels


def time_variants(variants: Sequence[Restore], tile: np.ndarray, tick: Callable[[], None]) -> list[Times]:
    """Times of each variant on the same tile, ROUNDS of them interleaved after one run for warm-up.

    Args:
        variants: restore digital numbers (H, W) float32.
        tile: what they restore.
        tick: called once a round, and once after the warm-up.
    """
    for restore in variants:
        restore(tile)
    tick()

    def enough(found: Sequence[Sequence[tuple[float, float]]]) -> bool:
        tick()
        return len(found[0]) >= ROUNDS

    found = interleaved([partial(restore, tile) for restore in variants], _wall_and_cpu_s, enough)
    session = str(time.time_ns())
    return [Times(session, tuple(w for w, _ in taken), tuple(c for _, c in taken), tile.size) for taken in found]


def _wall_and_cpu_s(call: Call) -> tuple[float, float]:
    cpu, wall = time.process_time(), time.perf_counter()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def host_figures(times: Times, work_factor: float, runtime: str, seed: int) -> dict[str, Figure]:
    """Median and 90th percentile for a megapixel of the image, in s."""
    values = times.per_megapixel(work_factor)
    source = (
        f"{len(values)} runs of a tile of {TILE_PX} x {TILE_PX} on {runtime}, interleaved with the other points, "
        f"x {work_factor:.3g} pixels computed for each of the image's; 95 % bootstrap interval over rounds"
    )
    return {
        f"host p{share}": measured(
            float(np.percentile(values, share)), "s/Mpx", source, _interval(values[None], share, seed)
        )
        for share in (50, 90)
    }


def ratio_interval(a: np.ndarray, b: np.ndarray, paired: bool, seed: int) -> tuple[float, float]:
    """How many times as long `a` (N,) takes as `b` (M,), 95 %: medians, rounds drawn together if paired."""
    if paired:
        low, high = _interval((np.log(a) - np.log(b))[None], 50, seed)
        return float(np.exp(low)), float(np.exp(high))
    (a_low, a_high), (b_low, b_high) = (_interval(times[None], 50, seed) for times in (a, b))
    return a_low / b_high, a_high / b_low


def _interval(values: np.ndarray, share: float, seed: int) -> tuple[float, float]:
    """Percentile interval of a percentile of (1, N) values."""
    count = values.shape[1]
    drawn = np.random.default_rng(seed).integers(count, size=(DRAWS, count))
    found = np.percentile(values[0][drawn], share, axis=1)
    low, high = np.percentile(found, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return float(low), float(high)
