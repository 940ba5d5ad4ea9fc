"""What is measured of each variant, once, on the same images; kept in one JSON file from one run to
the next.

A measurement is kept under the SHA-256 of what it depends on: the inputs and the version of this
tool.
"""

import hashlib
import json
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from beers_deploy import __version__
from beers_deploy.model.consistency import Consistency
from beers_deploy.model.io.files import sha256, write_text
from beers_deploy.model.metrics.perceptual import find_backbone
from beers_deploy.model.processor import processor_name
from beers_deploy.model.raster.images import list_images
from beers_deploy.network import Network
from beers_deploy.performance.swath import Swath
from beers_deploy.performance.timing import interleaved
from beers_deploy.performance.traditional import drawn_acquisition
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, measured
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import load_sensor, sensor_names
from beers_deploy.quant.calibration import Calibration
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.quant.quantise import quantise_model
from beers_deploy.restoration.method import Restore
from beers_deploy.restoration.plan import Plan, make_plan
from beers_deploy.restoration.runtime import AtFirstCall, open_runtime
from beers_deploy.restoration.tiles.exposures import ExposedNetwork, tiles_by_factor
from beers_deploy.restoration.tiles.rows import restore_dn
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.scores import DETAILS, Instruments, perceptual_distances
from beers_deploy.studies.tradeoff.points import (
    HALO_STEP_PX,
    Point,
    Variant,
    network_of_variant,
)

Scores = Mapping[str, float | None]
"""Figures of one image by name; None where an instrument is not there."""

LPIPS = "LPIPS-squeeze"
SEAM_ERROR = "seam error"
NOT_SHOWN = (*DETAILS, SEAM_ERROR)
"""Of the scores of an image, in the means of a point."""


def key_of(**about: object) -> str:
    """SHA-256 of what a measurement depends on, this tool's version among it."""
    # Keys are sorted, so that the order of arguments does not change the digest.
    text = json.dumps({"version": __version__, **about}, sort_keys=True, default=_as_text)
    return hashlib.sha256(text.encode()).hexdigest()


