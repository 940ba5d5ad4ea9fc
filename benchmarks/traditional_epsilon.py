"""The regularisation of the traditional pipeline: a scan of epsilon on photographs, and the fit of
its two constants.

    python benchmarks/traditional_epsilon.py --images aerial-train/ --images aerial-train2/

One photograph of each place is acquired under six sensors, at three brightnesses, once stretched to
full scale and once with a third of the contrast about 80 W/m2/sr/um. NL-Bayes runs once for each
image, and the compensation with every epsilon of a grid. PSNR is that against the reference without
noise, without the border and without saturated pixels. Never give the photographs that results are
reported on: the constants would be chosen on them.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import chain, product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize

from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.simulator.acquire import MARGIN_PX
from beers_deploy.model.simulator.detector import to_dn, to_radiance
from beers_deploy.model.simulator.sampling import Scene, read_scene
from beers_deploy.model.traditional.compensate import compensation_kernel, filter_strips
from beers_deploy.model.traditional.nl_bayes import QUALITIES
from beers_deploy.model.traditional.noise import Noise, with_rounding_noise
from beers_deploy.model.traditional.pipeline import WORKING_SIGMA, denoise_radiance
from beers_deploy.model.traditional.regularisation import FIT, Fit, measure
from beers_deploy.profiles.instrument import Instrument, noise_from_snr
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation.pairs import NamedPair, simulate_pairs

BORDER_PX = 24
SIDE_PX = 150
OVERSAMPLING = 4
SEED = 0
LEAST_SIDE_PX = 300
"""Of a photograph: smaller ones leave too few pixels within the border."""

BRIGHTNESSES = (1, 1 / 4, 1 / 20)
FLAT_MEAN = 80.0
FLAT_CONTRAST = 0.3
FLAT_LEAST = 1.0
"""Radiance in W/m2/sr/um and share of the contrast of a scene that is not stretched, and its least
radiance.
"""

EPSILONS = np.array([0.0, *(1e-5 * 2.0 ** np.arange(17))])
ZERO = 5e-6
"""Where epsilon = 0 stands on the logarithmic axis on which the scan is interpolated."""

FINE = np.array([0.0, *np.geomspace(EPSILONS[1], EPSILONS[-1], 100)])
"""Where the best epsilon is looked for."""

FACTORS = (0, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8)
BEFORE_PER_PERCENT = 3.3e-3
"""The rule before this one: epsilon for each per cent of noise at 100 W/m2/sr/um, whatever the
image.
"""

REFERENCE = Sensor.load("pleiades-reference").nominal()


def sensors() -> dict[str, Instrument]:
    """Return the sensors of the scan: MTF at Nyquist in %, SNR at 25 and 100 W/m2/sr/um."""
    nominal = Sensor.load("pleiades-degraded").nominal()
    blurred = partial(replace, nominal)
    return {
        "7 %, 50 / 110": nominal,
        "2 %, 50 / 110": blurred(mtf_nyquist=0.02),
        "12 x 5 %, 50 / 110": blurred(mtf_nyquist=0.12, mtf_nyquist_along=0.05),
        "7 %, 25 / 55": with_snr(nominal, 25, 55),
        "3 %, 15 / 50": with_snr(blurred(mtf_nyquist=0.03), 15, 50),
        "10 %, 90 / 190": with_snr(blurred(mtf_nyquist=0.10), 90, 190),
    }


def with_snr(sensor: Instrument, snr_25: float, snr_100: float) -> Instrument:
    """Return the sensor with another SNR at 25 and at 100 W/m2/sr/um."""
    alpha, beta = noise_from_snr(25, snr_25, 100, snr_100)
    return replace(sensor, alpha=alpha, beta=beta)


@dataclass(frozen=True)
class Curve:
    """PSNR of one image against epsilon.

    Attributes:
        place: the site of the photograph.
        sensor: its name in the table.
        brightness: the share of the radiance.
        noise_to_scene: N / S of the image.
        largest: the bound of epsilon.
        before: epsilon by the rule before this one.
        psnr_db: PSNR at each of EPSILONS.
    """

    place: str
    sensor: str
    brightness: float
    noise_to_scene: float
    largest: float
    before: float
    psnr_db: NDArray[np.float64]

    def at(self, epsilon: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the PSNR in dB at any epsilon, interpolated."""
        return np.asarray(self._interpolated(np.log(np.clip(epsilon, ZERO, EPSILONS[-1]))))

    @cached_property
    def _interpolated(self) -> PchipInterpolator:
        # A logarithmic axis has no place for epsilon = 0, so it stands at ZERO.
        return PchipInterpolator(np.log(np.maximum(EPSILONS, ZERO)), self.psnr_db)

    @cached_property
    def best_db(self) -> float:
        """Return the PSNR in dB at the best epsilon of this image."""
        return float(self.at(FINE).max())

    def fitted(self, fit: Fit) -> float:
        """Return the epsilon that the constants give for this image."""
        return float(min(fit.scale * self.noise_to_scene**fit.power, self.largest))

    def loss_db(self, fit: Fit) -> float:
        """Return how much PSNR the constants lose to the best epsilon of this image, in dB."""
        return self.best_db - float(self.at(self.fitted(fit)))


