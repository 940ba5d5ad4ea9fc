"""The sweep: the same methods under sensors of other blur, noise and gain, each known as it is, or known wrongly."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.evaluation.methods import DEGRADED, TRADITIONAL, Method, method_without_network
from model.evaluation.pairs import NamedPair, oversamplings_of, simulate_pairs
from model.evaluation.scores import fidelity_db
from model.evaluation.sweep_rows import NOMINAL, Found, Key
from model.evaluation.targets import acquire_targets, mtf_figure, restored_mtfs
from model.io.images import site_of
from model.progress import steps
from model.simulator.procedural import load_scenes
from model.simulator.sampling import Scene
from profiles.figures import Figure, Row
from profiles.sensor import Sensor, SensorProfile, noise_from_snr

SHARPNESS = (0.10, 0.07, 0.05, 0.03, 0.02)
NOISE = ((15.0, 50.0), (25.0, 55.0), (30.0, 80.0), (70.0, 150.0), (90.0, 190.0))
"""SNR at 25 and 100 W/m2/sr/um; the nominal 50 / 110 is in every sweep."""


@dataclass(frozen=True)
class Condition:
    """A sensor of the sweep, with the name of its row."""

    name: str
    sensor: Sensor


def conditions(nominal: Sensor, profile: SensorProfile) -> list[Condition]:
    """The nominal sensor; other MTFs, both axes alike or not; other SNRs; both at once; and one with another gain."""
    found = [Condition(NOMINAL, nominal)]
    found += [Condition(f"MTF {mtf:.0%}", _sharp(nominal, mtf)) for mtf in SHARPNESS]
    uneven = replace(_sharp(nominal, 0.12), mtf_nyquist_along=0.05)
    found += [Condition("MTF 12% across, 5% along", uneven)]
    found += [Condition(f"SNR {a:g} / {b:g}", _noisy(nominal, profile, a, b)) for a, b in NOISE]
    low = _noisy(nominal, profile, 25, 55)
    found += [Condition(f"MTF {mtf:.0%}, SNR 25 / 55", _sharp(low, mtf)) for mtf in (0.05, 0.03)]
    worst = _sharp(_noisy(nominal, profile, 15, 50), 0.03)
    gain = replace(_sharp(nominal, 0.10), gain_dn_per_radiance=0.7 * nominal.gain_dn_per_radiance)
    return [*found, Condition("MTF 3%, SNR 15 / 50", worst), Condition("MTF 10%, gain x 0.7", gain)]


def suppositions(nominal: Sensor, profile: SensorProfile) -> dict[str, list[Condition]]:
    """Sensors known wrongly: by the name of the condition that holds, what is supposed in its place."""
    mtf = {value: Condition(f"MTF {value:.0%}", _sharp(nominal, value)) for value in (0.05, 0.07, 0.10)}
    snr = Condition("SNR 50 / 110", _noisy(nominal, profile, 50, 110))
    # SNR is radiance over sigma: with k times as much of it, the variance is k^2 times smaller.
    thirds = [
        Condition(f"SNR x {k:.2f}", replace(nominal, alpha=nominal.alpha / k**2, beta=nominal.beta / k**2))
        for k in (4 / 3, 2 / 3)
    ]
    return {
        "MTF 7%": [mtf[0.05], mtf[0.10]],
        "MTF 5%": [mtf[0.07]],
        "MTF 3%": [mtf[0.07]],
        "SNR 30 / 80": [snr],
        NOMINAL: thirds,
    }


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


@dataclass(frozen=True)
class Sweep:
    """Methods and the conditions that they are tried under.

    Attributes:
        networks: run with each condition's sensor known where they can know it, else as they are.
        scenes: that every sensor acquires.
        profile: of the sensor that the conditions depart from.
        reference: profile of the sensor that is aimed at.
        seed: of every random draw.
    """

    networks: Sequence[Method]
    scenes: Sequence[Scene]
    profile: SensorProfile
    reference: SensorProfile
    seed: int

    @property
    def conditions(self) -> list[Condition]:
        """Every sensor that acquires the scenes."""
        return conditions(self.profile.nominal(), self.profile)

    @property
    def wrong(self) -> dict[str, list[Condition]]:
        """By the name of the condition that holds, the sensors supposed in its place."""
        return suppositions(self.profile.nominal(), self.profile)

    @property
    def size(self) -> int:
        """How many trials there are."""
        return sum(len(self.trials(truth)) for truth in self.conditions)

    def trials(self, truth: Condition) -> list[tuple[Condition, Method]]:
        """What is run under a condition: the sensor that is supposed, and the method that supposes it."""
        nominal, reference = self.profile.nominal(), self.reference.nominal()
        named = [method_without_network(name, nominal, reference) for name in (DEGRADED, TRADITIONAL)]
        methods = [*(method for method in named if method is not None), *self.networks]
        units = replace(nominal, gain_dn_per_radiance=truth.sensor.gain_dn_per_radiance)
        drifted = [(Condition(NOMINAL, units), methods[1])] if truth.name != NOMINAL else []
        able = [method for method in methods if method.specialise is not None]
        wrong = [(supposed, method) for supposed in self.wrong.get(truth.name, ()) for method in able]
        return [*((truth, method) for method in methods), *drifted, *wrong]

    def run(self, tick: Callable[[str], None]) -> Found:
        """Try every method under every condition; `tick` is told what was done."""
        psnr, mtf = dict[Key, np.ndarray](), dict[Key, Figure]()
        for truth in self.conditions:
            pairs, targets = self._pairs(truth.sensor), acquire_targets(truth.sensor, self.seed)
            for supposed, method in self.trials(truth):
                key, knowing = (truth.name, supposed.name, method.name), method.knowing(supposed.sensor)
                psnr[key] = _psnr_db(knowing, pairs, truth.sensor.max_dn)
                if supposed.name in (truth.name, NOMINAL):
                    mtf[key] = mtf_figure(restored_mtfs(knowing, targets))
                tick(f"{truth.name}: {method.name}")
        return Found(psnr, mtf, [pair.site for pair in pairs], self.seed)

    def _pairs(self, sensor: Sensor) -> list[NamedPair]:
        target, ratios = self.reference.nominal().in_units_of(sensor), oversamplings_of(self.profile)
        return simulate_pairs(list(self.scenes), Fixed(sensor), Fixed(target), self.seed, ratios)[0]


def _psnr_db(method: Method, pairs: Sequence[NamedPair], max_dn: int) -> np.ndarray:
    """(2, N): each image against the reference, and against the reference without noise."""
    found = []
    for pair in pairs:
        dn = method.restore(pair.degraded)
        wanted = (pair.reference, pair.noise_free)
        found.append([fidelity_db(dn, image, pair.degraded, max_dn) for image in wanted if image is not None])
    return np.array(found).T


def sweep_tables(
    methods: Sequence[Method],
    images: Path | None,
    degraded: SensorProfile,
    reference: SensorProfile,
    seed: int,
) -> tuple[Row, ...]:
    """The tables of a sweep of the networks among the methods, on one scene of each site."""
    scenes = load_scenes(images, reference.nominal(), seed)
    first = {site_of(scene.name): scene for scene in reversed(scenes)}
    sensors = degraded.nominal(), reference.nominal()
    networks = [method for method in methods if method_without_network(method.name, *sensors) is None]
    sweep = Sweep(networks, list(first.values()), degraded, reference, seed)
    with steps("sweep", sweep.size) as bar:
        return tuple(sweep.run(lambda note: bar.advance(1, note)).rows)
