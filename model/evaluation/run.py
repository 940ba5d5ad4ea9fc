"""An evaluation from pairs and methods to rows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.evaluation.methods import BLIND, TRAINED, Method, method_without_network
from model.evaluation.pairs import NamedPair, PairsRecipe, oversamplings_of, read_pairs, simulate_pairs
from model.evaluation.scores import Instruments, fidelity_db, paper_rows, score, site_rows
from model.evaluation.targets import acquire_targets, mtf_figure, restored_mtfs, target_figures
from model.io.images import list_images, site_of
from model.metrics.bootstrap import site_interval
from model.progress import steps
from model.simulator.procedural import load_scenes
from model.simulator.sampling import Scene
from profiles.figures import Row, measured
from profiles.sensor import Sensor, SensorProfile, noise_from_snr

SHARPNESS = (0.10, 0.07, 0.05, 0.03, 0.02)
NOISE = ((15.0, 50.0), (25.0, 55.0), (30.0, 80.0), (70.0, 150.0), (90.0, 190.0))
"""SNR at 25 and 100 W/m2/sr/um; the nominal 50 / 110 is in every sweep."""

NOMINAL_KNOWN = "traditional, nominal sensor known"
TRUTH_KNOWN = "traditional, true sensor known"


@dataclass(frozen=True)
class Condition:
    """One sensor of the sweep, with the name of its row."""

    name: str
    sensor: Sensor


def conditions(nominal: Sensor, profile: SensorProfile) -> list[Condition]:
    """The nominal sensor; other MTFs; other SNRs; both at once; and one with another gain."""
    found = [Condition("nominal", nominal)]
    found += [Condition(f"MTF {mtf:.0%}", _sharp(nominal, mtf)) for mtf in SHARPNESS]
    found += [Condition(f"SNR {a:g} / {b:g}", _noisy(nominal, profile, a, b)) for a, b in NOISE]
    low = _noisy(nominal, profile, 25, 55)
    found += [Condition(f"MTF {mtf:.0%}, SNR 25 / 55", _sharp(low, mtf)) for mtf in (0.05, 0.03)]
    worst = _sharp(_noisy(nominal, profile, 15, 50), 0.03)
    gain = replace(_sharp(nominal, 0.10), gain_dn_per_radiance=0.7 * nominal.gain_dn_per_radiance)
    return [*found, Condition("MTF 3%, SNR 15 / 50", worst), Condition("MTF 10%, gain x 0.7", gain)]


def _sharp(sensor: Sensor, mtf: float) -> Sensor:
    """The sensor with the formula's MTF, that at Nyquist on both axes."""
    return replace(sensor, mtf_nyquist=mtf, mtf_nyquist_along=None, response=None)


def _noisy(sensor: Sensor, profile: SensorProfile, snr_0: float, snr_1: float) -> Sensor:
    alpha, beta = noise_from_snr(profile.radiance_0.low, snr_0, profile.radiance_1.low, snr_1)
    return replace(sensor, alpha=alpha, beta=beta)


@dataclass(frozen=True)
class Fixed:
    """A sensor in the place of a profile: every draw gives it."""

    sensor: Sensor

    def draw(self, _generator: np.random.Generator) -> Sensor:
        """The same sensor for every draw."""
        return self.sensor


def sweep_rows(
    networks: Sequence[Method],
    scenes: Sequence[Scene],
    profile: SensorProfile,
    reference: SensorProfile,
    seed: int,
    tick: Callable[[], None],
) -> list[Row]:
    """A row a condition for PSNR, and one for the MTF at Nyquist: the input, both chains, each network."""
    nominal, rows = profile.nominal(), []
    for condition in conditions(nominal, profile):
        target = reference.nominal().in_units_of(condition.sensor)
        pairs, _ = simulate_pairs(
            list(scenes), Fixed(condition.sensor), Fixed(target), seed, oversamplings_of(profile)
        )
        methods = [*_known_methods(condition.sensor, nominal, target), *networks]
        rows += _rows(condition, methods, pairs, seed)
        tick()
    return sorted(rows, key=lambda row: row.table)


