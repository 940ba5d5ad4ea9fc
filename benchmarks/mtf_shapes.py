"""Networks and the traditional pipeline under sensors of one contrast at Nyquist and different MTF
curves.

    python benchmarks/mtf_shapes.py --images aerial-test/ [--networks convbeers-s-int8]

Each curve is stated as a table up to Nyquist, where it is 7 %, and all methods know it. One
photograph of each site; PSNR of inner pixels against the reference without noise.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beers_deploy.model.raster.images import site_of
from beers_deploy.model.simulator.mtf import mtf
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import NYQUIST, MtfTable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.method import Restore
from beers_deploy.studies.evaluation.methods import (
    TRADITIONAL,
    method_named,
    method_without_network,
)
from beers_deploy.studies.evaluation.pairs import NamedPair, simulate_pairs

CONTRAST = 0.07
SEED = 0
BORDER_PX = 57
OVERSAMPLINGS = (4, 2)
MID = 0.22
WIDTH = 0.12
DEPTH = 0.10
"""Frequency and width in cycles per pixel of the sag and of the bulge, and their depth."""
CUTOFFS = (0.5, 3.0)
"""Of a circular pupil, in cycles per pixel: the one that gives the contrast lies between."""

Curve = NDArray[np.float64]
DEGRADED = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference")


def main() -> None:
    """Print a row a curve: the pipeline's PSNR, and how far each network is above it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--networks", default="convbeers-s-int8")
    arguments = parser.parse_args()
    names = arguments.networks.split(",")
    aim = REFERENCE.nominal()
    scenes = {
        site_of(scene.name): scene for scene in reversed(load_scenes(arguments.images, aim, SEED))
    }
    print(f"| curve | {TRADITIONAL} dB | {' | '.join(names)} |")
    print(f"|---|---|{'---|' * len(names)}")
    for curve, contrasts in curves().items():
        sensor = with_curve(contrasts)
        pairs, _ = simulate_pairs(
            list(scenes.values()), sensor, aim.in_units_of(sensor), SEED, OVERSAMPLINGS
        )
        pipeline = mean_psnr_db(method_without_network(TRADITIONAL, sensor, aim).restore, pairs)
        gains = [mean_psnr_db(network(name, sensor), pairs) - pipeline for name in names]
        print(
            f"| {curve} | {pipeline:.2f} |",
            " | ".join(f"{gain:+.2f}" for gain in gains),
            "|",
            flush=True,
        )


def frequencies() -> Curve:
    """Return the frequencies of a table, in cycles per pixel."""
    return np.linspace(0, NYQUIST, 21)


def curves() -> dict[str, Curve]:
    """Return the contrasts of each curve at `frequencies`."""
    frequency = frequencies()
    formula = np.asarray(mtf(frequency[None], np.zeros((1, 1)), (CONTRAST, CONTRAST)))[0]
    hill = DEPTH * np.exp(-(((frequency - MID) / WIDTH) ** 2))
    return {
        "of training": formula,
        "Gaussian": CONTRAST ** ((frequency / NYQUIST) ** 2),
        "sagging": formula * (1 - hill),
        "bulging": formula * (1 + hill),
        "circular pupil": circular_pupil(frequency),
    }


def circular_pupil(frequency: Curve) -> Curve:
    """Return the contrast behind a circular pupil and a square detector, CONTRAST at Nyquist."""

    def of_cutoff(cutoff: float) -> Callable[[Curve], Curve]:
        def contrast(at: Curve) -> Curve:
            share = np.clip(at / cutoff, 0, 1)
            return 2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2)) * np.sinc(at)

        return contrast

    low, high = CUTOFFS
    for _ in range(60):
        middle = (low + high) / 2
        too_low = of_cutoff(middle)(np.array([NYQUIST])).item() < CONTRAST
        low = middle if too_low else low
        high = high if too_low else middle
    return of_cutoff(low)(frequency)


def with_curve(contrasts: Curve) -> Instrument:
    """Return the nominal sensor with another MTF on both axes."""
    values = tuple(contrasts.tolist())
    table = MtfTable(tuple(frequencies().tolist()), values, values)
    across, along = table.at_nyquist
    return replace(DEGRADED.nominal(), response=table, mtf_nyquist=across, mtf_nyquist_along=along)


def network(name: str, sensor: Instrument) -> Restore:
    """Return a network that knows the sensor."""
    specialise = method_named(name, DEGRADED, REFERENCE).specialise
    assert specialise is not None  # noqa: S101 - shipped networks take any sensor
    return specialise(sensor)


def mean_psnr_db(restore: Restore, pairs: list[NamedPair]) -> float:
    """Return the mean PSNR over the pairs, without the border and without clipped pixels."""
    levels = []
    for pair in pairs:
        assert pair.noise_free is not None  # noqa: S101 - pairs simulated here have it
        border_px = min(BORDER_PX, min(pair.degraded.shape) // 4)
        inner = slice(border_px, -border_px), slice(border_px, -border_px)
        max_dn = DEGRADED.nominal().max_dn
        usable = ((pair.degraded < max_dn) & (pair.reference < max_dn))[inner]
        error = (restore(pair.degraded) - pair.noise_free)[inner][usable]
        levels.append(10 * np.log10(max_dn**2 / np.square(error, dtype=np.float64).mean()))
    return float(np.mean(levels))


if __name__ == "__main__":
    main()
