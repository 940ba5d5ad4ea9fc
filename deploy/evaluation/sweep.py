"""Where a method breaks: the same scenes through sensors that it was not told of, and was not trained for.

The chain appears twice: told the truth, which is the best it can do, and told the nominal sensor, which is what it is
told in orbit when the instrument has drifted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from deploy.evaluation.methods import Method, method_named
from deploy.evaluation.pairs import NamedPair, oversamplings_of, simulate_pairs
from deploy.evaluation.scores import fidelity_db
from deploy.evaluation.targets import acquire_targets, mtf_figure, restored_mtfs
from deploy.results import Row, measured
from model.metrics.bootstrap import site_interval
from model.simulator.scene import Scene
from profiles.sensor import Sensor, SensorProfile, noise_from_snr

SHARPNESS = (0.10, 0.07, 0.05, 0.03, 0.02)
NOISE = ((15.0, 50.0), (25.0, 55.0), (30.0, 80.0), (70.0, 150.0), (90.0, 190.0))
"""SNR at 25 and 100 W/m2/sr/um; the nominal 50 / 110 is in every sweep."""

TOLD_NOMINAL = "traditional, told nominal"
TOLD_TRUTH = "traditional, told the truth"


@dataclass(frozen=True)
class Condition:
    """A sensor with a name."""

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
    """The sensor with that MTF at Nyquist on both axes."""
    return replace(sensor, mtf_nyquist=mtf, mtf_nyquist_along=None)


def _noisy(sensor: Sensor, profile: SensorProfile, snr_0: float, snr_1: float) -> Sensor:
    alpha, beta = noise_from_snr(profile.radiance_0.low, snr_0, profile.radiance_1.low, snr_1)
    return replace(sensor, alpha=alpha, beta=beta)


@dataclass(frozen=True)
class Fixed:
    """A sensor in the place of a profile: every draw gives it."""

    sensor: Sensor

    def draw(self, _generator: np.random.Generator) -> Sensor:
        """The sensor."""
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
        methods = [method_named("degraded", nominal, target), *_chains(condition.sensor, nominal, target), *networks]
        rows += _rows(condition, methods, pairs, seed)
        tick()
    return sorted(rows, key=lambda row: row.table)


def _chains(truth: Sensor, nominal: Sensor, target: Sensor) -> list[Method]:
    told = replace(nominal, gain_dn_per_radiance=truth.gain_dn_per_radiance)
    return [
        replace(method_named("traditional", sensor, target), name=name)
        for name, sensor in ((TOLD_TRUTH, truth), (TOLD_NOMINAL, told))
    ]


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
