"""Scores of one method on the pairs, as rows: an image each, and the mean with its interval."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from deploy.evaluation.methods import Method
from deploy.evaluation.pairs import NamedPair
from deploy.evaluation.perceptual import Perceptual
from deploy.restore import MAX_DN
from deploy.results import Figure, Row, measured, unavailable
from model.metrics.bootstrap import site_interval
from model.metrics.fidelity import psnr_db, ssim

DISTANCE = "distance"
UNITS = {"PSNR": "dB", "PSNR gain": "dB", "SSIM": "ratio"}
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

    def score(self, dn: np.ndarray, reference: np.ndarray, degraded: np.ndarray) -> dict[str, float | None]:
        """The figures of one restored image, (H, W) digital numbers each."""
        psnr, before = (fidelity_db(image, reference, degraded, self.max_dn) for image in (dn, degraded))
        scores: dict[str, float | None] = {"PSNR": psnr, "PSNR gain": psnr - before if psnr != before else 0.0}
        scores["SSIM"] = ssim(dn, reference, self.max_dn)
        for name, distance in self.perceptual.items():
            both = dn / self.max_dn, reference / self.max_dn
            scores[name] = None if isinstance(distance, str) else distance(*both)
        return scores

    def figure(
        self, key: str, value: float | None, source: str, interval: tuple[float, float] | None = None
    ) -> Figure:
        """A score as a figure; unavailable with the reason where there is none."""
        unit = UNITS.get(key, DISTANCE)
        if value is None:
            return unavailable(unit, str(self.perceptual[key]))
        return measured(value, unit, source, interval) if np.isfinite(value) else unavailable(unit, IDENTICAL)


def fidelity_db(dn: np.ndarray, reference: np.ndarray, degraded: np.ndarray, max_dn: int = MAX_DN) -> float:
    """PSNR over full scale without the pixels that clipped in the input or the reference: their truth is unknown."""
    sound = (reference < max_dn) & (degraded < max_dn)
    return psnr_db(dn[sound], reference[sound], max_dn) if sound.any() else psnr_db(dn, reference, max_dn)


def score(
    method: Method, pairs: Sequence[NamedPair], instruments: Instruments, seed: int, tick: Callable[[], None]
) -> list[Row]:
    """The mean row of a method, then one row an image."""
    rows, scores = [], []
    for pair in pairs:
        values = instruments.score(method.restore(pair.degraded), pair.reference, pair.degraded)
        figures = {key: instruments.figure(key, value, "one pair") for key, value in values.items()}
        rows.append(Row("images", f"{method.name}: {pair.name}", figures, {"site": pair.site}))
        scores.append(values)
        tick()
    return [mean_row(method, scores, [pair.site for pair in pairs], instruments, seed), *rows]


def mean_row(
    method: Method,
    scores: Sequence[dict[str, float | None]],
    sites: Sequence[str],
    instruments: Instruments,
    seed: int,
) -> Row:
    """The mean of each score over the images that have it, with the bootstrap interval."""
    figures = {}
    for key in scores[0]:
        usable = [
            (v, site) for s, site in zip(scores, sites, strict=True) if (v := s[key]) is not None and np.isfinite(v)
        ]
        if not usable:
            figures[key] = instruments.figure(key, scores[0][key], "")
            continue
        values, places = zip(*usable, strict=True)
        interval, words = site_interval(values, places, np.random.default_rng(seed))
        source = f"mean of {len(values)} pairs from {len(set(places))} sites, {words}"
        figures[key] = instruments.figure(key, float(np.mean(values)), source, interval)
    return Row("mean", method.name, figures, {"told": method.told})


def site_rows(rows: Sequence[Row]) -> list[Row]:
    """PSNR, SSIM and what perceptual distances there are, by site: a row a site, a column a method."""
    images = [row for row in rows if row.table == "images"]
    keys = [key for key in images[0].figures if key != "PSNR gain" and any(row.figures[key].value for row in images)]
    sites = list(dict.fromkeys(row.text["site"] for row in images))
    return [
        _site_row(key, site, [row for row in images if row.text["site"] == site]) for key in keys for site in sites
    ]


def _site_row(key: str, site: str, images: Sequence[Row]) -> Row:
    figures: dict[str, Figure] = {}
    for method in dict.fromkeys(row.name.split(": ")[0] for row in images):
        here = [row.figures[key] for row in images if row.name.startswith(f"{method}: ")]
        values = [figure.value for figure in here if figure.value is not None]
        source = f"mean {key} of {len(values)} pairs"
        figures[method] = measured(float(np.mean(values)), here[0].unit, source) if values else here[0]
    return Row(f"{key} by site", site, figures, {"images": str(len(here))})


def fidelity_row(table: str, name: str, dn: np.ndarray, reference: np.ndarray, degraded: np.ndarray) -> Row:
    """PSNR and SSIM of one restored image, (H, W) digital numbers over 4095 DN."""
    instruments = Instruments({})
    values = instruments.score(dn, reference, degraded)
    figures = {key: instruments.figure(key, values[key], "simulated pair") for key in ("PSNR", "SSIM")}
    return Row(table, name, figures)