def _as_text(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    return str(value)


@dataclass
class Measurements:
    """Measurements of a study in one file, written anew after each: a run that was stopped goes on.

    Attributes:
        path: of the file.
        kept: by key.
    """

    path: Path
    kept: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> "Measurements":
        """Those of a file, or none yet."""
        if not path.exists():
            return cls(path)
        try:
            return cls(path, dict(json.loads(path.read_text(encoding="utf-8"))["measurements"]))
        except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
            raise OptionError(
                f"{path} does not hold measurements that this command stored. Remove the file, "
                "and they are measured again."
            ) from error

    def make(self, key: str, measure: Callable[[], Any]) -> Any:
        """What was measured under a key; measured now, and written, where there is nothing."""
        if key not in self.kept:
            # Written after each measurement, so that a run that was stopped goes on.
            self.kept[key] = measure()
            write_text(
                self.path, json.dumps({"version": __version__, "measurements": self.kept}) + "\n"
            )
        return self.kept[key]


@dataclass(frozen=True)
class Benchmark:
    """What all variants are measured on.

    Attributes:
        pairs: held-out images, degraded and reference.
        degraded: sensor of the degraded images.
        reference: sensor of the reference images.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones; None asks the environment.
        seed: of the bootstrap.
    """

    pairs: Sequence[NamedPair]
    degraded: Sensor
    reference: Sensor
    lpips: Path | None
    seed: int

    @cached_property
    def instruments(self) -> Instruments:
        """PSNR, SSIM and LPIPS."""
        return Instruments(
            {LPIPS: perceptual_distances(self.lpips)[LPIPS]}, self.degraded.nominal().max_dn
        )

    @cached_property
    def digest(self) -> str:
        """Of everything that scores depend on besides the method."""
        pairs = [(pair.name, pair.site, pair.degraded, pair.reference) for pair in self.pairs]
        weights = find_backbone("squeeze", self.lpips)
        return key_of(pairs=pairs, weights=weights and sha256(weights))

    @property
    def sites(self) -> list[str]:
        """The site of each pair."""
        return [pair.site for pair in self.pairs]

    def depends(self, variant: Variant) -> str:
        """Digest of what a variant's pictures depend on."""
        if variant.network is not None:
            sensors = self.degraded, self.reference
            networks = (variant.network, *variant.network.exposures.values())
            return key_of(files=[network.sha256 for network in networks], sensors=sensors)
        return key_of(method=variant.method, sensors=[self.degraded, self.reference])

    def scores(
        self, point: Point, exact: Restore, kept: Measurements
    ) -> list[dict[str, float | None]]:
        """Scores of each image: those of the variant, or with seams where the halo is too small for
        exact ones.
        """
        about: dict[str, object] = {"scores": self.depends(point.variant), "images": self.digest}
        if point.halo_px is None:
            return list(kept.make(key_of(**about), lambda: self.score(exact)))
        # The images may be smaller than the tile. Then points with other tiles, as of another
        # board, share a score.
        cuts = sorted({tiles_of_point(point, pair.degraded.shape).tile_px for pair in self.pairs})
        about |= {"tile_px": cuts, "halo_px": point.halo_px}
        return list(kept.make(key_of(**about), lambda: self._with_seams(point, exact)))

    def _with_seams(self, point: Point, exact: Restore) -> list[dict[str, float | None]]:
        return self.score(restore_in_tiles(point, self.degraded, self.reference), exact)

    def runs(self, point: Point) -> float:
        """How often the network of a point runs on a tile of the images, once for each exposure; a
        mean.
        """
        network = point.variant.network
        if network is None or not network.exposures:
            return 1.0
        sensor = self.degraded.nominal()
        factors = (1, *network.exposures)
        tiles = 0
        runs = 0
        for pair in self.pairs:
            plan = tiles_of_point(point, pair.degraded.shape)
            # A tile runs once for each exposure that its pixels ask for.
            counts = tiles_by_factor(pair.degraded, plan, factors, sensor.max_dn, sensor.offset_dn)
            tiles += plan.tiles
            runs += sum(counts.values())
        return runs / tiles

    def score(
        self, restore: Restore, exact: Restore | None = None
    ) -> list[dict[str, float | None]]:
        """Scores of every pair; and how far, in DN, a restoration with seams is from the exact one
        given.
        """
        scores = []
        for pair in self.pairs:
            image = restore(pair.degraded)
            scores.append(self.instruments.score(image, pair))
            if exact is not None:
                error = np.abs(np.asarray(image, np.float64) - exact(pair.degraded)).mean()
                scores[-1][SEAM_ERROR] = float(error)
        return scores

    def means(self, images: Sequence[Scores]) -> dict[str, Figure]:
        """Means over the images, with bootstrap intervals over whole sites."""
        plain = [
            {key: value for key, value in image.items() if key not in NOT_SHOWN} for image in images
        ]
        figures = self.instruments.means(plain, self.sites, self.seed)
        if SEAM_ERROR in images[0]:
            errors = [image[SEAM_ERROR] or 0.0 for image in images]
            source = f"mean difference from exact seams, {len(errors)} images in these tiles"
            figures[SEAM_ERROR] = measured(float(np.mean(errors)), "DN", source)
        return figures


def restore_in_tiles(point: Point, degraded: Sensor, reference: Sensor) -> Restore:
    """A network in a point's tiles, with the steps around it that `restore` takes."""
    source = network_of_variant(point.variant)
    sensor = degraded.nominal()
    infer, _ = open_runtime("onnxruntime", source.model, threads=0)
    others = {
        factor: AtFirstCall(partial(open_runtime, "onnxruntime", other.model, 0))
        for factor, other in source.exposures.items()
    }
    network = ExposedNetwork({1: infer, **others}, source.tiling.halo_px, sensor.offset_dn)
    steps = (Consistency.of(sensor, reference.nominal().in_units_of(sensor), sensor.max_dn),)

    def restore(dn: np.ndarray) -> np.ndarray:
        return restore_dn(dn, network, tiles_of_point(point, dn.shape), sensor.max_dn, steps)

    return restore


def tiles_of_point(point: Point, shape: tuple[int, ...]) -> Plan:
    """The tiles of a point on an image (H, W); one that is no larger than a tile is cut in two
    along each side.
    """
    tiling = network_of_variant(point.variant).tiling
    halo_px = tiling.halo_px if point.halo_px is None else point.halo_px
    # Half of the shorter side, rounded up to the halo's step: an image in one tile has no seam.
    half_px = HALO_STEP_PX * -(-(min(shape) // 2) // HALO_STEP_PX) + 2 * halo_px
    return make_plan((1, *shape), min(point.tile_px, half_px), halo_px, tiling)


TILE_PX = 256
ROUNDS = 9


def measure_host(
    methods: Mapping[Variant, Method], benchmark: Benchmark, kept: Measurements
) -> dict[Variant, dict[str, Figure]]:
    """What each variant takes on this machine, all timed together on a drawn scene as the sensor
    sees it.
    """
    tile = drawn_acquisition(
        Swath(TILE_PX, TILE_PX), benchmark.degraded, benchmark.reference, benchmark.seed
    )
    names = [benchmark.depends(variant) for variant in methods]
    machine = (
        f"{platform.machine()} {processor_name() or platform.processor()} x {psutil.cpu_count()}"
    )
    # Times are kept for this machine alone: on another one they are measured again.
    key = key_of(times=names, tile=tile, machine=machine)
    times = kept.make(
        key, lambda: host_times([method.restore for method in methods.values()], tile)
    )
    return {
        variant: host_figures(times_s, tile.size)
        for variant, times_s in zip(methods, times, strict=True)
    }


def host_times(restores: Iterable[Restore], tile: np.ndarray) -> list[list[float]]:
    """Seconds that each method takes for a tile on this machine, interleaved, after one run for
    warm-up.
    """
    calls = [partial(restore, tile) for restore in restores]
    for call in calls:
        call()
    return [[time_s for time_s, _ in samples] for samples in interleaved(calls, ROUNDS)]


def host_figures(times_s: Sequence[float], pixels: int) -> dict[str, Figure]:
    """Median and 90th percentile for a million pixels, in s."""
    source = (
        f"{len(times_s)} runs of a tile of {TILE_PX} x {TILE_PX}, interleaved with the "
        "other methods"
    )
    values = np.asarray(times_s) * 1e6 / pixels
    return {
        f"host p{p}": measured(float(np.percentile(values, p)), "s/Mpx", source) for p in (50, 90)
    }


PATCHES = 32
PATCH_PX = 96
"""Calibration of a network that comes without INT8: fewer and smaller patches than `quantize`
takes.
"""


def make_int8(
    network: Network, folder: Path, scenes: Path | None, sensor: Sensor, seed: int
) -> Network:
    """Quantise a float network on simulated patches as `quantize` does, and keep the file.

    Args:
        network: in float32.
        folder: where the INT8 file is kept.
        scenes: folder of images to calibrate on; drawn ones if None.
        sensor: of the patches, where the network names none that is known.
        seed: of every random draw.
    """
    named = network.sensor
    calibration_sensor = load_sensor(named) if named in sensor_names() else sensor
    scene_digests = [sha256(path) for path in list_images(scenes)] if scenes else []
    key = key_of(
        network=network.sha256,
        scenes=scene_digests,
        sensor=calibration_sensor,
        seed=seed,
        size=[PATCHES, PATCH_PX],
    )
    path = folder / f"{network.name}-int8-{key[:16]}.onnx"
    if not path.is_file():
        patches = Calibration(calibration_sensor, scenes, PATCHES, PATCH_PX, seed)
        save_onnx(quantise_model(network.model, patches.drawn, patches.about).host, path)
    return Network.load(path)
