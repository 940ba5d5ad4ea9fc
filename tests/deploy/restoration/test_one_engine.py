"""One engine: an image is restored to the same pixels by every command and function."""

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
from beers_deploy.restoration.plan import Tiles, plan_for
from beers_deploy.restoration.runtime import open_runtime
from beers_deploy.restoration.steps import Around, step_for
from beers_deploy.restoration.tiles.rows import restore_dn
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.stress.networks import Runner
from beers_deploy.studies.tradeoff.measure import restore_in_tiles
from beers_deploy.studies.tradeoff.points import FLOAT, INT8, Point, Variant
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import restored
from tests.shipped import shipped_pair

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


def by_engine(dn: np.ndarray, path: Path, tiles: Tiles, sensor: Sensor | None = None) -> np.ndarray:
    """Restore an array by the engine itself, with the consistency step if the sensor is known."""
    network = bd.Network.load(path)
    infer, _ = open_runtime("onnxruntime", network.model, threads=0)
    steps = () if sensor is None else (step_for(sensor, 4095),)
    return restore_dn(dn, infer, plan_for(network, (1, *ODD), tiles), consistency=steps)


def exact_ways(path: Path, tile_px: int) -> Mapping[str, Restored]:
    """Return each way with exact seams from digital numbers (H, W) float32 to restored integers."""
    runner = Runner(bd.Network.load(path))
    return {
        "evaluate and tradeoff": method_named(
            str(path), SENSOR, REFERENCE, around=Around(consistency=False)
        ).restore,
        "the library and the demo": lambda dn: np.rint(
            restore(dn, network=path, tile=tile_px, full_scale=4095)
        ),
        "stress": lambda dn: np.rint(runner.restore(dn, tile_px=tile_px)),
        "the engine": partial(by_engine, path=path, tiles=Tiles(tile_px)),
    }


def test_with_exact_seams_every_command_gives_the_pixels_of_restore(
    precision: str, path: Path, tmp_path: Path
) -> None:
    pixels = image()
    tile_px = TILES_PX[precision]
    expected = restored(tmp_path, pixels, network=path, tile=tile_px)[0]
    assert (expected != pixels).mean() > 0.5
    assert_array_equal(restore(pixels, network=path, tile=tile_px), expected)
    for name, way in exact_ways(path, tile_px).items():
        assert_array_equal(way(pixels.astype(np.float32)), expected, err_msg=name)


def test_with_a_halo_below_the_radius_they_have_the_same_seams(
    precision: str, path: Path, tmp_path: Path
) -> None:
    pixels = image()
    tile_px = TILES_PX[precision]
    halo_px = SMALL_HALOS_PX[precision]
    options: dict[str, Any] = {"network": path, "tile": tile_px, "sensor": SENSOR}
    expected = restored(tmp_path, pixels, **options, halo=halo_px)[0]
    exact = restored(tmp_path, pixels, **options)[0]
    assert (expected != exact).any()
    dn = pixels.astype(np.float32)
    result = restore(pixels, **options, halo=halo_px)
    assert_array_equal(result, expected)
    # A trade-off study scores an operating point whose halo is below the network's radius this way.
    variant = Variant(path.stem, FLOAT if precision == "float" else INT8, bd.Network.load(path))
    point = Point(variant, tile_px=tile_px, halo_px=halo_px)
    by_tradeoff = restore_in_tiles(point, SENSOR, REFERENCE)
    assert_array_equal(by_tradeoff(dn), expected)
    tiles = Tiles(tile_px, str(halo_px))
    assert_array_equal(by_engine(dn, path, tiles, SENSOR), expected)