def main() -> None:
    """Print the scan, the constants and what they lose."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--images", type=Path, action="append", required=True, help="A folder; may be repeated."
    )
    torch.set_num_threads(1)
    curves = scan(parser.parse_args().images)
    print_table(curves)
    print_losses(curves)


def print_losses(curves: Sequence[Curve]) -> None:
    """Print the constants that fit best, and the mean and largest loss to the best epsilon of each
    image.
    """
    fit = fitted_to(curves)
    places = sorted({curve.place for curve in curves})
    rows = {
        "shipped": [curve.loss_db(FIT) for curve in curves],
        "fitted": [curve.loss_db(fit) for curve in curves],
        "fitted without the place": list(
            chain.from_iterable(held_out_loss_db(curves, place) for place in places)
        ),
        "before": [curve.best_db - float(curve.at(curve.before)) for curve in curves],
    }
    print(
        f"\n{len(curves)} images of {len(places)} places. Constants: {words(fit)}; shipped: "
        f"{words(FIT)}\n"
    )
    print("| constants | mean loss, dB | largest loss, dB |\n|---|---|---|")
    for name, losses in rows.items():
        print(f"| {name} | {np.mean(losses):.3f} | {max(losses):.2f} |")


def words(fit: Fit) -> str:
    """Return the constants in words."""
    return f"a = {fit.scale:.4f}, p = {fit.power:.3f}"


def scan(folders: Sequence[Path]) -> list[Curve]:
    """Return the curve of each photograph, form, brightness and sensor."""
    forms = chain.from_iterable(map(forms_of, photographs(folders)))
    cases = list(product(forms, BRIGHTNESSES, sensors()))
    curves = []
    with steps("scanning", len(cases)) as bar:
        for scene, brightness, name in cases:
            curves.append(curve_of(scene, brightness, name))
            bar.advance()
    return curves


def photographs(folders: Sequence[Path]) -> Iterator[Scene]:
    """Yield the middle of the first photograph of each place, named by the place: the first word of
    a file's name.
    """
    firsts: dict[str, Path] = {}
    for folder in folders:
        for path in list_images(folder):
            firsts.setdefault(path.stem.split("_")[0], path)
    for place, path in firsts.items():
        radiance = read_scene(path, REFERENCE).radiance
        side = min(OVERSAMPLING * (SIDE_PX + 2 * MARGIN_PX), *radiance.shape)
        # Smaller photographs leave too few pixels within the border.
        if side < LEAST_SIDE_PX:
            continue
        top, left = ((length - side) // 2 for length in radiance.shape)
        yield Scene(place, radiance[top : top + side, left : left + side])


def forms_of(scene: Scene) -> Iterator[Scene]:
    """Yield the scene as it is, stretched to full scale, and with less contrast."""
    yield scene
    flat = FLAT_MEAN + FLAT_CONTRAST * (scene.radiance - scene.radiance.mean())
    yield Scene(scene.name, flat.clip(FLAT_LEAST).astype(np.float32))


def curve_of(scene: Scene, brightness: float, name: str) -> Curve:
    """Acquire a scene by the sensor of a name, and restore it with each epsilon."""
    sensor = sensors()[name]
    darker = Scene(scene.name, (scene.radiance * brightness).astype(np.float32))
    reference = REFERENCE.in_units_of(sensor)
    (pair,), _ = simulate_pairs([darker], sensor, reference, SEED, (OVERSAMPLING, 2))
    dn = torch.from_numpy(pair.degraded)
    levels = [psnr_db(image, pair, sensor.max_dn) for image in restorations(dn, name)]
    measured = measure([dn], sensor)
    before = BEFORE_PER_PERCENT * sensor.noise_sigma(100.0)
    settings = measured.ratio(sensor), measured.largest_epsilon, before
    return Curve(scene.name, name, brightness, *settings, np.array(levels))


def restorations(dn: torch.Tensor, name: str) -> Iterator[torch.Tensor]:
    """Yield an image (H, W) of digital numbers restored with each of EPSILONS, denoised once for
    all.
    """
    sensor = sensors()[name]
    noisy = to_radiance(dn, sensor)
    settings = with_rounding_noise(sensor), Noise(WORKING_SIGMA), QUALITIES["standard"]
    clean = torch.cat(list(denoise_radiance([noisy], len(noisy), *settings)))
    for epsilon in EPSILONS:
        yield to_dn(
            torch.cat(list(filter_strips([clean], len(clean), kernel(name, float(epsilon))))),
            sensor,
        )


@cache
def kernel(name: str, epsilon: float) -> torch.Tensor:
    """Return the compensation of a sensor, given by its name."""
    return compensation_kernel(sensors()[name].blur, REFERENCE.blur, epsilon)


def psnr_db(dn: torch.Tensor, pair: NamedPair, max_dn: int) -> float:
    """Return the PSNR against the reference without noise, where neither the border nor saturation
    reaches.
    """
    inner = slice(BORDER_PX, -BORDER_PX), slice(BORDER_PX, -BORDER_PX)
    assert pair.noise_free is not None  # noqa: S101 - pairs simulated here have it
    error = (dn.numpy() - pair.noise_free)[inner]
    # Saturated pixels have lost what the reference shows.
    usable = (pair.degraded < max_dn)[inner]
    return float(10 * np.log10(max_dn**2 / np.square(error[usable], dtype=np.float64).mean()))


def fitted_to(curves: Sequence[Curve]) -> Fit:
    """Return the constants that lose least, in the mean over the curves."""

    def mean_loss_db(logs: NDArray[np.float64]) -> float:
        fit = Fit(float(np.exp(logs[0])), float(logs[1]))
        return float(np.mean([curve.loss_db(fit) for curve in curves]))

    optimum = minimize(
        mean_loss_db,
        [np.log(FIT.scale), FIT.power],
        method="Nelder-Mead",
        options={"xatol": 1e-2, "fatol": 1e-5},
    ).x
    return Fit(float(np.exp(optimum[0])), float(optimum[1]))


def held_out_loss_db(curves: Sequence[Curve], place: str) -> list[float]:
    """Return the loss on each image of a place, with the constants fitted to the other places, in
    dB.
    """
    fit = fitted_to([curve for curve in curves if curve.place != place])
    return [curve.loss_db(fit) for curve in curves if curve.place == place]


def print_table(curves: Sequence[Curve]) -> None:
    """Print the mean PSNR of each sensor and brightness, and that of all."""
    factors = " | ".join(f"x {factor:g}" for factor in FACTORS)
    print(f"| sensor | brightness | before | {factors} | best single | best of each image |")
    print("|---" * (5 + len(FACTORS)) + "|")
    for name, brightness in product(sensors(), BRIGHTNESSES):
        cell = [curve for curve in curves if (curve.sensor, curve.brightness) == (name, brightness)]
        print_row(f"{name} | {brightness:g}", cell)
    print_row("all |", curves)


def print_row(name: str, curves: Sequence[Curve]) -> None:
    """Print the means over some images."""
    before = np.mean([curve.at(curve.before) for curve in curves])
    scaled = [
        np.mean([curve.at(factor * curve.fitted(FIT)) for curve in curves]) for factor in FACTORS
    ]
    single = np.mean([curve.at(FINE) for curve in curves], axis=0).max()
    best = np.mean([curve.best_db for curve in curves])
    print(
        f"| {name} |", " | ".join(f"{level:.2f}" for level in (before, *scaled, single, best)), "|"
    )


if __name__ == "__main__":
    main()
