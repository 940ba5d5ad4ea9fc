"""Measure each variant once on the same images, and the effect of tile size and halo."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from beers_deploy.network import Network
from beers_deploy.performance.swath import Swath
from beers_deploy.performance.timing import interleaved
from beers_deploy.performance.traditional import drawn_acquisition
from beers_deploy.profiles.figures import Figure, measured
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import sensor_names
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.samples.simulated import Calibration
from beers_deploy.restoration.method import Restore, network_restore
from beers_deploy.restoration.plan import Plan, make_plan
from beers_deploy.restoration.steps import BOTH
from beers_deploy.restoration.tiles.exposures import tiles_by_factor
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.scores import DETAILS, Instruments, perceptual_distances
from beers_deploy.studies.tradeoff.points import (
    HALO_STEP_PX,
    Point,
    Variant,
    network_of_variant,
)

Scores = dict[str, float | None]
"""Figures of one image by name; None if the metric is unavailable."""

LPIPS = "LPIPS-squeeze"
SEAM_ERROR = "seam error"
NOT_SHOWN = (*DETAILS, SEAM_ERROR)
"""Scores of an image that are left out of the means of a point."""


@dataclass(frozen=True)
class Benchmark:
    """The images and metrics with which all methods of a study are measured.

    Attributes:
        pairs: pairs of a degraded and a reference image that no network was trained on.
        degraded: the sensor of the degraded images.
        reference: the sensor of the reference images.
        lpips: the file with the weights of SqueezeNet 1.1 for LPIPS, or a folder of such files;
            None reads the path from the environment.
        seed: the seed of the bootstrap over sites, which gives the intervals.
    """

    pairs: Sequence[NamedPair]
    degraded: Sensor
    reference: Sensor
    lpips: Path | None
    seed: int

    @cached_property
    def instruments(self) -> Instruments:
        """The metrics: PSNR, SSIM and LPIPS; loaded at the first use."""
        return Instruments(
            {LPIPS: perceptual_distances(self.lpips)[LPIPS]}, self.degraded.nominal().max_dn
        )

    @property
    def sites(self) -> list[str]:
        """The site of each pair, in their order; images of one site resemble one another."""
        return [pair.site for pair in self.pairs]

    def cuts(self, point: Point) -> tuple[int, ...]:
        """Return how an operating point cuts the images, so that points which restore the same
        pixels are scored once.

        Args:
            point: the operating point.

        Returns:
            The different sides of its tiles in pixels, in ascending order; empty if its halo is
            exact, because tiles of any size then give the same pixels.
        """
        if point.halo_px is None:
            return ()
        shapes = [pair.degraded.shape for pair in self.pairs]
        return tuple(sorted({tiles_of_point(point, shape).tile_px for shape in shapes}))

    def scores(self, point: Point, exact: Restore) -> list[Scores]:
        """Restore all images as an operating point does, and score them.

        Args:
            point: the operating point.
            exact: the point's method without seams between tiles, a function from degraded to
                restored digital numbers (H, W).

        Returns:
            The scores of each image. If the point's halo leaves seams, the images are restored in
            its tiles, and their mean difference from `exact` is a score too.
        """
        if point.halo_px is None:
            return self.score(exact)
        network = network_of_variant(point.variant)
        tiles = partial(tiles_of_point, point)
        in_tiles = network_restore(network, self.degraded, self.reference.nominal(), BOTH, tiles)
        return self.score(in_tiles, exact)

    def runs(self, point: Point) -> float:
        """Return how often the network of an operating point runs on a tile, as the mean over the
        tiles of the images.

        A tile needs one run for each exposure: dark parts are multiplied by a factor before the
        network. The number is 1 without a network or without exposures, and the same for all halos.
        """
        network = point.variant.network
        if network is None or not network.exposures:
            return 1.0
        sensor = self.degraded.nominal()
        factors = (1, *network.exposures)
        tiles = 0
        runs = 0
        for pair in self.pairs:
            # With its own cut of these small images a point of a smaller halo may count more runs,
            # and seem slower than the exact one.
            plan = tiles_of_point(replace(point, halo_px=None), pair.degraded.shape)
            # A tile runs once for each exposure that its pixels ask for.
            counts = tiles_by_factor(pair.degraded, plan, factors, sensor.max_dn, sensor.offset_dn)
            tiles += plan.tiles
            runs += sum(counts.values())
        return runs / tiles

    def score(self, restore: Restore, exact: Restore | None = None) -> list[Scores]:
        """Restore the degraded image of every pair, and score it.

        Args:
            restore: the method, a function from degraded to restored digital numbers (H, W).
            exact: the same method without seams between tiles; None for no comparison with it.

        Returns:
            The scores of each image by name. With `exact`, 'seam error' is the mean absolute
            difference from it in digital numbers.
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
        """Average scores over the images, with bootstrap intervals over whole sites.

        Args:
            images: the scores of each image, as `score` returns them.

        Returns:
            The means by name, without scores that only add detail, and the mean seam error.
        """
        plain = [
            {key: value for key, value in image.items() if key not in NOT_SHOWN} for image in images
        ]
        figures = self.instruments.means(plain, self.sites, self.seed)
        if SEAM_ERROR in images[0]:
            errors = [image[SEAM_ERROR] or 0.0 for image in images]
            source = f"mean difference from exact seams, {len(errors)} images in these tiles"
            figures[SEAM_ERROR] = measured(float(np.mean(errors)), "DN", source)
        return figures


