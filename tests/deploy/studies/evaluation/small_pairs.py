"""Small pairs and a method that changes nothing, for the tests of an evaluation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation import target_scenes
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.scores import Instruments

DEGRADED = Sensor.load("pleiades-degraded")


REFERENCE = Sensor.load("pleiades-reference")


SENSORS = DEGRADED.nominal(), REFERENCE.nominal()


PLAIN = Instruments({"LPIPS-squeeze": "no weights"})


OTHER = replace(
    SENSORS[0], mtf_nyquist=0.03, gain_dn_per_radiance=0.7 * SENSORS[0].gain_dn_per_radiance
)


def pair(name: str = "site_1.tif", seed: int = 0, noise_dn: float = 20) -> NamedPair:
    generator = np.random.default_rng(seed)
    reference = generator.integers(100, 3000, (37, 45)).astype(np.float32)
    noisy = reference + generator.normal(0, noise_dn, reference.shape)
    return NamedPair(name, np.clip(np.rint(noisy), 0, 4095).astype(np.float32), reference)


def write_pairs(folder: Path, pairs: list[NamedPair]) -> Path:
    for item in pairs:
        for role in ("degraded", "reference"):
            write_tiff(folder / role / item.name, getattr(item, role).astype(np.uint16))
    return folder


def few_targets(patch: pytest.MonkeyPatch) -> None:
    less = {
        "ANGLES_DEG": (5.0, 8.0),
        "REPEATS": 1,
        "SIDE_PX": 100,
        "POINTS_A_SIDE": 3,
        "BAR_CONTRASTS": (0.1,),
        "BAR_PERIODS_PX": (2.0,),
        "ZONE_CONTRASTS": (0.3,),
    }
    for name, value in less.items():
        patch.setattr(target_scenes, name, value)


IDENTITY = Method("degraded", lambda dn: dn, "blind")