def _known_methods(truth: Sensor, nominal: Sensor, target: Sensor) -> list[Method]:
    """The input itself, and the chain that knows the true sensor, or the nominal one in its place."""
    supposed = replace(nominal, gain_dn_per_radiance=truth.gain_dn_per_radiance)
    wanted = {
        "degraded": ("degraded", nominal),
        TRUTH_KNOWN: ("traditional", truth),
        NOMINAL_KNOWN: ("traditional", supposed),
    }
    found = {shown: method_without_network(name, sensor, target) for shown, (name, sensor) in wanted.items()}
    return [replace(method, name=shown) for shown, method in found.items() if method is not None]


def _rows(condition: Condition, methods: Sequence[Method], pairs: Sequence[NamedPair], seed: int) -> list[Row]:
    targets = acquire_targets(condition.sensor, seed)
    psnr, mtf = {}, {}
    for method in methods:
        restored = ((method.restore(pair.degraded), pair) for pair in pairs)
        values = [fidelity_db(dn, p.reference, p.degraded, condition.sensor.max_dn) for dn, p in restored]
        interval, words = site_interval(values, [p.site for p in pairs], np.random.default_rng(seed))
        source = f"mean of {len(values)} pairs, {words}"
        psnr[method.name] = measured(float(np.mean(values)), "dB", source, interval)
        mtf[method.name] = mtf_figure(restored_mtfs(method, targets))
    return [Row("sweep, MTF at Nyquist", condition.name, mtf), Row("sweep, PSNR", condition.name, psnr)]


@dataclass(frozen=True)
class Evaluation:
    """The rows of an evaluation: a mean a method and the paper's, a site each, an image each."""

    mean: tuple[Row, ...]
    sites: tuple[Row, ...]
    images: tuple[Row, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows: means, sites, images."""
        return (*self.mean, *self.sites, *self.images)


def load_pairs(
    images: Path | None,
    pairs: Path | None,
    degraded: SensorProfile,
    reference: SensorProfile,
    seed: int,
    recipe: PairsRecipe | None = None,
) -> tuple[list[NamedPair], list[str]]:
    """Pairs from a folder of pairs, from a folder of scenes, or from drawn scenes; and scenes too small to use."""
    if pairs is not None:
        return read_pairs(pairs, degraded.nominal().max_dn, recipe), []
    scenes = load_scenes(images, reference.nominal(), seed)
    return simulate_pairs(scenes, degraded, reference, seed, oversamplings_of(degraded))


def evaluate_methods(
    methods: Sequence[Method], pairs: Sequence[NamedPair], instruments: Instruments, sensor: Sensor, seed: int
) -> Evaluation:
    """Score every method on every pair, and on targets acquired by `sensor`."""
    targets = acquire_targets(sensor, seed)
    means, images = [], []
    for method in methods:
        with steps(method.name, len(pairs)) as bar:
            mean, *rest = score(method, pairs, instruments, seed, bar.advance)
        figures = {**mean.figures, **target_figures(method, targets)}
        means.append(replace(mean, figures=figures))
        images += rest
    return Evaluation((*means, *paper_rows()), tuple(site_rows(images)), tuple(images))


def sweep_tables(
    methods: Sequence[Method],
    images: Path | None,
    degraded: SensorProfile,
    reference: SensorProfile,
    seed: int,
) -> tuple[Row, ...]:
    """PSNR and MTF of the networks and the chain under conditions other than the nominal ones; a scene a site."""
    scenes = load_scenes(images, reference.nominal(), seed)
    first = {site_of(scene.name): scene for scene in reversed(scenes)}
    networks = [method for method in methods if method.sensor_known in (BLIND, TRAINED)]
    with steps("sweep", len(conditions(degraded.nominal(), degraded))) as bar:
        return tuple(sweep_rows(networks, list(first.values()), degraded, reference, seed, bar.advance))


def input_files(
    methods: Sequence[str], images: Path | None, pairs: Path | None, lpips: Path | None
) -> tuple[Path, ...]:
    """The files that an evaluation's figures rest on: models, scenes or pairs, weights of LPIPS."""
    named = [path for path in (*map(Path, methods), *([lpips] if lpips else [])) if path.is_file()]
    folders = [images] if images else [pairs / role for role in ("degraded", "reference")] if pairs else []
    return (*named, *(path for folder in folders for path in list_images(folder)))
