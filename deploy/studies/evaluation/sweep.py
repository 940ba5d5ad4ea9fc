"""The sweep: the same methods under sensors of other blur, noise and gain, whose parameters are
known correctly or wrongly.

Its tables are PSNR, MTF, the gain over the traditional pipeline, and the loss due to a wrongly
known sensor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from beers_deploy.model.metrics.fidelity import fidelity_db
from beers_deploy.model.progress import steps
from beers_deploy.model.raster.images import site_of
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.figures import Figure, Row
from beers_deploy.profiles.instrument import Instrument, noise_from_snr
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation.methods import (
    DEGRADED,
    TRADITIONAL,
    WITHOUT_NETWORK,
    Method,
    method_named,
)
from beers_deploy.studies.evaluation.pairs import (
    NamedPair,
    oversamplings_of,
    scenes_at,
    simulate_pairs,
    table_at,
)
from beers_deploy.studies.evaluation.scores import NOISE_FREE, mean_over_sites
from beers_deploy.studies.evaluation.target_scenes import acquire_edges
from beers_deploy.studies.evaluation.targets import restored_mtf

NOMINAL = "nominal"
"""The condition from which the others depart."""
SHARPNESS = (0.10, 0.07, 0.05, 0.03, 0.02)
NOISE = ((15.0, 50.0), (25.0, 55.0), (30.0, 80.0), (70.0, 150.0), (90.0, 190.0))
"""SNR at 25 and 100 W/m2/sr/um. The nominal 50 / 110 is in every sweep."""


def conditions(nominal: Instrument, profile: Sensor) -> dict[str, Instrument]:
    """Return the sensors under which the sweep compares methods: the nominal one, and others that
    differ from it in MTF, SNR or gain.

    Args:
        nominal: the sensor from which the others depart.
        profile: its profile, which states the radiances of the SNRs.

    Returns:
        The sensors by the name of the condition, such as "MTF 5%".
    """
    low = _noisy(nominal, profile, 25, 55)
    worst = _noisy(nominal, profile, 15, 50)
    weak = replace(nominal, gain_dn_per_radiance=0.7 * nominal.gain_dn_per_radiance)
    return {
        NOMINAL: nominal,
        **{f"MTF {mtf:.0%}": _sharp(nominal, mtf) for mtf in SHARPNESS},
        "MTF 12% across, 5% along": replace(_sharp(nominal, 0.12), mtf_nyquist_along=0.05),
        **{f"SNR {a:g} / {b:g}": _noisy(nominal, profile, a, b) for a, b in NOISE},
        **{f"MTF {mtf:.0%}, SNR 25 / 55": _sharp(low, mtf) for mtf in (0.05, 0.03)},
        "MTF 3%, SNR 15 / 50": _sharp(worst, 0.03),
        "MTF 10%, gain x 0.7": _sharp(weak, 0.10),
    }


def suppositions(nominal: Instrument, profile: Sensor) -> dict[str, dict[str, Instrument]]:
    """Return the sensors that methods assume wrongly in the sweep.

    Args:
        nominal: the sensor from which the conditions depart.
        profile: its profile, which states the radiances of the SNRs.

    Returns:
        By the name of the true condition (of the sensor that acquires the images), the sensors that
        are assumed instead, by their names.
    """
    mtf = {value: {f"MTF {value:.0%}": _sharp(nominal, value)} for value in (0.05, 0.07, 0.10)}
    # SNR is radiance over sigma: with k times as much of it, the variance is k^2 times smaller.
    thirds = {
        f"SNR x {k:.2f}": replace(nominal, alpha=nominal.alpha / k**2, beta=nominal.beta / k**2)
        for k in (4 / 3, 2 / 3)
    }
    return {
        "MTF 7%": mtf[0.05] | mtf[0.10],
        "MTF 5%": mtf[0.07],
        "MTF 3%": mtf[0.07],
        "SNR 30 / 80": {"SNR 50 / 110": _noisy(nominal, profile, 50, 110)},
        NOMINAL: thirds,
    }


def _sharp(sensor: Instrument, mtf: float) -> Instrument:
    """Return the sensor with the formula's MTF, and the given contrast at Nyquist on both axes."""
    return replace(sensor, mtf_nyquist=mtf, mtf_nyquist_along=None, response=None)


def _noisy(sensor: Instrument, profile: Sensor, snr_0: float, snr_1: float) -> Instrument:
    alpha, beta = noise_from_snr(profile.radiance_0.low, snr_0, profile.radiance_1.low, snr_1)
    return replace(sensor, alpha=alpha, beta=beta)


