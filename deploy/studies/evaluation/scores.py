"""Figures of one method: scores on pairs, by image and their mean, and MTF and SNR on targets whose truth is known.

Targets are slanted edges and flat fields, acquired by the degraded sensor as scenes are, restored by the method, and
measured as if found in an image. The MTF is that of edges of a step of 160 W/m2/sr/um; a method that adapts to its
input may treat fine texture otherwise. The noise in flat fields is what is left where nothing is to be seen.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import torch
from scipy.special import stdtrit

from beers_deploy.model.metrics.bootstrap import site_interval
from beers_deploy.model.metrics.fidelity import fidelity_db, ssim
from beers_deploy.model.metrics.perceptual import Dists, Lpips, find_backbone, not_found
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.model.metrics.slanted_edge import edge_mtf, slanted_edge
from beers_deploy.model.progress import steps
from beers_deploy.model.simulator.acquire import acquire
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.sampling import scene_spectrum
from beers_deploy.profiles.figures import Figure, Row, measured, published, unavailable
from beers_deploy.profiles.sensor import MAX_DN, Instrument
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair

Perceptual = Callable[[np.ndarray, np.ndarray], float]
"""Distance of two images (H, W) in [0, 1] of full scale."""


def perceptual_distances(place: Path | None) -> dict[str, Perceptual | str]:
    """LPIPS-squeeze or the reason why not, and LPIPS-vgg and DISTS where VGG16 is found.

    Args:
        place: a file with SqueezeNet 1.1, or a folder with any of the backbones; None asks the environment.
    """
    found: dict[str, Perceptual | str] = {"LPIPS-squeeze": not_found("squeeze")}
    networks = ("squeeze", "vgg") if place is None or place.is_dir() else ("squeeze",)
    for network in networks:
        if file := find_backbone(network, place):
            found[f"LPIPS-{network}"] = partial(_distance, Lpips.load(network, file))
            if network == "vgg":
                found["DISTS"] = partial(_distance, Dists.load(file))
    return found


def _distance(metric: Lpips | Dists, image: np.ndarray, reference: np.ndarray) -> float:
    both = [torch.from_numpy(np.asarray(a, np.float32))[None, None] for a in (image, reference)]
    with torch.inference_mode():
        return float(metric(*both))


DISTANCE = "distance"
NOISE_FREE = "PSNR, reference without noise"
UNITS = {"PSNR": "dB", "PSNR gain": "dB", NOISE_FREE: "dB", "SSIM": "ratio"}
READ = "pairs read from files hold no reference without noise"
IDENTICAL = "infinite: identical to the reference"


@dataclass(frozen=True)
class Instruments:
    """What images are measured with.

    Attributes:
        perceptual: distances by name besides PSNR and SSIM, each or the reason why not.
        max_dn: the digital number that is full scale.
    """

    perceptual: Mapping[str, Perceptual | str]
    max_dn: int = MAX_DN

    def score(self, dn: np.ndarray, pair: NamedPair) -> dict[str, float | None]:
        """The figures of one restored image of a pair, (H, W) digital numbers."""
        clean, unclipped = pair.noise_free, (pair.degraded, self.max_dn)
        psnr, before = (fidelity_db(image, pair.reference, *unclipped) for image in (dn, pair.degraded))
        scores: dict[str, float | None] = {"PSNR": psnr}
        scores[NOISE_FREE] = None if clean is None else fidelity_db(dn, clean, *unclipped)
        scores["PSNR gain"] = psnr - before if psnr != before else 0.0
        scores["SSIM"] = ssim(dn, pair.reference, self.max_dn)
        for name, distance in self.perceptual.items():
            both = dn / self.max_dn, pair.reference / self.max_dn
            scores[name] = None if isinstance(distance, str) else distance(*both)
        return scores

    def figure(
        self, key: str, value: float | None, source: str, interval: tuple[float, float] | None = None
    ) -> Figure:
        """A score as a figure; unavailable with the reason where there is none."""
        unit = UNITS.get(key, DISTANCE)
        if value is None:
            return unavailable(unit, READ if key == NOISE_FREE else str(self.perceptual[key]))
        return measured(value, unit, source, interval) if np.isfinite(value) else unavailable(unit, IDENTICAL)

    def means(
        self, scores: Sequence[Mapping[str, float | None]], sites: Sequence[str], seed: int
    ) -> dict[str, Figure]:
        """The mean of each score over the images that have it, with the bootstrap interval over their sites."""
        figures = {}
        for key, first in scores[0].items():
            both = ((each[key], site) for each, site in zip(scores, sites, strict=True))
            usable = [(value, site) for value, site in both if value is not None and np.isfinite(value)]
            if not usable:
                figures[key] = self.figure(key, first, "")
                continue
            values, places = zip(*usable, strict=True)
            interval, words = site_interval(values, places, np.random.default_rng(seed))
            source = f"mean of {len(values)} pairs from {len(set(places))} sites, {words}"
            figures[key] = self.figure(key, float(np.mean(values)), source, interval)
        return figures


def score(method: Method, pairs: Sequence[NamedPair], instruments: Instruments, seed: int) -> list[Row]:
    """The mean row of a method, then one row an image."""
    rows, scores = [], []
    with steps(method.name, len(pairs)) as bar:
        for pair in pairs:
            values = instruments.score(method.restore(pair.degraded), pair)
            figures = {key: instruments.figure(key, value, "one pair") for key, value in values.items()}
            rows.append(Row("images", f"{method.name}: {pair.name}", figures, {"site": pair.site}))
            scores.append(values)
            bar.advance()
    means = instruments.means(scores, [pair.site for pair in pairs], seed)
    return [Row("mean", method.name, means, {"sensor": method.sensor_known}), *rows]


def site_rows(rows: Sequence[Row]) -> list[Row]:
    """PSNR, SSIM and what other scores there are, by site: a row a site, a column a method."""
    images = [row for row in rows if row.table == "images"]
    keys = [key for key in images[0].figures if key != "PSNR gain" and any(row.figures[key].value for row in images)]
    sites = dict.fromkeys(row.text["site"] for row in images)
    by_site = {site: [row for row in images if row.text["site"] == site] for site in sites}
    return [_site_row(key, site, here) for key in keys for site, here in by_site.items()]


def _site_row(key: str, site: str, images: Sequence[Row]) -> Row:
    figures: dict[str, Figure] = {}
    for method in dict.fromkeys(row.name.split(": ")[0] for row in images):
        here = [row.figures[key] for row in images if row.name.startswith(f"{method}: ")]
        values = [figure.value for figure in here if figure.value is not None]
        source = f"mean {key} of {len(values)} pairs"
        figures[method] = measured(float(np.mean(values)), here[0].unit, source) if values else here[0]
    return Row(f"{key} by site", site, figures, {"images": str(len(here))})


ANGLES_DEG = (3.0, 5.0, 8.0, 11.0)
REPEATS = 3
OVERSAMPLING, SIDE_PX, EDGE_PX, FLAT_PX = 5, 240, 80, 128
RADIANCES = (25.0, 100.0)
"""Of the flat fields, W/m2/sr/um."""


@dataclass(frozen=True)
class Targets:
    """Acquired targets, (H, W) digital numbers.

    Attributes:
        sensor: that acquired them.
        edges: angle in degrees, and the edge; each with independent noise.
        flats: radiance in W/m2/sr/um, and the field.
    """

    sensor: Instrument
    edges: Sequence[tuple[float, np.ndarray]]
    flats: Sequence[tuple[float, np.ndarray]]


def acquire_targets(sensor: Instrument, seed: int) -> Targets:
    """Edges at several angles with independent noise, and flat fields at 25 and 100 W/m2/sr/um."""
    draws = (Draw(seed, number) for number in count())
    scenes = [(angle, slanted_edge(SIDE_PX, OVERSAMPLING, angle)) for angle in ANGLES_DEG * REPEATS]
    edges = [(angle, _acquire(scene, sensor, next(draws))) for angle, scene in scenes]
    fields = [(radiance, np.full((FLAT_PX, FLAT_PX), radiance, np.float32)) for radiance in RADIANCES]
    return Targets(sensor, edges, [(at, _acquire(field, sensor, next(draws), ratio=1)) for at, field in fields])


def _acquire(scene: np.ndarray, sensor: Instrument, draw: Draw, ratio: int = OVERSAMPLING) -> np.ndarray:
    return acquire(scene_spectrum(scene), scene.shape[1], sensor, ratio, draw, "degraded", margin_px=0)


def snr_name(radiance: float) -> str:
    """The name of the SNR in a flat field of a radiance in W/m2/sr/um."""
    return f"SNR at {radiance:g} W/m2/sr/um"


def target_figures(method: Method, targets: Targets) -> dict[str, Figure]:
    """MTF at Nyquist in %, and SNR in flat fields, of what the method makes of the targets."""
    figures = {"MTF at Nyquist": restored_mtf(method, targets)}
    for radiance, flat in targets.flats:
        figures[snr_name(radiance)] = flat_figure(_middle(method.restore(flat)) - targets.sensor.offset_dn)
    return figures


def restored_mtf(method: Method, targets: Targets) -> Figure:
    """MTF at Nyquist in % of the edges that the method restored."""
    max_dn = targets.sensor.max_dn
    return mtf_figure([edge_mtf(_middle(method.restore(edge)), angle, max_dn) for angle, edge in targets.edges])


def _middle(image: np.ndarray) -> np.ndarray:
    top, left = ((side - EDGE_PX) // 2 for side in image.shape)
    return image[top : top + EDGE_PX, left : left + EDGE_PX]


def mtf_figure(found: Sequence[float | Refusal]) -> Figure:
    """The mean over the edges with its 90 % interval; unavailable where most edges were refused."""
    values = [100 * each for each in found if not isinstance(each, Refusal)]
    refused = [each for each in found if isinstance(each, Refusal)]
    if len(values) < max(len(refused), 2):
        return unavailable("%", f"{len(refused)} of {len(found)} edges refused: {refused[0].reason}")
    reach = float(stdtrit(len(values) - 1, 0.95)) * float(np.std(values, ddof=1)) / len(values) ** 0.5
    mean = float(np.mean(values))
    source = f"{len(values)} of {len(found)} simulated slanted edges, 90 % interval of the mean"
    return measured(mean, "%", source, (mean - reach, mean + reach))


def flat_figure(flat: np.ndarray) -> Figure:
    """Mean over standard deviation of a flat field (h, w), about its mean: the linear SNR there."""
    mean, deviation = float(flat.mean(dtype=np.float64)), float(flat.std(dtype=np.float64, ddof=1))
    if deviation <= 1e-6 * mean:
        return unavailable("ratio", "nothing is left of the noise in a flat field")
    return measured(mean / deviation, "ratio", f"one flat field of {flat.shape[1]} x {flat.shape[0]}, L / sigma")


SOURCE = "ConvBEERS paper, table on its simulated test set"
NOTE = "another test set: does not compare"
PAPER_UNITS = {
    "PSNR": "dB",
    "SSIM": "ratio",
    "LPIPS, network not stated": DISTANCE,
    "DISTS": DISTANCE,
    "MTF at Nyquist": "%",
    **{snr_name(radiance): "ratio" for radiance in RADIANCES},
}
PAPER = {
    "paper: traditional": (20.6, 0.843, 0.216, 0.220, None, 65.33, 138.51),
    "paper: ConvBEERS": (27.5, 0.932, 0.068, 0.077, 20.0, 66.27, 156.07),
}
"""The paper's traditional pipeline, whose MTF did not converge, and its network."""


def paper_rows() -> list[Row]:
    """The paper's two rows as printed."""
    rows = []
    for name, values in PAPER.items():
        figures = {
            key: unavailable(unit, "the paper: did not converge") if value is None else published(value, unit, SOURCE)
            for (key, unit), value in zip(PAPER_UNITS.items(), values, strict=True)
        }
        rows.append(Row("mean", name, figures, {"sensor": NOTE}))
    return rows