def tiles_of_point(point: Point, shape: tuple[int, ...]) -> Plan:
    """Plan the tiles in which an operating point restores an image.

    Tiles are at most half of the image's shorter side plus two halos. An image of more than about
    four halos a side is therefore cut at least once along each side, because an image in one tile
    would show no seam.

    Args:
        point: an operating point of a network.
        shape: the shape of the image, (H, W).
    """
    tiling = network_of_variant(point.variant).tiling
    halo_px = tiling.halo_px if point.halo_px is None else point.halo_px
    # Half of the shorter side, rounded up to the halo's step: an image in one tile has no seam.
    half_px = up_to_multiple(min(shape) // 2, HALO_STEP_PX) + 2 * halo_px
    return make_plan((1, *shape), min(point.tile_px, half_px), halo_px, tiling)


TILE_PX = 256
ROUNDS = 9


def measure_host(
    methods: Mapping[Variant, Method], benchmark: Benchmark
) -> dict[Variant, dict[str, Figure]]:
    """Measure the time that each method needs on this machine, on one tile of a drawn scene as the
    sensor acquires it. All methods are timed in turn, so that they share the machine's state.

    Args:
        methods: the method of each variant (a method in one precision).
        benchmark: states the sensors and the seed.

    Returns:
        For each variant the figures that `host_figures` returns.
    """
    tile = drawn_acquisition(
        Swath(TILE_PX, TILE_PX), benchmark.degraded, benchmark.reference, benchmark.seed
    )
    times = host_times([method.restore for method in methods.values()], tile)
    figures = (host_figures(times_s, tile.size) for times_s in times)
    return dict(zip(methods, figures, strict=True))


def host_times(restores: Iterable[Restore], tile: np.ndarray) -> list[list[float]]:
    """Time methods on one tile on this machine, after a warm-up round.

    Args:
        restores: functions from degraded to restored digital numbers (H, W).
        tile: digital numbers (H, W).

    Returns:
        For each method the seconds of `ROUNDS` runs. In each round every method runs once.
    """
    calls = [partial(restore, tile) for restore in restores]
    rounds = interleaved(calls, 1 + ROUNDS)
    return [[time_s for time_s, _ in samples[1:]] for samples in rounds]


def host_figures(times_s: Sequence[float], pixels: int) -> dict[str, Figure]:
    """Return the figures of a method's time on this machine, 'host p50' and 'host p90'.

    They are the median and the 90th percentile of the seconds for a million pixels.

    Args:
        times_s: the seconds of each run on a tile.
        pixels: the number of pixels of the tile.
    """
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
"""Calibration of a network without INT8 file: fewer and smaller patches than `quantize` uses."""


def make_int8(network: Network, scenes: Path | None, sensor: Sensor, seed: int) -> Network:
    """Quantise a float network as `quantize` does, on fewer and smaller simulated patches.

    Args:
        network: the network in float32.
        scenes: the folder of images that the patches are simulated from; None draws scenes.
        sensor: the sensor of the patches, if the network states no shipped sensor.
        seed: the seed of every random draw.

    Returns:
        The INT8 network in memory, named NETWORK-int8.

    Raises:
        ModelError: the network cannot be quantised.
    """
    named = network.sensor
    calibration_sensor = Sensor.load(named) if named in sensor_names() else sensor
    patches = Calibration(calibration_sensor, scenes, PATCHES, PATCH_PX, seed)
    result = quantize_model(network.model, patches.drawn, patches.about)
    return Network(result.host, f"{network.name}-int8")