def run_sweep(
    methods: Sequence[Method],
    images: Path | None,
    profile: Sensor,
    reference: Sensor,
    seed: int,
    brightness: float = 1.0,
) -> "SweepResult":
    """Compare the degraded input, the traditional pipeline and networks under sensors of other
    blur, noise and gain, on one scene of each site.

    Args:
        methods: the methods of the evaluation, of which the networks are used. Each condition's
            sensor is given to those that can use it.
        images: the folder of scenes; None draws scenes.
        profile: the profile of the sensor from which the conditions depart.
        reference: the profile of the sensor that the restoration aims at.
        seed: the seed of every random draw.
        brightness: the factor by which the radiance of the scenes is multiplied. The MTF is
            measured only at 1, because edges do not depend on it.
    """
    psnr = dict[Key, np.ndarray]()
    mtf = dict[Key, Figure]()
    pairs = list[NamedPair]()
    nominal = profile.nominal()
    aim = reference.nominal()
    ratios = oversamplings_of(profile)
    loaded = scenes_at(brightness, load_scenes(images, aim, seed))
    # Reversed, so that the first scene of each site is the one that stays.
    scenes = {site_of(scene.name): scene for scene in reversed(loaded)}
    sensors = conditions(nominal, profile)
    pipeline = method_named(TRADITIONAL, profile, reference)
    networks = [method for method in methods if method.name not in WITHOUT_NETWORK]
    candidates = [method_named(DEGRADED, profile, reference), pipeline, *networks]
    able = [method for method in candidates if method.specialise is not None]
    wrongly = suppositions(nominal, profile)
    trials = dict[str, list[Trial]]()
    for name, sensor in sensors.items():
        trials[name] = [Trial(name, sensor, method) for method in candidates]
        # Under the nominal condition this trial of the pipeline is the plain one.
        if name != NOMINAL:
            units = replace(nominal, gain_dn_per_radiance=sensor.gain_dn_per_radiance)
            trials[name].append(Trial(NOMINAL, units, pipeline))
        for supposed, other in wrongly.get(name, {}).items():
            trials[name] += [Trial(supposed, other, method) for method in able]
    with steps("sweep", sum(map(len, trials.values()))) as bar:
        for name, sensor in sensors.items():
            pairs, _ = simulate_pairs(
                list(scenes.values()), sensor, aim.in_units_of(sensor), seed, ratios
            )
            # Edges do not depend on the brightness of the scenes: they are measured at 1 alone.
            edges = acquire_edges(sensor, seed) if brightness == 1 else []
            for supposed, assumed, method in trials[name]:
                key = Key(name, supposed, method.name)
                specialised = method.with_sensor(assumed)
                psnr[key] = _psnr_db(specialised, pairs, sensor.max_dn)
                if brightness == 1 and supposed in (name, NOMINAL):
                    mtf[key] = restored_mtf(specialised, edges, sensor.max_dn)
                bar.advance(1, f"{name}: {method.name}")
    return SweepResult(psnr, mtf, [pair.site for pair in pairs], seed, brightness)


class Trial(NamedTuple):
    """A method, and the sensor that it assumes.

    Attributes:
        supposed: the name of the sensor.
        sensor: the sensor.
        method: the method.
    """

    supposed: str
    sensor: Instrument
    method: Method


def _psnr_db(method: Method, pairs: Sequence[NamedPair], max_dn: int) -> np.ndarray:
    """Return the PSNR (2, N) of each image against the reference, and against the reference without
    noise.
    """
    rows = []
    for pair in pairs:
        dn = method.restore(pair.degraded)
        references = [pair.reference, cast(np.ndarray, pair.noise_free)]
        rows.append([fidelity_db(dn, image, pair.degraded, max_dn) for image in references])
    return np.array(rows).T


NOMINAL_KNOWN = "traditional, nominal sensor known"
TRUTH_KNOWN = "traditional, true sensor known"


class Key(NamedTuple):
    """The names that identify a trial: one method on the images of one sensor.

    Attributes:
        truth: the true condition: the sensor that acquired the images.
        supposed: the sensor that the method assumes.
        method: the method.
    """

    truth: str
    supposed: str
    method: str


