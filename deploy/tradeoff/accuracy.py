"""How good the pictures of a method are: all on the same held-out pairs and targets, image by image.

What a halo below the exact one costs is measured on images cut in four, weighed by the seams of a swath.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Self

import numpy as np

from deploy.bench.tables import Swath
from deploy.cache import code_digest, pixels_digest
from deploy.restoration.engine import restore_dn
from deploy.restoration.plan import Plan, Span, plan_side
from deploy.restoration.runtime import Infer
from model.evaluation.methods import Method, Restore
from model.evaluation.pairs import NamedPair
from model.evaluation.scores import Instruments
from model.evaluation.targets import Targets, snr_name, target_figures
from model.io.images import MAX_DN
from profiles.figures import Figure
from quant.tiling.walk import Tiling

MAE = "float-INT8 MAE"
FLAT = "flat SNR"

Values = Mapping[str, float | None]
"""Scores of one image by name; None where the instrument is not there."""


@dataclass(frozen=True)
class Scores:
    """Scores of a variant: of each pair, in their order, and on targets."""

    images: tuple[Values, ...]
    targets: Mapping[str, Figure] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """What JSON can hold, for the cache."""
        targets = {key: vars(figure) for key, figure in self.targets.items()}
        return {"images": [dict(values) for values in self.images], "targets": targets}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Self:
        """Scores as `to_json` wrote them; raises KeyError, TypeError or ValueError on anything else."""
        targets = {
            k: Figure(**{**f, "interval": tuple(f["interval"] or ()) or None}) for k, f in stored["targets"].items()
        }
        return cls(tuple(dict(values) for values in stored["images"]), targets)


@dataclass(frozen=True)
class BenchmarkSet:
    """What all variants are judged on.

    Attributes:
        pairs: held-out pairs.
        targets: edges and flat fields acquired by the same sensor.
        instruments: what is measured.
        weights: digest of the weights that an instrument brings.
        seed: of the bootstrap.
    """

    pairs: Sequence[NamedPair]
    targets: Targets
    instruments: Instruments
    weights: str
    seed: int

    @cached_property
    def key(self) -> dict[str, object]:
        """Everything that scores depend on besides the variant."""
        pairs = pixels_digest(image for pair in self.pairs for image in (pair.degraded, pair.reference))
        names = [pair.name for pair in self.pairs]
        targets = pixels_digest([*self.targets.edges, *(flat for _, flat in self.targets.flats)])
        given = {"pairs": pairs, "names": names, "targets": targets, "weights": self.weights}
        return {**given, "max_dn": self.instruments.max_dn, "code": code_digest(__name__)}

    @property
    def sites(self) -> list[str]:
        """The site of each pair, in the order of the pairs."""
        return [pair.site for pair in self.pairs]


def measure(restore: Restore, benchmark: BenchmarkSet, tick: Callable[[], None]) -> Scores:
    """Scores on every pair and on the targets; `tick` is called once a pair and once for the targets."""
    images = measure_images(restore, benchmark, tick)
    found = target_figures(Method("", restore, ""), benchmark.targets)
    tick()
    dark = snr_name(benchmark.targets.flats[0][0])
    return Scores(images, {"MTF at Nyquist": found["MTF at Nyquist"], FLAT: found[dark]})


def measure_images(restore: Restore, benchmark: BenchmarkSet, tick: Callable[[], None]) -> tuple[Values, ...]:
    """Scores on every pair, in their order; `tick` is called once a pair."""
    images = []
    for pair in benchmark.pairs:
        values = benchmark.instruments.score(restore(pair.degraded), pair.reference, pair.degraded)
        images.append({key: value for key, value in values.items() if key != "PSNR gain"})
        tick()
    return tuple(images)


def measure_mae(
    restore: Restore, float_restore: Restore, benchmark: BenchmarkSet, tick: Callable[[], None]
) -> Scores:
    """Mean difference of INT8 from float on every pair, of full scale; both in whole digital numbers, as in files."""
    images = []
    for pair in benchmark.pairs:
        in_int8, in_float = (np.asarray(each(pair.degraded), np.float64) for each in (restore, float_restore))
        images.append({MAE: float(np.abs(in_int8 - in_float).mean()) / benchmark.instruments.max_dn})
        tick()
    return Scores(tuple(images))


LEAST_SQUARED_ERROR = 1e-12


def cut_in_four(infer: Infer, halo_px: int, max_dn: int = MAX_DN, lattice_px: int = 1) -> Restore:
    """Restores (H, W) digital numbers in four windows, each with so much of the others around it."""
    return partial(_restore, infer=infer, tiling=Tiling(halo_px, lattice_px), max_dn=max_dn)


def _restore(dn: np.ndarray, infer: Infer, tiling: Tiling, max_dn: int) -> np.ndarray:
    height_px, width_px = dn.shape
    rows, columns = (tuple(halves(size_px, tiling.halo_px, tiling.lattice_px)) for size_px in dn.shape)
    plan = Plan(1, height_px, width_px, max(dn.shape), tiling.halo_px, tiling, rows, columns)
    return restore_dn(dn, infer, plan, max_dn)


def halves(size_px: int, halo_px: int, lattice_px: int = 1) -> list[Span]:
    """Both halves of a side, cut at a multiple of `lattice_px` as the halo is one, each reading the halo beyond."""
    whole_px, cut = -(-size_px // lattice_px) * lattice_px, size_px // 2 // lattice_px * lattice_px
    return [Span(0, min(cut + halo_px, whole_px), 0, cut), Span(max(cut - halo_px, 0), whole_px, cut, size_px)]


def seam_density(swath: Swath) -> float:
    """Pixels of seam for each pixel of a swath in tiles."""
    sides = (swath.width_px, swath.height_px)
    return sum((len(plan_side(side, swath.tile_px, swath.halo_px)) - 1) / side for side in sides)


def with_seams(exact: Scores, cut: Scores, shapes: Sequence[tuple[int, ...]], density: float) -> Scores:
    """Scores of each image as if it had so many seam pixels for each of its own; targets show none."""
    shares = [density / sum(1 / side for side in shape) for shape in shapes]
    images = [_weighed(*each) for each in zip(exact.images, cut.images, shares, strict=True)]
    return Scores(tuple(images), exact.targets)


def _weighed(exact: Values, cut: Values, share: float) -> Values:
    return {key: _between(key, exact[key], cut[key], share) for key in exact}


def _between(key: str, exact: float | None, cut: float | None, share: float) -> float | None:
    if exact is None or cut is None:
        return None
    if key != "PSNR":
        return exact + share * (cut - exact)
    errors = [MAX_DN**2 * 10 ** (-psnr / 10) for psnr in (exact, cut)]
    error = max(errors[0] + share * (errors[1] - errors[0]), LEAST_SQUARED_ERROR)
    return float(10 * np.log10(MAX_DN**2 / error))
