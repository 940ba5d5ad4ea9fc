"""Tests that every command and function restores an image to the same pixels."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import beers_deploy as bd
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration import method
from beers_deploy.restoration.method import network_restore
from beers_deploy.restoration.plan import Tiles, plan_for
from beers_deploy.restoration.runtime import open_runtime
from beers_deploy.restoration.steps import BOTH, step_for
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import restore_floats
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.stress.networks import Runner
from beers_deploy.studies.tradeoff.measure import tiles_of_point
from beers_deploy.studies.tradeoff.points import FLOAT, INT8, Point, Variant
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import restored
from tests.shipped import shipped_pair

pytestmark = pytest.mark.usefixtures("unchecked")

Restored = Callable[[np.ndarray], np.ndarray]

SENSOR = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference")
ODD = 131, 97
TILES_PX = {"float": 23, "int8": 64}
SMALL_HALOS_PX = {"float": 2, "int8": 8}


@pytest.fixture(params=TILES_PX)
def precision(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the precision of the network; `evaluate` and the scores of `tradeoff` then use tiles
    so small that the image has many.
    """
    monkeypatch.setattr(method, "TILE_PX", TILES_PX[request.param])
    return str(request.param)


@pytest.fixture
def path(precision: str, model: Path) -> Path:
    return model if precision == "float" else shipped_pair()[1]


def image() -> np.ndarray:
    """Return noise (H, W) uint16 with some black and some saturated pixels."""
    return np.random.default_rng(2).integers(0, 4096, ODD).astype(np.uint16)


def ways(path: Path, tile_px: int, halo_px: int) -> Mapping[str, Restored]:
    """Return each way from digital numbers (H, W) float32 to restored integers, for a known sensor
    and with a halo.
    """
    network = bd.Network.load(path)
    variant = Variant(path.stem, INT8 if network.precision == "int8" else FLOAT, network)
    point = Point(variant, tile_px=tile_px, halo_px=halo_px)
    plan = plan_for(network, (1, *ODD), Tiles(tile_px, str(halo_px)))
    infer, _ = open_runtime("onnxruntime", network.model, threads=0)
    engine = ExposedNetwork({1: infer})
    steps = (step_for(SENSOR, 4095),)
    return {
        "the library and the demo": partial(
            restore, network=path, tile=tile_px, halo=halo_px, sensor=SENSOR
        ),
        "tradeoff": network_restore(
            network, SENSOR, REFERENCE.nominal(), BOTH, partial(tiles_of_point, point)
        ),
        "the engine": lambda dn: restore_floats(dn, engine, plan, 4095, steps),
    }


@pytest.mark.parametrize("is_exact", [True, False])
def test_every_command_gives_the_pixels_of_restore(
    is_exact: bool, precision: str, path: Path, tmp_path: Path
) -> None:
    """This holds for exact seams, and for a halo below the radius, which shows seams."""
    pixels = image()
    dn = pixels.astype(np.float32)
    network = bd.Network.load(path)
    halo_px = network.tiling.halo_px if is_exact else SMALL_HALOS_PX[precision]
    options: dict[str, Any] = {"network": path, "tile": TILES_PX[precision], "sensor": SENSOR}
    expected = restored(tmp_path, pixels, **options, halo=halo_px)[0]
    assert (expected != pixels).mean() > 0.5
    assert_array_equal(restore(pixels, **options, halo=halo_px), expected)
    for name, way in ways(path, TILES_PX[precision], halo_px).items():
        assert_array_equal(np.rint(way(dn)), expected, err_msg=name)
    exact = method_named(str(path), SENSOR, REFERENCE).restore(dn)
    assert np.array_equal(exact, expected) == is_exact
    without = restored(tmp_path, pixels, **options, consistency=False)[0]
    by_stress = Runner(network).restore(dn, tile_px=TILES_PX[precision])
    assert_array_equal(np.rint(by_stress), without)