@dataclass(frozen=True)
class SweepResult:
    """The measurements of a sweep over N images.

    Attributes:
        psnr: for each trial the PSNR in dB, (2, N): of each image against the reference, and
            against the reference without noise.
        mtf: for each trial the MTF at Nyquist of restored edges in %, if the method assumes the
            true sensor or the nominal one; empty if `brightness` is not 1.
        sites: the sites of the images, (N,).
        seed: the seed of the bootstrap over sites, which gives the intervals.
        brightness: the factor by which the radiance of the scenes was multiplied.
    """

    psnr: Mapping[Key, np.ndarray]
    mtf: Mapping[Key, Figure]
    sites: Sequence[str]
    seed: int
    brightness: float = 1.0

    @property
    def conditions(self) -> list[str]:
        """The names of the conditions, the sensors that acquired the images, in order."""
        return list(dict.fromkeys(key.truth for key in self.psnr))

    @property
    def networks(self) -> list[str]:
        """The names of the methods that are neither the degraded input nor the traditional
        pipeline.
        """
        names = dict.fromkeys(key.method for key in self.psnr)
        return [name for name in names if name not in (DEGRADED, TRADITIONAL)]

    @property
    def rows(self) -> list[Row]:
        """The rows of all tables of the sweep: PSNR, MTF, the gain over the traditional pipeline,
        and the loss by a wrongly assumed sensor.

        Each table has a row for each condition. The gains have a second table with a row for each
        network over all conditions. The MTF is left out if the brightness is not 1.
        """
        names = ("sweep, PSNR", f"sweep, {NOISE_FREE}")
        tables: list[tuple[str, Mapping[Key, Figure]]] = [
            (name, {key: self._mean(both[k]) for key, both in self.psnr.items()})
            for k, name in enumerate(names)
        ]
        if self.brightness == 1:
            tables.append(("sweep, MTF at Nyquist", self.mtf))
        rows: list[Row] = []
        for (table, figures), truth in product(tables, self.conditions):
            columns = {
                DEGRADED: Key(truth, truth, DEGRADED),
                TRUTH_KNOWN: Key(truth, truth, TRADITIONAL),
                NOMINAL_KNOWN: Key(truth, NOMINAL, TRADITIONAL),
                **{name: Key(truth, truth, name) for name in self.networks},
            }
            row = {column: figures[key] for column, key in columns.items()}
            rows.append(Row(table, truth, row))
        rows += [*self._gains(), *self._wrong()]
        return [replace(row, table=table_at(self.brightness, row.table)) for row in rows]

    def _gains(self) -> list[Row]:
        """Return the gain of each network over the pipeline that knows the truth: by condition,
        then over all of them.
        """
        table = "sweep, gain over the pipeline"
        gains = {
            truth: {
                name: self._known(truth, name) - self._known(truth, TRADITIONAL)
                for name in self.networks
            }
            for truth in self.conditions
        }
        rows = [Row(table, truth, self._means(by_name)) for truth, by_name in gains.items()]
        over_all = []
        for network in self.networks:
            own = {truth: by_name[network] for truth, by_name in gains.items()}
            least = min(own, key=lambda truth: float(own[truth].mean()))
            mean = np.mean(list(own.values()), axis=0)
            figures = self._means({f"mean of {len(own)} conditions": mean, "least": own[least]})
            over_all.append(Row(f"{table}, all conditions", network, figures, {"least at": least}))
        return [*rows, *over_all] if over_all else []

    def _wrong(self) -> list[Row]:
        """Return the PSNR of each method that assumes a wrong sensor, and the loss due to that."""
        wrong: dict[tuple[str, str], dict[str, np.ndarray]] = {}
        for key, (in_db, _) in self.psnr.items():
            if key.supposed not in (key.truth, NOMINAL):
                wrong.setdefault((key.truth, key.supposed), {})[key.method] = in_db
        psnr = []
        losses = []
        for (truth, supposed), by_method in wrong.items():
            cost = {name: self._known(truth, name) - in_db for name, in_db in by_method.items()}
            row_name = f"{truth}, supposed {supposed}"
            psnr.append(Row("sweep, sensor known wrongly", row_name, self._means(by_method)))
            losses.append(Row("sweep, lost by a sensor known wrongly", row_name, self._means(cost)))
        return [*psnr, *losses]

    def _known(self, truth: str, method: str) -> np.ndarray:
        """Return the PSNR (N,) of a method that assumes the true sensor."""
        return np.asarray(self.psnr[Key(truth, truth, method)][0])

    def _means(self, values: Mapping[str, np.ndarray]) -> dict[str, Figure]:
        return {name: self._mean(in_db) for name, in_db in values.items()}

    def _mean(self, values: np.ndarray) -> Figure:
        """Return the mean of (N,) dB, one value for each image. For differences on the same images
        the interval is a paired one.
        """
        source = f"mean of {counted(len(values), 'pair')}"
        return mean_over_sites(values.tolist(), self.sites, self.seed, "dB", source)
