"""Figures of one method on pairs of images: scores of each image, their means, and means by site.

Scores of inner pixels leave out a border on every side. At the border of an image a method reads
less than its receptive field, and the borders of small images are a large part of them. A swath has
hardly any border.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch

from beers_deploy.model.metrics.fidelity import fidelity_db, ssim
from beers_deploy.model.metrics.perceptual import Dists, Lpips, find_backbone, not_found
from beers_deploy.model.metrics.statistics import site_interval
from beers_deploy.model.progress import steps
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.figures import Figure, Row, measured, published, unavailable
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.targets import snr_name

Perceptual = Callable[[np.ndarray, np.ndarray], float]
"""Computes the distance of two images (H, W) in [0, 1] of full scale."""
Part = Callable[[np.ndarray], np.ndarray]
"""Returns the part of an image (H, W) that counts."""


def mean_over_sites(
    values: Sequence[float], sites: Sequence[str], seed: int, unit: str, source: str
) -> Figure:
    """Average a score over images, with the bootstrap interval over their sites.

    Args:
        values: the score of each of N images, (N,).
        sites: the site of each image; images of one site resemble one another.
        seed: the seed of the bootstrap. With one seed, the intervals of all scores come from the
            same draws of sites.
        unit: the unit of the score.
        source: what the values were measured on, in words.
    """
    interval, words = site_interval(values, sites, np.random.default_rng(seed))
    return measured(float(np.mean(values)), unit, f"{source}, {words}", interval)


def perceptual_distances(place: Path | None) -> dict[str, Perceptual | str]:
    """Load the perceptual metrics whose pretrained weights are found.

    Args:
        place: a file with the weights of SqueezeNet 1.1, or a folder with those of SqueezeNet 1.1
            or VGG16; None reads the path from the environment.

    Returns:
        The metrics by name. LPIPS-squeeze is always there, if need be as the reason why it is
        unavailable; LPIPS-vgg and DISTS are there if VGG16 is found.
    """
    distances: dict[str, Perceptual | str] = {"LPIPS-squeeze": not_found("squeeze")}
    # A single file is that of SqueezeNet.
    networks = ("squeeze", "vgg") if place is None or place.is_dir() else ("squeeze",)
    for network in networks:
        if file := find_backbone(network, place):
            distances[f"LPIPS-{network}"] = partial(_distance, Lpips.load(network, file))
            if network == "vgg":
                distances["DISTS"] = partial(_distance, Dists.load(file))
    return distances


def _distance(metric: Lpips | Dists, image: np.ndarray, reference: np.ndarray) -> float:
    both = [torch.from_numpy(np.asarray(a, np.float32))[None, None] for a in (image, reference)]
    with torch.inference_mode():
        return float(metric(*both))


DISTANCE = "distance"
NOISE_FREE = "PSNR, reference without noise"
INNER = "inner PSNR"
INNER_NOISE_FREE = f"inner {NOISE_FREE}"
BIAS = "bias of the mean"
LARGEST_BIAS = "largest bias of the mean"
DETAILS: tuple[str, ...] = (NOISE_FREE, INNER, INNER_NOISE_FREE, "PSNR gain", BIAS)
"""Scores that add detail to PSNR, or report the level of an image."""
UNITS = {
    "PSNR": "dB",
    "SSIM": "ratio",
    **dict.fromkeys(DETAILS, "dB"),
    BIAS: "%",
    LARGEST_BIAS: "%",
}
READ = "pairs read from files hold no reference without noise"
IDENTICAL = "infinite: identical to the reference"
BLACK = "the reference is black"

INNER_BORDER_PX = 57
"""The border that inner pixels leave out: the receptive radius of the largest shipped network (38
px), and the reach of the consistency step (19 px). It is the same for all methods, so that their
rows compare.
"""


def inner_border_px(height: int, width: int) -> int:
    """Return the width in pixels of the border that scores of inner pixels leave out on every side
    of an image (height, width): `INNER_BORDER_PX`, but at most a quarter of the shorter side.
    """
    return min(INNER_BORDER_PX, min(height, width) // 4)


def inner_note(pairs: Sequence[NamedPair]) -> str:
    """Return a sentence for the reader of the results if some images are so small that scores of
    inner pixels leave out a narrower border; else an empty text.
    """
    small = sum(inner_border_px(*pair.degraded.shape) < INNER_BORDER_PX for pair in pairs)
    if not small:
        return ""
    return (
        f"Inner pixels leave out {INNER_BORDER_PX} px on every side, and a quarter of the shorter "
        f"side of small images ({small} of {len(pairs)})."
    )


def inner(image: np.ndarray) -> np.ndarray:
    """Return an image (H, W) without the border that scores of inner pixels leave out."""
    border_px = inner_border_px(*image.shape)
    height, width = image.shape
    return image[border_px : height - border_px, border_px : width - border_px]


def bias_percent(
    dn: np.ndarray,
    reference_dn: np.ndarray,
    unclipped: np.ndarray | None = None,
    offset_dn: float = 0.0,
) -> float:
    """Return by how much the mean light of a restored image exceeds that of the reference, in %.

    Only inner pixels count, without the border that `inner` leaves out.

    Args:
        dn: the restored image, digital numbers (H, W).
        reference_dn: the reference image, digital numbers (H, W).
        unclipped: True where pixels count, (H, W); None if all pixels do. If no inner pixel counts,
            all are used.
        offset_dn: the digital number that the sensor stores without light.

    Returns:
        100 * (mean / mean of the reference - 1), or NaN if the reference is black.
    """
    images = [inner(image) for image in (dn, reference_dn)]
    if unclipped is not None and inner(unclipped).any():
        images = [image[inner(unclipped)] for image in images]
    mean_dn, level = (float(image.mean(dtype=np.float64)) - offset_dn for image in images)
    return 100 * (mean_dn / level - 1) if level > 0 else float("nan")


@dataclass(frozen=True)
class Instruments:
    """The metrics that score restored images, and the digital numbers that they assume.

    Attributes:
        perceptual: the perceptual metrics by name, in addition to PSNR and SSIM: each a function of
            two images, or the reason why it is unavailable.
        max_dn: the digital number that is full scale; by default that of 12 bits.
        offset_dn: the digital number that the sensor stores without light.
    """

    perceptual: Mapping[str, Perceptual | str]
    max_dn: int = MAX_DN
    offset_dn: float = 0.0

    def score(self, dn: np.ndarray, pair: NamedPair) -> dict[str, float | None]:
        """Compute all scores of one restored image.

        Args:
            dn: the restored image, digital numbers (H, W).
            pair: the pair whose degraded image was restored.

        Returns:
            The scores by name, in the units that `figure` states; None if one is unavailable.
        """

        def psnr_db(reference: np.ndarray, part: Part = np.asarray) -> float:
            return fidelity_db(part(dn), part(reference), part(pair.degraded), self.max_dn)

        clean = pair.noise_free
        psnr = psnr_db(pair.reference)
        before = fidelity_db(pair.degraded, pair.reference, pair.degraded, self.max_dn)
        scores: dict[str, float | None] = {
            "PSNR": psnr,
            NOISE_FREE: None if clean is None else psnr_db(clean),
            INNER: psnr_db(pair.reference, inner),
            INNER_NOISE_FREE: None if clean is None else psnr_db(clean, inner),
        }
        # Two infinite PSNRs have no difference, and are equal.
        scores["PSNR gain"] = psnr - before if psnr != before else 0.0
        # A clipped pixel has lost light before any method sees it: it does not count as an error.
        unclipped = (pair.reference < self.max_dn) & (pair.degraded < self.max_dn)
        # The mean of a noisy reference has an error of its own.
        scores[BIAS] = bias_percent(dn, pair.truth, unclipped, self.offset_dn)
        scores["SSIM"] = ssim(dn, pair.reference, self.max_dn)
        for name, distance in self.perceptual.items():
            both = dn / self.max_dn, pair.reference / self.max_dn
            scores[name] = None if isinstance(distance, str) else distance(*both)
        return scores

    def figure(self, key: str, value: float | None, source: str) -> Figure:
        """Convert a score to a figure with unit and source.

        Args:
            key: the name of the score.
            value: the value of the score, or None.
            source: what the value was measured on, in words.

        Returns:
            The figure. It is unavailable, with the reason, if the value is None or not finite.
        """
        unit = UNITS.get(key, DISTANCE)
        if value is None:
            without_clean = key in (NOISE_FREE, INNER_NOISE_FREE)
            return unavailable(unit, READ if without_clean else str(self.perceptual[key]))
        if not np.isfinite(value):
            return unavailable(unit, BLACK if key == BIAS else IDENTICAL)
        return measured(value, unit, source)

    def means(
        self, scores: Sequence[Mapping[str, float | None]], sites: Sequence[str], seed: int
    ) -> dict[str, Figure]:
        """Average the scores of images, each with its bootstrap interval over sites.

        Args:
            scores: the scores of each image by name, as `score` returns them.
            sites: the site of each image; images of one site resemble one another.
            seed: the seed of the bootstrap.

        Returns:
            The mean of each score by name, over the images that have it, and the largest bias of
            the mean.
        """
        figures = {}
        for key, first in scores[0].items():
            both = ((image[key], site) for image, site in zip(scores, sites, strict=True))
            usable = [
                (value, site) for value, site in both if value is not None and np.isfinite(value)
            ]
            if not usable:
                figures[key] = self.figure(key, first, "")
                continue
            values, places = zip(*usable, strict=True)
            source = (
                f"mean of {counted(len(values), 'pair')} from {counted(len(set(places)), 'site')}"
            )
            unit = UNITS.get(key, DISTANCE)
            figures[key] = mean_over_sites(values, places, seed, unit, source)
            if key == BIAS:
                largest, site = max(usable, key=lambda pair: abs(pair[0]))
                figures[LARGEST_BIAS] = self.figure(
                    LARGEST_BIAS, largest, f"one pair of site {site}"
                )
        return figures


def score(
    method: Method, pairs: Sequence[NamedPair], instruments: Instruments, seed: int
) -> list[Row]:
    """Restore the degraded image of each pair by a method, and score the results.

    Args:
        method: the method.
        pairs: the pairs of a degraded and a reference image.
        instruments: the metrics.
        seed: the seed of the bootstrap, which gives the intervals.

    Returns:
        A row of the table 'mean', then a row of the table 'images' for each pair.
    """
    rows = []
    scores = []
    with steps(method.name, len(pairs)) as bar:
        for pair in pairs:
            values = instruments.score(method.restore(pair.degraded), pair)
            figures = {
                key: instruments.figure(key, value, "one pair") for key, value in values.items()
            }
            rows.append(Row("images", f"{method.name}: {pair.name}", figures, {"site": pair.site}))
            scores.append(values)
            bar.advance()
    means = instruments.means(scores, [pair.site for pair in pairs], seed)
    return [Row("mean", method.name, means, {"sensor": method.sensor_known}), *rows]


def site_rows(images: Sequence[Row]) -> list[Row]:
    """Average the scores of single images by site, in one table for each score but the gain.

    Args:
        images: the rows of an evaluation's table 'images'.

    Returns:
        The rows of the tables 'SCORE by site': a row for each site, with a column for each method.
    """
    keys = [
        key
        for key in images[0].figures
        if key != "PSNR gain" and any(row.figures[key].value is not None for row in images)
    ]
    sites: dict[str, dict[str, list[Row]]] = {}
    for row in images:
        # A row is named METHOD: PAIR, and a user's method may have a colon in its name.
        method = row.name.rpartition(": ")[0]
        sites.setdefault(row.text["site"], {}).setdefault(method, []).append(row)
    rows = []
    for key, (site, methods) in product(keys, sites.items()):
        figures: dict[str, Figure] = {}
        for method, own in methods.items():
            values = [value for row in own if (value := row.figures[key].value) is not None]
            figures[method] = own[0].figures[key]
            if values:
                source = f"mean {key} of {counted(len(values), 'pair')}"
                figures[method] = measured(float(np.mean(values)), figures[method].unit, source)
        rows.append(Row(f"{key} by site", site, figures, {"images": str(len(own))}))
    return rows


SOURCE = "ConvBEERS paper, table on its simulated test set"
NOTE = "another test set: does not compare"
PAPER_UNITS = {
    "PSNR": "dB",
    "SSIM": "ratio",
    "LPIPS, network not stated": DISTANCE,
    "DISTS": DISTANCE,
    "MTF at Nyquist": "%",
    snr_name(25): "ratio",
    snr_name(100): "ratio",
}
PAPER = {
    "paper: traditional": (20.6, 0.843, 0.216, 0.220, None, 65.33, 138.51),
    "paper: ConvBEERS": (27.5, 0.932, 0.068, 0.077, 20.0, 66.27, 156.07),
}
"""The paper's traditional pipeline, whose MTF did not converge, and its network."""


def paper_rows() -> list[Row]:
    """Return the scores that the ConvBEERS paper prints for its traditional pipeline and its
    network, as two rows of the table 'mean'.
    """
    rows = []
    for name, values in PAPER.items():
        figures: dict[str, Figure] = {}
        for (key, unit), value in zip(PAPER_UNITS.items(), values, strict=True):
            if value is None:
                figures[key] = unavailable(unit, "the paper: did not converge")
            else:
                figures[key] = published(value, unit, SOURCE)
        rows.append(Row("mean", name, figures, {"sensor": NOTE}))
    return rows
