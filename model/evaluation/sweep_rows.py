"""What a sweep found, as tables: PSNR, MTF, the gain over the chain, what a wrongly known sensor costs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.evaluation.methods import DEGRADED, TRADITIONAL
from model.evaluation.scores import NOISE_FREE
from model.metrics.bootstrap import site_interval
from profiles.figures import Figure, Row, measured

NOMINAL = "nominal"
NOMINAL_KNOWN = "traditional, nominal sensor known"
TRUTH_KNOWN = "traditional, true sensor known"

Key = tuple[str, str, str]
"""Names: of the condition that holds, of the sensor that the method supposes, and of the method."""


@dataclass(frozen=True)
class Found:
    """What a sweep measured, trial by trial.

    Attributes:
        psnr: in dB, (2, N): each image against the reference, and against the reference without noise.
        mtf: after restoration, where the sensor is known as it is, and of the chain that supposes the nominal one.
        sites: of the images, (N,).
        seed: of the bootstrap.
    """

    psnr: Mapping[Key, np.ndarray]
    mtf: Mapping[Key, Figure]
    sites: Sequence[str]
    seed: int

    @property
    def conditions(self) -> list[str]:
        """Names of the sensors that acquired the scenes."""
        return list(dict.fromkeys(truth for truth, _, _ in self.psnr))

    @property
    def networks(self) -> list[str]:
        """Names of the methods that are neither the input nor the chain."""
        return [name for name in dict.fromkeys(name for *_, name in self.psnr) if name not in (DEGRADED, TRADITIONAL)]

    @property
    def rows(self) -> list[Row]:
        """Every table, a row a condition; and of the gains a row a network over all conditions."""
        psnr = {key: self._mean(values[0]) for key, values in self.psnr.items()}
        clean = {key: self._mean(values[1]) for key, values in self.psnr.items()}
        tables = (("sweep, PSNR", psnr), (f"sweep, {NOISE_FREE}", clean), ("sweep, MTF at Nyquist", self.mtf))
        conditions = [row for table, figures in tables for row in self._conditions(table, figures)]
        return [*conditions, *self._gains(), *self._wrong()]

    def _conditions(self, table: str, figures: Mapping[Key, Figure]) -> list[Row]:
        """The input, the chain that knows the truth, the one that knows the nominal sensor, and each network."""
        return [
            Row(table, truth, {shown: figures[key] for shown, key in self._columns(truth).items()})
            for truth in self.conditions
        ]

    def _columns(self, truth: str) -> dict[str, Key]:
        chains = {TRUTH_KNOWN: (truth, truth, TRADITIONAL), NOMINAL_KNOWN: (truth, NOMINAL, TRADITIONAL)}
        networks = {name: (truth, truth, name) for name in self.networks}
        return {DEGRADED: (truth, truth, DEGRADED), **chains, **networks}

    def _gains(self) -> list[Row]:
        """How far each network is ahead of the chain that knows the truth: by condition, then over all of them."""
        gains = {name: {truth: self._gain(truth, name) for truth in self.conditions} for name in self.networks}
        rows = [
            Row("sweep, gain over the chain", truth, {name: self._mean(gains[name][truth]) for name in gains})
            for truth in self.conditions
        ]
        return [*rows, *(self._over_all(*each) for each in gains.items())] if gains else []

    def _gain(self, truth: str, network: str) -> np.ndarray:
        return np.asarray(self.psnr[truth, truth, network][0] - self.psnr[truth, truth, TRADITIONAL][0])

    def _over_all(self, network: str, gains: Mapping[str, np.ndarray]) -> Row:
        least = min(gains, key=lambda truth: float(gains[truth].mean()))
        mean = self._mean(np.mean(list(gains.values()), axis=0))
        figures = {f"mean of {len(gains)} conditions": mean, "least": self._mean(gains[least])}
        return Row("sweep, gain over the chain, all conditions", network, figures, {"least at": least})

    def _wrong(self) -> list[Row]:
        """PSNR where each method supposes another sensor than the true one, and what it loses by that."""
        names: dict[tuple[str, str], list[str]] = {}
        for truth, supposed, name in self.psnr:
            if supposed not in (truth, NOMINAL):
                names.setdefault((truth, supposed), []).append(name)
        psnr, lost = [], []
        for (truth, supposed), methods in names.items():
            wrong = {name: self.psnr[truth, supposed, name][0] for name in methods}
            cost = {name: self.psnr[truth, truth, name][0] - values for name, values in wrong.items()}
            shown = f"{truth}, supposed {supposed}"
            psnr.append(Row("sweep, sensor known wrongly", shown, self._means(wrong)))
            lost.append(Row("sweep, lost by a sensor known wrongly", shown, self._means(cost)))
        return [*psnr, *lost]

    def _means(self, values: Mapping[str, np.ndarray]) -> dict[str, Figure]:
        return {name: self._mean(each) for name, each in values.items()}

    def _mean(self, values: np.ndarray) -> Figure:
        """The mean of (N,) dB, an image each: of differences on the same images the interval is a paired one."""
        interval, words = site_interval(values.tolist(), self.sites, np.random.default_rng(self.seed))
        return measured(float(values.mean()), "dB", f"mean of {len(values)} pairs, {words}", interval)
